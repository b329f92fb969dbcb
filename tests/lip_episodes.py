"""Stand-in data: a linear inverted pendulum that tracks a reference, as episodes.

The point mass stands on a rectangular support; a capture-point controller with a saturated centre
of pressure moves it to a target, a second-order law its height. It is unsafe to leave the support
or the height band.
"""

import numpy as np

from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo

SUPPORT = np.array([0.20, 0.12])
HEIGHTS = (0.30, 0.50)
STEP_S, NUM_STEPS, HORIZON = 0.04, 50, 10
_OMEGA = np.sqrt(9.81 / 0.42)
_SUBSTEPS = 8


def make_episodes(num_episodes: int, *, seed: int = 0, noise: float = 0.0) -> Episodes:
    """Rolls out `num_episodes` pendulums."""
    seeds = [np.random.SeedSequence(seed, spawn_key=(i,)) for i in range(num_episodes)]
    normal = np.stack([np.random.default_rng(s).normal(size=(NUM_STEPS + 2, 24)) for s in seeds])
    start = np.clip(normal[:, 0, :3] * [0.05, 0.03, 0.03], -0.15, 0.15) + [0.0, 0.0, 0.42]
    velocity = normal[:, 0, 3:6] * [0.45, 0.30, 0.25]
    target = np.clip(normal[:, 0, 6:9] * [0.10, 0.06, 0.03], -0.2, 0.2) + [0.0, 0.0, 0.42]
    steps = np.arange(NUM_STEPS + 1 + HORIZON)
    blend = np.clip(steps / 30.0, 0.0, 1.0)
    blend = blend**2 * (3.0 - 2.0 * blend)
    desired = start[:, None] + (target - start)[:, None] * blend[None, :, None]

    states = np.empty((num_episodes, NUM_STEPS + 1, 6))
    p, v = start.copy(), velocity.copy()
    for k in range(NUM_STEPS + 1):
        states[:, k, :3], states[:, k, 3:] = p, v
        dt = STEP_S / _SUBSTEPS
        gust = 0.05 * normal[:, k + 1, :3]
        for _ in range(_SUBSTEPS):
            capture = p[:, :2] + v[:, :2] / _OMEGA
            pressure = capture + 1.5 * (capture - desired[:, k, :2])
            pressure = np.clip(pressure, -SUPPORT * 0.75, SUPPORT * 0.75)
            horizontal = _OMEGA**2 * (p[:, :2] - pressure)
            vertical = np.clip(80.0 * (desired[:, k, 2] - p[:, 2]) - 12.0 * v[:, 2], -4.0, 4.0)
            v = v + dt * (np.column_stack([horizontal, vertical]) + gust)
            p = p + dt * v

    episodes = []
    for i in range(num_episodes):
        true_state = states[i]
        margins = _margins(true_state)
        violated = np.flatnonzero((margins < 0.0).any(axis=1))
        is_safe = violated.size == 0
        last = NUM_STEPS if is_safe else int(violated[0])
        rows = slice(0, last + 1)
        seen = true_state[rows] + noise * normal[i, 1 : last + 2, 9:15]
        windows = np.stack([desired[i, r : r + HORIZON].ravel() for r in range(last + 1)])
        episodes.append(
            Episode(
                index=i,
                time_s=STEP_S * np.arange(last + 1),
                state=seen,
                true_state=true_state[rows].copy(),
                output=true_state[rows, :3].copy(),
                desired_output=desired[i, : last + 1].copy(),
                desired_preview=windows,
                features=_features(seen, desired[i, : last + 1]),
                margins=margins[rows],
                is_safe=is_safe,
                cause="" if is_safe else ("support", "height")[int(np.argmin(margins[last]))],
            )
        )
    info = EpisodesInfo(
        scenario="lip",
        scenario_hash="0" * 64,
        variation="nominal",
        seed=seed,
        step_s=STEP_S,
        horizon=HORIZON,
        constraint_names=["support", "height"],
        state_names=[f"state_{i}" for i in range(6)],
        output_names=["x", "y", "z"],
        feature_names=[f"feature_{i}" for i in range(5)],
        versions={"lip": "1"},
        num_steps=NUM_STEPS,
    )
    return Episodes(info, episodes)


def _margins(state: np.ndarray) -> np.ndarray:
    support = (SUPPORT - np.abs(state[:, :2])).min(axis=1)
    height = np.minimum(state[:, 2] - HEIGHTS[0], HEIGHTS[1] - state[:, 2])
    return np.column_stack([support, height])


def _features(state: np.ndarray, desired: np.ndarray) -> np.ndarray:
    capture = SUPPORT - np.abs(state[:, :2] + state[:, 3:5] / _OMEGA)
    error = np.linalg.norm(desired - state[:, :3], axis=1)
    return np.column_stack([_margins(state), capture, error])
