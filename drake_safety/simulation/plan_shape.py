"""The shape of a plan to a goal, found again in what is seen of it: start, goal and detour."""

import numpy as np

from drake_safety.systems.trajectory_planner import interpolate


def plan_shape(preview: np.ndarray, step_s: float, duration_s: float) -> np.ndarray:
    """Start, goal and detour of a plan, from its first samples.

    The plan is one of :func:`~drake_safety.systems.trajectory_planner.interpolate`.

    Args:
        preview: Samples from the plan's begin on; they may end before it does, (M, n_z) [m].
        step_s: Time between them [s].
        duration_s: Duration of the whole plan [s].

    Returns:
        One a row, (3, n_z) [m].
    """
    seen_s = step_s * np.arange(len(preview))
    motion = interpolate(np.zeros(1), np.ones(1), duration_s)
    progress = motion.vector_values(seen_s.tolist()).ravel()
    shape, *_ = np.linalg.lstsq(_shares(progress), preview, rcond=None)
    return shape


def points_of_plan(shape: np.ndarray, num_points: int) -> np.ndarray:
    """Points of a plan from its start to its goal, evenly spread over its progress.

    Args:
        shape: Start, goal and detour, (3, n_z) [m].
        num_points: M.

    Returns:
        The points, (M, n_z) [m].
    """
    return _shares(np.linspace(0, 1, num_points)) @ shape


def _shares(progress: np.ndarray) -> np.ndarray:
    """Shares of start, goal and detour in a plan's points, (M, 3); see ``interpolate``."""
    return np.stack([1 - progress, progress, 4 * progress * (1 - progress)], axis=1)
