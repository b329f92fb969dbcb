"""The maps' input x: state, desired preview and, in the sharpened mode, features."""

import fnmatch
from collections.abc import Sequence

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.segments import Episode, EpisodesInfo, Segments, floats


def preview_names(info: EpisodesInfo) -> list[str]:
    """Returns the names of the preview's entries, (H*n_z,), counted from 0."""
    return [f"desired {name} [{k}]" for k in range(info.horizon) for name in info.output_names]


def kept_features(names: Sequence[str], without: Sequence[str]) -> list[int]:
    """Places of the names that match no pattern of `without`, each of which must match some."""
    matches = {pattern: fnmatch.filter(names, pattern) for pattern in without}
    if unknown := [pattern for pattern, matched in matches.items() if not matched]:
        raise ValueError(f"without_features: {unknown} match no feature; there are {list(names)}")
    left_out = set().union(*matches.values())
    return [i for i, name in enumerate(names) if name not in left_out]


class InputColumns:
    """The columns of x: ``[s; z*]`` in the paper's mode, ``[s; z*; features]`` when sharpened.

    A feature unit u appends asinh(features / u). `plan` are the columns of z*.
    """

    def __init__(self, info: EpisodesInfo, parameters: AssessmentParameters):
        self._who = f"SafetyAssessment of '{info.scenario}'"
        self._uses_true_state = parameters.mode == "paper"
        self._feature_unit = parameters.feature_unit
        features = [] if parameters.mode == "paper" else info.feature_names
        self.has_features = bool(features)
        parts = {"state": info.state_names, "desired_preview": preview_names(info)}
        if features:
            parts["features"] = features
        self._widths = {name: len(part) for name, part in parts.items()}
        self.names = [name for part in parts.values() for name in part]
        num_states = len(info.state_names)
        self.plan = slice(num_states, num_states + self._widths["desired_preview"])
        if parameters.feature_unit:
            self.names += [f"asinh {name}" for name in features]

    def of(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        """Returns x (..., n_x) of (..., n_s), (..., H*n_z) and, outside paper mode, (..., n_f)."""
        parts: list[np.ndarray] = []
        given = (state, desired_preview, features)
        for (name, width), values in zip(self._widths.items(), given, strict=False):
            if values is None:
                raise ValueError(f"{self._who}: {name} are missing, expected {width} columns")
            part = floats(values)
            leading = parts[0].shape[:-1] if parts else part.shape[:-1]
            if part.shape != (*leading, width):
                raise ValueError(
                    f"{self._who}: {name} has the shape {part.shape}, expected {(*leading, width)}"
                )
            parts.append(part)
        if self.has_features and self._feature_unit:
            parts.append(np.arcsinh(parts[2] / self._feature_unit))
        return np.concatenate(parts, axis=-1)

    def of_rows(self, rows: Episode | Segments, variation: str = "nominal") -> np.ndarray:
        """Returns x of a plant's recorded rows, (N, n_x); paper mode: nominal states lack noise."""
        is_plain = self._uses_true_state and variation == "nominal"
        state = rows.true_state if is_plain else rows.state
        return self.of(state, rows.desired_preview, rows.features)
