"""The maps' input x: state, desired preview and, in the sharpened mode, features."""

from __future__ import annotations

import functools

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.segments import EpisodesInfo


def is_rate(name: str) -> bool:
    """Whether the name of a state is that of a velocity."""
    return name.endswith("_rate") or "velocity" in name


def used_states(info: EpisodesInfo, parameters: AssessmentParameters) -> np.ndarray:
    """Returns which states are columns of x, (n_s,)."""
    has_rates = parameters.is_sharpened or parameters.paper.velocities
    return _used_states(tuple(info.state_names), has_rates)


@functools.cache
def _used_states(names: tuple[str, ...], has_rates: bool) -> np.ndarray:
    is_used = np.array([has_rates or not is_rate(name) for name in names], dtype=bool)
    is_used.setflags(write=False)
    return is_used


def plan_columns(info: EpisodesInfo, parameters: AssessmentParameters) -> slice:
    """Returns which columns of x are the plan z*."""
    start = int(used_states(info, parameters).sum())
    return slice(start, start + info.horizon * len(info.output_names))


def inputs(
    state: np.ndarray,
    desired_preview: np.ndarray,
    features: np.ndarray | None,
    info: EpisodesInfo,
    parameters: AssessmentParameters,
) -> np.ndarray:
    """Returns x, (..., n_x): [s; z*] in the paper's mode, [s; z*; features] when sharpened.

    Args:
        state: Measured states, (..., n_s).
        desired_preview: Desired outputs over the horizon, row-major in time, (..., H*n_z).
        features: Features, (..., n_f); ignored in the paper's mode.
        parameters: The assessment's. A feature unit u appends asinh(features / u).
    """
    is_used = used_states(info, parameters)
    given = [("state", state, len(is_used))]
    given.append(("desired_preview", desired_preview, info.horizon * len(info.output_names)))
    if parameters.is_sharpened and info.feature_names:
        if features is None:
            raise ValueError(
                f"{_who(info)}: features are missing, expected {len(info.feature_names)} columns: "
                f"{info.feature_names}"
            )
        given.append(("features", features, len(info.feature_names)))
    parts: list[np.ndarray] = []
    for name, values, width in given:
        try:
            part = np.asarray(values, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{_who(info)}: {name} must be an array of numbers: {error}"
            ) from error
        if part.shape[-1:] != (width,):
            rows = parts[0].shape[:-1] if parts else part.shape[:1] if part.ndim > 1 else ()
            expected = (*rows, width)
            raise ValueError(
                f"{_who(info)}: {name} has the shape {part.shape}, expected {expected}"
            )
        if parts and part.shape[:-1] != parts[0].shape[:-1]:
            expected = (*parts[0].shape[:-1], width)
            raise ValueError(
                f"{_who(info)}: {name} has the shape {part.shape}, expected {expected}, as state "
                f"has the shape {parts[0].shape}"
            )
        parts.append(part)
    if parts[0].shape[-1] != np.count_nonzero(is_used):
        parts[0] = parts[0][..., is_used]
    if len(parts) == 3 and parameters.feature_unit:
        parts.append(np.arcsinh(parts[2] / parameters.feature_unit))
    return np.concatenate(parts, axis=-1)


def _who(info: EpisodesInfo) -> str:
    return f"SafetyAssessment of '{info.scenario}'"


def num_inputs(info: EpisodesInfo, parameters: AssessmentParameters) -> int:
    """Returns n_x, the width of x."""
    width = int(used_states(info, parameters).sum()) + info.horizon * len(info.output_names)
    if parameters.is_sharpened:
        width += len(info.feature_names) * (2 if parameters.feature_unit else 1)
    return width


def preview_names(info: EpisodesInfo) -> list[str]:
    """Returns the names of the preview's entries, (H*n_z,), counted from 0."""
    return [f"desired {name} [{k}]" for k in range(info.horizon) for name in info.output_names]


def input_names(info: EpisodesInfo, parameters: AssessmentParameters) -> list[str]:
    """Returns the names of the columns of x, (n_x,)."""
    is_used = used_states(info, parameters)
    names = [name for name, used in zip(info.state_names, is_used, strict=True) if used]
    names += preview_names(info)
    if parameters.is_sharpened:
        names += info.feature_names
        names += [f"asinh {name}" for name in info.feature_names if parameters.feature_unit]
    return names
