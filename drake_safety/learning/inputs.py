"""The maps' input x: state, desired preview and, in the sharpened mode, features."""

from __future__ import annotations

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.segments import EpisodesInfo


def is_rate(name: str) -> bool:
    """Whether the name of a state is that of a velocity."""
    return name.endswith("_rate") or "velocity" in name


def used_states(info: EpisodesInfo, parameters: AssessmentParameters) -> np.ndarray:
    """Returns which states are columns of x, (n_s,)."""
    has_rates = parameters.is_sharpened or parameters.paper.velocities
    return np.array([has_rates or not is_rate(name) for name in info.state_names], dtype=bool)


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
        info: The episodes' metadata.
        parameters: The assessment's. A feature unit u appends asinh(features / u).
    """
    state = np.asarray(state, dtype=float)
    is_used = used_states(info, parameters)
    # A state of another width is refused by `check_width`.
    if not is_used.all() and state.shape[-1] == len(is_used):
        state = state[..., is_used]
    parts = [state, np.asarray(desired_preview, dtype=float)]
    if features is not None and parameters.is_sharpened:
        parts.append(np.asarray(features, dtype=float))
        if parameters.feature_unit:
            parts.append(np.arcsinh(parts[2] / parameters.feature_unit))
    return np.concatenate(parts, axis=-1)


def num_inputs(info: EpisodesInfo, parameters: AssessmentParameters) -> int:
    """Returns n_x, the width of x."""
    width = int(used_states(info, parameters).sum()) + info.horizon * len(info.output_names)
    if parameters.is_sharpened:
        width += len(info.feature_names) * (2 if parameters.feature_unit else 1)
    return width


def input_names(info: EpisodesInfo, parameters: AssessmentParameters) -> list[str]:
    """Returns the names of the columns of x, (n_x,); previews are counted from 0."""
    is_used = used_states(info, parameters)
    names = [name for name, used in zip(info.state_names, is_used, strict=True) if used]
    names += [f"desired {name} [{k}]" for k in range(info.horizon) for name in info.output_names]
    if parameters.is_sharpened:
        names += info.feature_names
        names += [f"asinh {name}" for name in info.feature_names if parameters.feature_unit]
    return names


def check_width(num_columns: int, info: EpisodesInfo, parameters: AssessmentParameters) -> None:
    """Checks the width of x.

    Raises:
        ValueError: The number of columns is not n_x.
    """
    if num_columns != num_inputs(info, parameters):
        num_features = len(info.feature_names) if parameters.is_sharpened else 0
        raise ValueError(
            f"SafetyAssessment of '{info.scenario}': the input has {num_columns} columns, "
            f"expected {used_states(info, parameters).sum()} of the state, "
            f"{info.horizon * len(info.output_names)} of the desired preview and "
            f"{num_features} features{' twice' if parameters.feature_unit else ''}"
        )
