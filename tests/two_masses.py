"""Two masses on springs that follow goals, as undisturbed motions, and what was learned of them."""

import functools

import numpy as np

from drake_safety.learning.change_detector import LEAST_MOTION_S, ChangeDetector
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo

STEP_S, MOTION_S = 0.05, 60.0
A = np.array([[1, 0, 0.05, 0], [0, 1, 0, 0.05], [-0.3, 0, 0.9, 0.02], [0, -0.3, 0.02, 0.9]])
WATCHED = ["a", "b", "a_rate", "b_rate"]
INFO = EpisodesInfo(
    scenario="two_masses",
    scenario_hash="0" * 64,
    variation="nominal",
    seed=0,
    step_s=STEP_S,
    horizon=3,
    constraint_names=["edge"],
    state_names=["dust", *WATCHED],
    output_names=["goal_a", "goal_b"],
    feature_names=["hum", "drive"],
    versions={},
    monitored_states=WATCHED,
    monitored_features=["drive"],
)
NUM_STATES, NUM_SEEN = len(INFO.state_names), len(INFO.state_names) + 6


def motions(num, seed, *, force=(0.0, 0.0), plant=A, noise=0.002, duration_s=MOTION_S):
    """Rows of (state, desired preview, features) of motions, (K, 13) each."""
    rng = np.random.default_rng(seed)
    rows = round(duration_s / STEP_S)
    goals = np.repeat(rng.normal(scale=0.1, size=(num, rows // 40 + 1, 2)), 40, axis=1)[:, :rows]
    s, states = np.zeros((num, 4)), []
    for goal in goals.swapaxes(0, 1):
        states.append(s + rng.normal(scale=noise, size=s.shape))
        s = s @ plant.T + np.append(np.zeros_like(goal), 0.3 * goal + force, axis=1)
        s = s + rng.normal(scale=0.001, size=s.shape)
    dust, hum = rng.normal(size=(2, num, rows, 1))
    drive = goals.sum(axis=2, keepdims=True)
    columns = (dust, np.stack(states, axis=1), goals, goals, goals, hum, drive)
    return list(np.concatenate(columns, axis=2))


def recorded(rows, info=INFO, **changes):
    """Motions as episodes that stay in the safe set."""
    episodes = []
    for i, one in enumerate(rows):
        state, preview, features = np.split(one, [NUM_STATES, NUM_SEEN], axis=1)
        arrays = dict(state=state, true_state=state, output=preview[:, :2], features=features)
        arrays |= dict(desired_output=preview[:, :2], desired_preview=preview)
        arrays |= dict(time_s=STEP_S * np.arange(len(one)), margins=np.ones((len(one), 1)))
        ending = dict(is_safe=True, cause="", first_step=0) | changes
        episodes.append(Episode(index=i, **arrays, **ending))
    return Episodes(info, episodes)


@functools.cache
def detector():
    """What was learned of more motion than its limits need."""
    return ChangeDetector.fit(recorded(motions(round(3.0 * LEAST_MOTION_S / MOTION_S), 1)))
