"""Starts of episodes: a plant state and a plan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics, fit_stance

_DRIFT, _ROUNDING = 0.2, 1e-6  # Errors of a quaternion's norm.


@dataclass(kw_only=True, eq=False)
class EpisodeStart:
    """A plant state and a plan, from which an episode or its nominal twin starts.

    ``q`` and ``v`` are in Drake's order, base first; the plan is of the output since the start, in
    the stance frame, (n_z, 1) [m]. ``foot_positions`` (n_c, 3) [m] are the controller's centres of
    the contact spheres, by default the feet of ``q``, put on the ground. ``controller_state`` is
    the controller's memory, such as the phase of a gait.

    Example: ``moving = EpisodeStart(q=start.q, v=start.v + 0.1, plan=start.plan)``
    """

    q: np.ndarray
    v: np.ndarray
    plan: PiecewisePolynomial
    foot_positions: np.ndarray | None = None
    controller_state: np.ndarray | None = None

    def feet(self, kinematics: RobotKinematics) -> np.ndarray:
        """Foot positions, (n_c, 3) [m]."""
        stated = self.foot_positions
        return kinematics.planted_contacts(self.q) if stated is None else stated

    def stance_pose(self, kinematics: RobotKinematics) -> np.ndarray:
        """Pose of the plan's frame, [x, y, yaw] in the world (3,) [m, rad]."""
        return fit_stance(self.feet(kinematics), kinematics.nominal_contacts)

    def check(self, who: str, num_positions: int, num_velocities: int) -> None:
        """Raises a ValueError that names ``who`` if q or v has another size or is not finite."""
        for name, size in {"q": num_positions, "v": num_velocities}.items():
            value = getattr(self, name)
            if np.shape(value) != (size,) or not np.isfinite(value).all():
                raise ValueError(f"{who}: {name} must be {size} finite numbers; got {value}")

    def of_robot(self, kinematics: RobotKinematics) -> EpisodeStart:
        """Checks that the start fits a robot, and returns it with a quaternion of unit norm."""
        who = f"start of robot '{kinematics.robot.name}'"
        self.check(who, kinematics.num_positions, kinematics.num_velocities)
        norm = float(np.linalg.norm(self.q[:4]))
        if not abs(norm - 1.0) < _DRIFT:
            raise ValueError(f"{who}: the quaternion must have a norm of 1; got {norm}")
        feet = self.foot_positions
        if feet is not None and (
            np.shape(feet) != (kinematics.num_contacts, 3) or not np.isfinite(feet).all()
        ):
            raise ValueError(f"{who}: expected {kinematics.num_contacts} finite foot_positions")
        if abs(norm - 1.0) < _ROUNDING:
            return self
        return replace(self, q=np.concatenate([self.q[:4] / norm, self.q[4:]]))
