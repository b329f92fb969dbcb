"""The safe set of a walking robot: upright, high enough, and only its feet on the ground."""

import math
from collections.abc import Sequence
from dataclasses import field
from types import MappingProxyType
from typing import Annotated

import numpy as np
from pydantic import Field

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics, is_state
from drake_safety.control.observation import heading_velocity
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon
from drake_safety.files.schema import schema
from drake_safety.robots.robot_size import GRAVITY_M_S2

_AXES = ("forward", "left", "yaw")


@schema(kw_only=True)
class WalkingLimits:
    """Limits of :class:`WalkingSafeSet`; heights are shares of the standing height."""

    tilt_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 0.7
    height_share: float = 0.6
    # Least height of the origins of bodies that must not touch the ground, by name.
    clearance_m: dict[str, float] = field(default_factory=dict)
    stop_rad: float = 0.1  # How far a joint may be beyond a stop, which in simulation is soft.
    fall_height_share: float = 0.45
    fall_tilt_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 1.2

    def __post_init__(self) -> None:
        if not 0 < self.fall_height_share <= self.height_share < 1:
            raise ValueError("heights must be 0 < fall_height_share <= height_share < 1")
        if not self.tilt_rad <= self.fall_tilt_rad:
            raise ValueError("tilt_rad must not exceed fall_tilt_rad")


class WalkingSafeSet:
    """Safe set of a walking robot.

    - ``tilt``: angle left until ``tilt_rad`` [rad];
    - ``height``: height of the base over ``height_share`` of the standing height [m];
    - ``clearance``: least height of a listed body's origin over its limit [m];
    - ``joint_limits``: distance of the joint nearest to a stop, more ``stop_rad`` [rad];
    - ``fall``: the smaller of the height over the fallen height [m] and the tilt left until
      ``fall_tilt_rad``, times the standing height [m].
    """

    names = ("tilt", "height", "clearance", "joint_limits", "fall")
    fall_name = "fall"
    angular_names = ("tilt", "joint_limits")
    command_features = tuple(
        f"{kind}_{axis}"
        for kind in ("command", "last_command", "largest_command", "tracking_error")
        for axis in _AXES
    )
    watched_features = MappingProxyType(
        {"tilt": "tilt_margin", "capture_point_margin": "capture_point_support"}
    )

    def __init__(self, kinematics: RobotKinematics, limits: WalkingLimits):
        self.kinematics = kinematics
        self.limits = limits
        plant = kinematics.plant
        if unknown := [name for name in limits.clearance_m if not plant.HasBodyNamed(name)]:
            raise ValueError(f"robot '{kinematics.robot.name}' has no bodies {unknown}")
        self._clear = [(plant.GetBodyByName(n), h) for n, h in limits.clearance_m.items()]
        self._lowest_m = limits.height_share * kinematics.standing_height
        self._fallen_m = limits.fall_height_share * kinematics.standing_height
        self.feature_names = [
            *("tilt_margin", "height_margin", "clearance_margin", "joint_margin"),
            *self.command_features,
            "tilt_rate",
            "capture_point_support",
            "capture_point_x",
            "capture_point_y",
            *(f"foot_height_{i}" for i in range(kinematics.num_contacts)),
        ]

    def _clearance(self, q: np.ndarray) -> float:
        if not self._clear:
            return self.kinematics.standing_height
        self.kinematics.set_positions(q)
        poses = [(body.EvalPoseInWorld(self.kinematics.context), h) for body, h in self._clear]
        return min(float(pose.translation()[2]) - least for pose, least in poses)

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Returns the signed margins (5,) of a state; minus infinity without one."""
        if not is_state(q, v):
            return np.full(len(self.names), -np.inf)
        kinematics, limits = self.kinematics, self.limits
        tilt, height, joints = _tilt(q), float(q[6]), q[NUM_BASE_POSITIONS:]
        lowest, highest = kinematics.position_limits.T
        stops = np.minimum(np.minimum(joints - lowest, highest - joints), math.pi)
        tilt_before_fall = kinematics.standing_height * (limits.fall_tilt_rad - tilt)
        return np.array(
            [
                limits.tilt_rad - tilt,
                height - self._lowest_m,
                self._clearance(q),
                float(stops.min()) + limits.stop_rad,
                min(height - self._fallen_m, tilt_before_fall),
            ]
        )

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """Margins, tracking error and capture point now, and the coming commands (M, 3), (n_f,).

        They are NaN if an argument is not finite, or the quaternion zero.
        """
        if not is_state(q, v, preview):
            return np.full(len(self.feature_names), np.nan)
        kinematics = self.kinematics
        p_WC = kinematics.contact_positions(q)
        heights = p_WC[:, 2] - kinematics.foot_radii
        w, x, y, z = q[:4].tolist()
        forward = np.array([w * w + x * x - y * y - z * z, 2 * (x * y + w * z)])
        length = math.hypot(*forward)
        x_axis = forward / length if length > 0 else np.array([1.0, 0.0])
        to_heading = np.array([x_axis, [-x_axis[1], x_axis[0]]])
        center = kinematics.center_of_mass(q)
        rate = math.sqrt(max(center[2], 0.1 * kinematics.standing_height) / GRAVITY_M_S2)
        capture = center[:2] + rate * v[3:5]
        largest = preview[np.abs(preview).argmax(axis=0), np.arange(preview.shape[1])]
        return np.concatenate(
            [
                self.margins(q, v)[:-1],  # All but that of a fall, which is the last.
                preview[0],
                preview[-1],
                largest,
                preview[0] - heading_velocity(q, v),
                [
                    _tilt_rate(q, v),
                    signed_distance_to_polygon(capture, convex_hull(p_WC[:, :2].tolist())),
                ],
                to_heading @ (capture - p_WC[:, :2].mean(axis=0)),
                heights,
            ]
        )


def with_commands(names: Sequence[str], features: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Named features (C, n_f) with constant commands (C, 3) [m/s, rad/s] in place of the plan."""
    column = {name: i for i, name in enumerate(names)}
    changed = np.tile(features, (len(commands), 1))
    for axis, name in enumerate(_AXES):
        asked, error = column[f"command_{name}"], column[f"tracking_error_{name}"]
        velocity = features[asked] - features[error]
        for prefix in ("", "last_", "largest_"):
            changed[:, column[f"{prefix}command_{name}"]] = commands[:, axis]
        changed[:, error] = commands[:, axis] - velocity
    return changed


def _tilt(q: np.ndarray) -> float:
    w, x, y, z = (q[:4] / math.sqrt(q[:4] @ q[:4])).tolist()
    level = math.hypot(2 * (x * z - w * y), 2 * (y * z + w * x))
    return math.atan2(level, 1 - 2 * (x * x + y * y))


def _tilt_rate(q: np.ndarray, v: np.ndarray) -> float:
    w, x, y, z = (q[:4] / math.sqrt(q[:4] @ q[:4])).tolist()
    z_axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x)])
    length = math.hypot(*z_axis)
    if length < 1e-9:
        return math.hypot(v[0], v[1])
    # The axis (z_x, z_y) tilts farther by rotation about the horizontal normal (-z_y, z_x).
    return float((-z_axis[1] * v[0] + z_axis[0] * v[1]) / length)
