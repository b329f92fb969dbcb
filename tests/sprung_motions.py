"""A mass on a spring that follows a goal: its motions, and what a monitor learns of them."""

import functools

import numpy as np

from cart_episodes import make_info
from drake_safety.learning.change_detector import LEAST_MOTION_S, ChangeDetector
from drake_safety.learning.segments import Episode, Episodes

STEP_S, HORIZON, MOTION_S = 0.05, 3, 60.0
INFO = make_info(
    step_s=STEP_S,
    horizon=HORIZON,
    constraint_names=["reach"],
    state_names=["knee", "knee_rate"],
    output_names=["goal"],
    feature_names=["load", "light"],
    monitored_features=["load"],
)


def motion(duration_s, seed, pushed=slice(0, 0), force=0.4, *, noise=0.01, damping=6.0):
    """Rows (state, desired preview, features); a force acts on the rows `pushed`."""
    rng = np.random.default_rng(seed)
    num = round(duration_s / STEP_S)
    goal = np.repeat(rng.uniform(-1.0, 1.0, num // 20 + 2), 20)
    s, rows = np.zeros(2), np.zeros((num, 2 + HORIZON + 2))
    noises, acting = rng.normal(scale=noise, size=(num, 2)), np.zeros(num)
    acting[pushed] = force
    for k in range(num):
        rows[k, :2] = s + noises[k]
        rows[k, 2 : 2 + HORIZON] = goal[k : k + HORIZON]
        rows[k, 2 + HORIZON :] = goal[k] - s[0], rng.random()
        pull = 20.0 * (goal[k] - s[0]) - damping * s[1] + 10.0 * acting[k]
        s = s + STEP_S * np.array([s[1], pull])
    return rows


def recorded(rows, info=INFO, **changes):
    """Motions as episodes that stay in the safe set."""
    found = []
    for index, one in enumerate(rows):
        state, preview, features = np.split(one, [2, 2 + HORIZON], axis=1)
        arrays = dict(state=state, true_state=state, output=state[:, :1], features=features)
        arrays |= dict(desired_output=preview[:, :1], desired_preview=preview)
        arrays |= dict(time_s=STEP_S * np.arange(len(one)), margins=np.ones((len(one), 1)))
        ending = dict(is_safe=True, cause="", first_step=0) | changes
        found.append(Episode(index=index, **arrays, **ending))
    return Episodes(info, found)


def same_detector(one, other):
    known, found = one.arrays(), other.arrays()
    if known.keys() != found.keys():
        return False
    return all(np.array_equal(known[name], found[name], equal_nan=True) for name in known)


@functools.cache
def learned():
    """A detector, of more motion than its limits need."""
    num = round(4.0 * LEAST_MOTION_S / MOTION_S)
    return ChangeDetector.fit(recorded([motion(MOTION_S, seed) for seed in range(num)]))
