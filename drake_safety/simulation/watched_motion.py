"""What somebody who watches a robot sees of a motion, and when it went wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_safety.simulation.goal_motion import GoalMotion, Mishap
from drake_safety.simulation.throws import ThrowLog

SEEN = ("state", "desired_preview", "features")
"""Output ports that a monitor sees."""


@dataclass(kw_only=True, eq=False)
class WatchedMotion(Mishap):
    """One motion, pushed or not: rows of what a monitor sees, and what came of it.

    Attributes:
        index: Number of the motion in its set; what begins alike has the same.
        push_time_s: When the push begins [s]; infinite if nobody pushes.
        time_s: [s], (N,).
        state: (N, n_s), as the assessor sees it.
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
        """A throw without recovery; the push is the ball's touch."""
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
        """A motion to a goal that was run with the ports that a monitor sees."""
        return cls(
            index=index,
            push_time_s=math.inf if motion.push is None else motion.push.time_s,
            time_s=motion.time_s,
            margins=motion.margins,
            leave_time_s=motion.leave_time_s,
            fall_time_s=motion.fall_time_s,
            **{name: motion.extra[name] for name in SEEN},
        )
