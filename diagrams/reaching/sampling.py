"""Random postures, targets and detours of the reaching task."""

from dataclasses import field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import NUM_BASE_POSITIONS
from drake_safety.control.mirror import Mirror
from drake_safety.diagrams.reaching.safe_set import ReachingSafeSet
from drake_safety.files.schema import Interval, NotNegative, Pair, ShareBelowOne, Triple, schema

_MAX_TRIES = 100


@schema(kw_only=True)
class PostureSampling:
    """Random standing postures. Offsets are half-widths about the standing posture."""

    base_offset_m: Pair[NotNegative] = field(default_factory=lambda: [0.02, 0.02])
    base_lowering_m: NotNegative = 0.08
    tilt_rad: NotNegative = 0.03  # Half-width of roll, pitch and yaw of the base, each.
    joint_offset_rad: NotNegative = 0.1  # Half-width for every joint outside the legs.
    clearance_m: NotNegative = 0.02  # Least distance of the arms to an obstacle.
    joint_margin_rad: NotNegative = 0.0  # Least distance of joints to the end of the safe range.
    sink_m: NotNegative = 0.0  # Initial penetration into the compliant ground, as at rest.

    def sample(
        self, safe_set: ReachingSafeSet, rng: np.random.Generator, mirror: Mirror | None = None
    ) -> np.ndarray:
        """Samples positions (n_q,), perhaps mirrored, in the safe set with standing feet."""
        kinematics = safe_set.kinematics
        legs = {name for foot in kinematics.robot.feet.values() for name in foot.joints}
        is_free = np.array([name not in legs for name in kinematics.joint_names])
        standing = kinematics.standing_positions()
        p_WC = kinematics.contact_positions(standing)
        v = np.zeros(kinematics.num_velocities)
        least = np.zeros(len(safe_set.names))
        least[safe_set.names.index("collision")] = self.clearance_m
        least[safe_set.names.index("joint_limits")] = self.joint_margin_rad
        for _ in range(_MAX_TRIES):
            joints = kinematics.posture + is_free * self.joint_offset_rad * rng.uniform(
                -1, 1, kinematics.num_joints
            )
            offset = np.append(
                rng.uniform(-1, 1, 2) * self.base_offset_m, -rng.uniform(0, self.base_lowering_m)
            )
            rotation = RollPitchYaw(rng.uniform(-1, 1, 3) * self.tilt_rad)
            X_WB = RigidTransform(RotationMatrix(rotation), standing[4:NUM_BASE_POSITIONS] + offset)
            joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, joints)
            q = kinematics.positions_at(X_WB, joints)
            if mirror is not None:
                q, _ = mirror.plant_state(q, v, np.zeros(3))
            margins = safe_set.margins(q, v)
            if margins.min() > 0 and np.all(margins >= least):
                return q
        text = f"none of {_MAX_TRIES} random postures is in the safe set: narrow 'start'"
        raise RuntimeError(f"reaching: {text}")


@schema(kw_only=True)
class TargetSampling:
    """The box of the trained hand's targets in the world [m]; the other hand's is mirrored."""

    x_m: Interval = field(default_factory=lambda: [0.45, 1.0])
    y_m: Interval = field(default_factory=lambda: [-0.3, 1.3])
    z_m: Interval = field(default_factory=lambda: [0.5, 1.6])

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner, (2, 3) [m]."""
        return np.array([self.x_m, self.y_m, self.z_m], dtype=float).T


@schema(kw_only=True)
class Detours:
    """Random offsets of the middle of training plans, in the trained hand's stance frame [m]."""

    share: ShareBelowOne = 0.0
    lowest_m: Triple = field(default_factory=lambda: [-0.3, -0.2, -0.1])
    highest_m: Triple = field(default_factory=lambda: [0.0, 0.2, 0.3])

    def sample(self, rng: np.random.Generator) -> np.ndarray | None:
        """Samples the detour of an episode, (3,) [m]; None for the straight line."""
        return None if rng.random() >= self.share else rng.uniform(self.lowest_m, self.highest_m)
