"""Reachability of points by inverse kinematics alone: a baseline for verdicts on targets."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.solvers import SnoptSolver

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot_model import RobotModel

BASELINES = {"reachability": False, "reachability_free": True}
"""Baselines by inverse kinematics, and whether the base moves in each."""
_TOLERANCE_M = 2e-3  # Well above the residual of the solver at a reachable point.


class Reachability:
    """Tests whether a hand reaches a point within joint limits while the feet stand still.

    The joints between base and hand move, the others are locked in the standing posture. With a
    free base, the base and all joints move, and the feet's contact points stay where they are.
    Balance, obstacles and motion are not considered.

    Args:
        robot: The robot, which stands at the world's origin.
        hand: Name of the reaching frame.
        is_base_free: Whether the base moves.
    """

    def __init__(self, robot: RobotModel, hand: str, *, is_base_free: bool = False):
        frame = robot.reaching_frame(hand)
        kinematics = RobotKinematics(robot)
        plant = self._plant = kinematics.plant
        self._context = kinematics.context
        self._body = plant.GetBodyByName(frame.body)
        self._point = np.array(frame.point, dtype=float)
        standing = kinematics.standing_positions()
        kinematics.set_positions(standing)
        middle = standing.copy()
        self.joint_names = []
        """Names of the joints between base and hand, which move."""
        for index in plant.GetJointIndices(plant.GetModelInstanceByName(robot.name)):
            joint = plant.get_joint(index)
            if joint.num_velocities() == 0:
                continue
            moves_hand = self._body.index() in plant.GetBodiesKinematicallyAffectedBy([index])
            if is_base_free and joint.num_velocities() > 1:
                continue
            if (moves_hand or is_base_free) and joint.num_velocities() == 1:
                self.joint_names.append(joint.name())
                low, high = joint.position_lower_limit(), joint.position_upper_limit()
                if np.isfinite(high - low):
                    middle[joint.position_start()] = 0.5 * (low + high)
            else:
                joint.Lock(self._context)
        # The middle posture of a free robot has its feet elsewhere.
        self._guesses = (standing,) if is_base_free else (standing, middle)
        self._contacts = []
        """Bodies and points of the feet, in the body and in the world, that stay in place."""
        if is_base_free:
            for foot in robot.feet.values():
                body = plant.GetBodyByName(foot.body)
                X_WF = body.EvalPoseInWorld(self._context)
                self._contacts += [
                    (body, np.array(point), X_WF @ np.array(point)) for point in foot.contact_points
                ]

    def miss(self, p_WH: np.ndarray) -> float:
        """Distance between a point in the world, (3,), and the closest position of the hand [m]."""
        search = InverseKinematics(self._plant, self._context)
        search.AddPositionCost(
            self._plant.world_frame(), p_WH, self._body.body_frame(), self._point, np.eye(3)
        )
        for body, point, p_WC in self._contacts:
            search.AddPositionConstraint(
                body.body_frame(),
                point,
                self._plant.world_frame(),
                p_WC - _TOLERANCE_M,
                p_WC + _TOLERANCE_M,
            )
        best = np.inf
        for guess in self._guesses:
            result = SnoptSolver().Solve(search.prog(), guess)
            if self._contacts and not result.is_success():
                continue
            self._plant.SetPositions(self._context, result.GetSolution(search.q()))
            reached = self._body.EvalPoseInWorld(self._context) @ self._point
            best = min(best, float(np.linalg.norm(reached - p_WH)))
            if best < _TOLERANCE_M:
                break
        return best

    def is_reachable(self, p_WH: np.ndarray) -> np.ndarray:
        """Whether the hand reaches each of the points (N, 3) in the world [m], (N,)."""
        return np.array([self.miss(point) < _TOLERANCE_M for point in p_WH], dtype=bool)
