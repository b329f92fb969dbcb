"""The maps' input x: state, desired preview and, in the sharpened mode, features."""

from __future__ import annotations

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.mode_settings import mode_settings
from drake_safety.learning.segments import Episode, EpisodesInfo, Segments, floats


def is_rate(name: str) -> bool:
    """Whether the name of a state is that of a velocity."""
    return name.endswith("_rate") or "velocity" in name


def preview_names(info: EpisodesInfo) -> list[str]:
    """Returns the names of the preview's entries, (H*n_z,), counted from 0."""
    return [f"desired {name} [{k}]" for k in range(info.horizon) for name in info.output_names]


class InputColumns:
    """The columns of x: [s; z*] in the paper's mode, [s; z*; features] when sharpened.

    A feature unit u appends asinh(features / u).

    Attributes:
        is_used: Which states are columns of x, (n_s,).
        has_features: Whether x has features.
        plan: Which columns are the plan z*.
        names: Names of the columns, (n_x,).
    """

    def __init__(self, info: EpisodesInfo, parameters: AssessmentParameters):
        settings = mode_settings(parameters)
        self._who = f"SafetyAssessment of '{info.scenario}'"
        self._uses_true_state = settings.uses_true_state
        self._feature_unit = parameters.feature_unit
        self._feature_names = info.feature_names if settings.uses_features else []
        self.has_features = bool(self._feature_names)
        names = info.state_names
        self.is_used = np.array([settings.velocities or not is_rate(n) for n in names], dtype=bool)
        self.names = [name for name, used in zip(names, self.is_used, strict=True) if used]
        self._num_states, plan = len(self.names), preview_names(info)
        self.plan = slice(self._num_states, self._num_states + len(plan))
        self.names += [*plan, *self._feature_names]
        if parameters.feature_unit:
            self.names += [f"asinh {name}" for name in self._feature_names]

    def of(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """Returns x, (..., n_x).

        Args:
            state: Measured states, (..., n_s).
            desired_preview: Desired outputs over the horizon, row-major in time, (..., H*n_z).
            features: Features, (..., n_f); ignored in the paper's mode.
        """
        given = [("state", state, len(self.is_used))]
        given.append(("desired_preview", desired_preview, self.plan.stop - self.plan.start))
        if self.has_features:
            if features is None:
                raise ValueError(
                    f"{self._who}: features are missing, expected {len(self._feature_names)} "
                    f"columns: {self._feature_names}"
                )
            given.append(("features", features, len(self._feature_names)))
        parts: list[np.ndarray] = []
        for name, values, width in given:
            try:
                part = floats(values)
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"{self._who}: {name} must be an array of numbers: {error}"
                ) from error
            leading = parts[0].shape[:-1] if parts else part.shape[:-1]
            if part.shape != (*leading, width):
                beside = f", as state has the shape {parts[0].shape}" if parts else ""
                raise ValueError(
                    f"{self._who}: {name} has the shape {part.shape}, expected "
                    f"{(*leading, width)}{beside}"
                )
            parts.append(part)
        if self._num_states != len(self.is_used):
            parts[0] = parts[0][..., self.is_used]
        if self.has_features and self._feature_unit:
            parts.append(np.arcsinh(parts[2] / self._feature_unit))
        return np.concatenate(parts, axis=-1)

    def of_rows(self, rows: Episode | Segments, variation: str = "nominal") -> np.ndarray:
        """Returns x of recorded rows of a plant, (N, n_x).

        In the paper's mode, the states of the nominal plant are without noise.
        """
        is_plain = self._uses_true_state and variation == "nominal"
        state = rows.true_state if is_plain else rows.state
        return self.of(state, rows.desired_preview, rows.features)
