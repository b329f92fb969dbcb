"""Which hand reaches, and what is told of it from the side of the hand that was trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.plants.pushes import Push


class ReachingSide:
    """The hand that reaches: the trained one, or its mirror image.

    Args:
        kinematics: Of the robot.
        trained_hand: The hand that an assessment is about.
        hand: The one that reaches; the trained one by default.
        scenario_name: For messages.

    Raises:
        ValueError: An unknown hand, or one that is neither the trained one nor its mirror image.

    Attributes:
        hand: The one that reaches.
        mirror: The reflection to the trained hand's side; None on that side itself.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        trained_hand: str,
        hand: str | None,
        *,
        scenario_name: str,
    ):
        robot = kinematics.robot
        self._kinematics = kinematics
        self.hand = trained_hand if hand is None else hand
        for name in (trained_hand, self.hand):
            robot.reaching_frame(name)
        self.mirror = None if self.hand == trained_hand else Mirror(kinematics)
        if self.mirror is not None and self.mirror.hand(trained_hand) != self.hand:
            raise ValueError(
                f"reaching: scenario '{scenario_name}' is about hand '{trained_hand}' of robot "
                f"'{robot.name}' and its mirror image '{self.mirror.hand(trained_hand)}'; got "
                f"'{self.hand}'"
            )

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) that are told of the trained hand, or the other way round."""
        return points if self.mirror is None else self.mirror.points(points)

    def push(self, push: Push) -> Push:
        """A push that is told of the trained hand's side."""
        force_n = self.points(np.array(push.force_n))
        return replace(push, force_n=force_n.tolist())

    @property
    def other_hand(self) -> str | None:
        """The hand on the other side, if the robot has one there."""
        try:
            return Mirror(self._kinematics).hand(self.hand)
        except ValueError:  # No mirror, or nothing in it.
            return None
