"""A mass on a spring that follows a goal: its motions, and what a monitor learns of them."""

import dataclasses

import numpy as np

from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo

STEP_S, HORIZON = 0.05, 3
INFO = EpisodesInfo(
    scenario="spring",
    scenario_hash="0" * 64,
    variation="nominal",
    seed=0,
    step_s=STEP_S,
    horizon=HORIZON,
    constraint_names=["reach"],
    state_names=["knee", "knee_rate"],
    output_names=["goal"],
    feature_names=["load", "light"],
    versions={},
    num_steps=0,
    preview_stride=1,
    monitored_states=None,
    monitored_features=["load"],
)


def motion(duration_s, seed, pushed=slice(0, 0), force=0.4):
    """Rows (state, desired preview, features); a force acts on the rows `pushed`."""
    rng = np.random.default_rng(seed)
    num = round(duration_s / STEP_S)
    goal = np.repeat(rng.uniform(-1.0, 1.0, num // 20 + 2), 20)
    s, rows = np.zeros(2), np.zeros((num, 2 + HORIZON + 2))
    acting = np.zeros(num)
    acting[pushed] = force
    for k in range(num):
        rows[k, :2] = s + rng.normal(scale=0.01, size=2)
        rows[k, 2 : 2 + HORIZON] = goal[k : k + HORIZON]
        rows[k, 2 + HORIZON] = goal[k] - s[0]
        s = s + STEP_S * np.array([s[1], 20.0 * (goal[k] - s[0]) - 6.0 * s[1] + 10.0 * acting[k]])
    return rows


def episodes(durations_s):
    found = []
    for index, duration_s in enumerate(durations_s):
        rows = motion(duration_s, index)
        state, preview, features = np.split(rows, [2, 2 + HORIZON], axis=1)
        found.append(
            Episode(
                index=index,
                time_s=STEP_S * np.arange(len(rows)),
                state=state,
                true_state=state,
                output=state[:, :1],
                desired_output=preview[:, :1],
                desired_preview=preview,
                features=features,
                margins=np.ones((len(rows), 1)),
                is_safe=True,
                cause="",
                first_step=0,
            )
        )
    return Episodes(INFO, found)


def learned():
    """A detector with limits, of two minutes of motion."""
    found = ChangeDetector.fit(episodes([20.0] * 6))
    return dataclasses.replace(found, alarm_level=1.0)
