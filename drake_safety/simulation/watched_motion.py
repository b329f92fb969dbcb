"""Motions as a monitor sees them, with the outcome."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_safety.simulation.goal_motion import GoalMotion, Mishap
from drake_safety.simulation.throws import ThrowLog

SEEN = ("state", "desired_preview", "features")
"""Output ports that are a monitor's inputs."""


@dataclass(kw_only=True, eq=False)
class WatchedMotion(Mishap):
    """One motion, pushed or not: the monitor's inputs and the outcome.

    Attributes:
        index: Number of the motion in its set; an undisturbed and a pushed one share it.
        push_time_s: Start of the push [s]; infinite without one.
        time_s: [s], (N,).
        state: (N, n_s), the assessor's input.
        desired_preview: (N, H n_z).
        features: (N, n_f).
        margins: (N, n_c), of the true state.
    """

    index: int
    push_time_s: float
    time_s: np.ndarray
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    margins: np.ndarray

    @classmethod
    def of_throw(cls, log: ThrowLog) -> WatchedMotion:
        """Makes a motion of a throw without recovery; the push is the ball's impact."""
        return cls(
            index=log.index,
            push_time_s=log.throw.time_s,
            time_s=log.time_s,
            state=log.state,
            desired_preview=log.desired_preview,
            features=log.features,
            margins=log.margins,
            leave_time_s=log.leave_time_s,
            fall_time_s=log.fall_time_s,
        )

    @classmethod
    def of_goal_motion(cls, index: int, motion: GoalMotion) -> WatchedMotion:
        """Makes a motion of a motion to a goal that was logged with the ports ``SEEN``."""
        return cls(
            index=index,
            push_time_s=math.inf if motion.push is None else motion.push.time_s,
            time_s=motion.time_s,
            margins=motion.margins,
            leave_time_s=motion.leave_time_s,
            fall_time_s=motion.fall_time_s,
            **{name: motion.extra[name] for name in SEEN},
        )
