"""What a reaching episode draws at random: a standing posture, a target and a detour."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import NUM_BASE_POSITIONS
from drake_safety.control.mirror import Mirror
from drake_safety.control.reaching_safe_set import ReachingSafeSet

_MAX_TRIES = 100


@dataclass(kw_only=True)
class PostureSampling:
    """Random standing postures. Half-widths about the standing one, unless it says otherwise."""

    base_offset_m: list[float] = field(default_factory=lambda: [0.02, 0.02])
    """Along x and along y."""
    base_lowering_m: float = 0.08
    """How far at most the base is lowered."""
    tilt_rad: float = 0.03
    """Of roll, pitch and yaw of the base, each."""
    joint_offset_rad: float = 0.1
    """Of every joint that belongs to no leg."""
    clearance_m: float = 0.02
    """Least distance of the arms to an obstacle."""
    joint_margin_rad: float = 0.0
    """Least distance of every joint to the end of its safe range."""
    sink_m: float = 0.0
    """How deep the contact points begin in the compliant ground: as deep as they are when the robot
    stands. Where they only touch it, nothing carries the robot in the plant's first step, and
    torques that count on the ground turn the feet into it."""

    def __post_init__(self) -> None:
        if len(self.base_offset_m) != 2:
            raise ValueError(f"start: base_offset_m must be [x, y]; got {self.base_offset_m}")
        for name in (
            "base_offset_m",
            "base_lowering_m",
            "tilt_rad",
            "joint_offset_rad",
            "clearance_m",
            "joint_margin_rad",
            "sink_m",
        ):
            value = np.asarray(getattr(self, name), dtype=float)
            if not ((value >= 0) & np.isfinite(value)).all():
                raise ValueError(
                    f"start: {name} must be finite and not negative; got {getattr(self, name)}"
                )

    def sample(
        self, safe_set: ReachingSafeSet, rng: np.random.Generator, mirror: Mirror | None = None
    ) -> np.ndarray:
        """Positions in the safe set with the feet where they stand, (n_q,).

        Args:
            safe_set: Of the robot and its obstacles.
            rng: Source of every draw.
            mirror: Where it is not the trained hand that reaches: the other one begins with the
                mirror image of what the trained hand's episode of these draws begins with.

        Raises:
            RuntimeError: No posture that is drawn is in the safe set.
        """
        kinematics = safe_set.kinematics
        robot = kinematics.robot
        legs = {name for foot in robot.feet.values() for name in foot.joints}
        is_free = np.array([name not in legs for name in kinematics.joint_names])
        standing = kinematics.standing_positions()
        p_WC = kinematics.contact_positions(standing)
        v = np.zeros(kinematics.num_velocities)
        for _ in range(_MAX_TRIES):
            joints = kinematics.posture + is_free * self.joint_offset_rad * rng.uniform(
                -1, 1, kinematics.num_joints
            )
            offset = np.append(
                rng.uniform(-1, 1, 2) * self.base_offset_m,
                -rng.uniform(0, self.base_lowering_m),
            )
            rotation = RollPitchYaw(rng.uniform(-1, 1, 3) * self.tilt_rad)
            X_WB = RigidTransform(RotationMatrix(rotation), standing[4:NUM_BASE_POSITIONS] + offset)
            joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, joints)
            q = kinematics.positions_at(X_WB, joints)
            if mirror is not None:
                q, _ = mirror.plant_state(q, v, np.zeros(3))
            margins = safe_set.margins(q, v)
            clearance = margins[safe_set.names.index("collision")]
            stops = margins[safe_set.names.index("joint_limits")]
            is_clear = clearance >= self.clearance_m and stops >= self.joint_margin_rad
            if is_clear and margins.min() > 0:
                return q
        raise RuntimeError(
            f"reaching: none of {_MAX_TRIES} random postures of robot '{robot.name}' is in "
            f"the safe set with a clearance of {self.clearance_m} m and "
            f"{self.joint_margin_rad} rad off the joints' stops: narrow 'start'"
        )


@dataclass(kw_only=True)
class TargetSampling:
    """The box that targets of the trained hand are drawn from, in the world [m].

    The other hand's targets come from its mirror image.
    """

    x_m: list[float] = field(default_factory=lambda: [0.45, 1.0])
    y_m: list[float] = field(default_factory=lambda: [-0.3, 1.3])
    z_m: list[float] = field(default_factory=lambda: [0.5, 1.6])

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            bounds = getattr(self, name)
            if len(bounds) != 2 or not -np.inf < bounds[0] < bounds[1] < np.inf:
                raise ValueError(f"target: {name} must be [lowest, highest], finite; got {bounds}")

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner, (2, 3) [m]."""
        return np.array([self.x_m, self.y_m, self.z_m], dtype=float).T


@dataclass(kw_only=True)
class FairTargets:
    """The part of the target box in which a verdict is neither trivial nor absurd, in the world.

    Bounds that are left empty are the target box's own.
    """

    x_m: list[float] = field(default_factory=list)
    y_m: list[float] = field(default_factory=list)
    z_m: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            bounds = getattr(self, name)
            if bounds and (len(bounds) != 2 or not bounds[0] < bounds[1]):
                raise ValueError(f"fair: {name} must be [lowest, highest] or empty; got {bounds}")

    def box(self, target: TargetSampling) -> np.ndarray:
        """Lowest and highest corner, (2, 3) [m]."""
        bounds = [getattr(self, name) or getattr(target, name) for name in ("x_m", "y_m", "z_m")]
        return np.array(bounds, dtype=float).T


@dataclass(kw_only=True)
class Detours:
    """Plans beside the straight line, so that Γ can judge and choose among them.

    A detour is how far the plan's middle lies beside the straight line's, in the stance frame of
    the trained hand [m]: x forwards, y to the left, z up.
    """

    share: float = 0.0
    """Share of the training episodes whose plan makes one."""
    lowest_m: list[float] = field(default_factory=lambda: [-0.3, -0.2, -0.1])
    highest_m: list[float] = field(default_factory=lambda: [0.0, 0.2, 0.3])

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise ValueError(f"detours: share must be in [0, 1); got {self.share}")
        lowest, highest = np.asarray(self.lowest_m), np.asarray(self.highest_m)
        if lowest.shape != (3,) or highest.shape != (3,) or not (lowest <= highest).all():
            raise ValueError(
                "detours: lowest_m and highest_m must be three numbers each, lowest <= highest; "
                f"got {self.lowest_m} and {self.highest_m}"
            )

    def sample(self, rng: np.random.Generator) -> np.ndarray | None:
        """The detour of an episode, (3,) [m], or None for the straight line.

        Args:
            rng: Source of every draw.
        """
        if rng.random() >= self.share:
            return None
        return self.draw(rng)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """A detour, whatever the share of episodes that make one, (3,) [m].

        Args:
            rng: Source of every draw.
        """
        return rng.uniform(self.lowest_m, self.highest_m)
