"""Safe sets as signed margins: positive inside, zero on the boundary, negative outside."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import field
from typing import ClassVar

import numpy as np

from drake_safety.control.kinematics import RobotKinematics, is_state
from drake_safety.files.schema import Interval, schema
from drake_safety.robots.robot_size import GRAVITY_M_S2

_NUM_DIRECTIONS = 8
_ANGLES = 2 * np.pi * np.arange(_NUM_DIRECTIONS) / _NUM_DIRECTIONS
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Unit vectors in eight directions, (2, 8)."""
DIRECTION_NAMES = [f"{round(math.degrees(angle))}deg" for angle in _ANGLES]


def convex_hull(points: Iterable[Sequence[float]]) -> list[tuple[float, float]]:
    """Corners of the hull, counter-clockwise (monotone chain); two if points are collinear."""
    ordered = sorted((x, y) for x, y in points)

    def chain(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        hull: list[tuple[float, float]] = []
        for px, py in sequence:
            while len(hull) >= 2:
                (ax, ay), (bx, by) = hull[-2], hull[-1]
                if (bx - ax) * (py - ay) - (by - ay) * (px - ax) > 0:
                    break
                hull.pop()
            hull.append((px, py))
        return hull[:-1]

    return chain(ordered) + chain(ordered[::-1]) if len(ordered) > 1 else ordered


def signed_distance_to_polygon(
    point: Sequence[float] | np.ndarray, corners: list[tuple[float, float]]
) -> float:
    """Signed distance of a point to a convex polygon (counter-clockwise), positive inside [m].

    The distance to a segment or a point is never positive, without corners it is minus infinity.
    """
    if not corners:
        return -math.inf
    px, py = float(point[0]), float(point[1])
    inside, nearest = len(corners) >= 3, math.inf
    for (ax, ay), (bx, by) in zip([corners[-1], *corners[:-1]], corners, strict=True):
        ex, ey = bx - ax, by - ay
        dx, dy = px - ax, py - ay
        inside = inside and not ex * dy - ey * dx < 0
        length_squared = ex * ex + ey * ey
        s = 0.0 if length_squared == 0 else (dx * ex + dy * ey) / length_squared
        s = min(max(s, 0.0), 1.0)
        nearest = min(nearest, math.hypot(dx - s * ex, dy - s * ey))
    return nearest if inside else -nearest


def support_margin(kinematics: RobotKinematics, q: np.ndarray, clearance_m: float) -> float:
    """Signed distance of the base's ground projection to the contacts below ``clearance_m`` [m]."""
    p_WC = kinematics.contact_positions(q)
    points = zip(p_WC.tolist(), kinematics.foot_radii.tolist(), strict=True)
    if support := [(x, y) for (x, y, z), radius in points if z - radius < clearance_m]:
        return signed_distance_to_polygon(q[4:6], convex_hull(support))
    x, y = (q[4:6] - p_WC[:, :2].mean(axis=0)).tolist()
    return -math.hypot(x, y) - 1e-3


def fall_margin(
    kinematics: RobotKinematics, q: np.ndarray, lowest_height_m: float, cos_fall_tilt: float
) -> float:
    """The smaller of height over ``lowest_height_m`` and height that the largest tilt loses [m]."""
    # Floats are faster than short arrays.
    w, x, y, z, _, _, height = q[:7].tolist()
    cos_tilt = 1.0 - 2.0 * (x * x + y * y) / (w * w + x * x + y * y + z * z)
    return min(height - lowest_height_m, kinematics.standing_height * (cos_tilt - cos_fall_tilt))


@schema(kw_only=True)
class BalanceLimits:
    """Limits of :class:`BalanceSafeSet`."""

    support_clearance_m: float = 0.03  # Height below which a contact point supports [m].
    height_m: Interval = field(default_factory=lambda: [0.3, 0.5])  # Safe heights of the base.
    fall_height_m: float = 0.2
    fall_tilt_rad: float = 0.8  # Tilt of the base's z axis beyond which it has fallen [rad].

    def __post_init__(self) -> None:
        fall, lowest = self.fall_height_m, self.height_m[0]
        if not fall <= lowest:
            raise ValueError(f"fall_height_m must not exceed {lowest}; got {fall}")


class BalanceSafeSet:
    """Safe set of a balancing robot: base over its feet, at a safe height, not fallen."""

    names = ("support_polygon", "height", "fall")
    fall_name = "fall"
    # Features for baseline monitors, by name of the monitor.
    watched_features: ClassVar[dict[str, str]] = {
        "capture_point_margin": "capture_point_support_distance",
        "support_margin": "base_support_distance",
    }

    def __init__(self, kinematics: RobotKinematics, limits: BalanceLimits):
        self.kinematics = kinematics
        self.limits = limits
        self._cos_fall_tilt = math.cos(limits.fall_tilt_rad)
        points = ("base", "capture_point", "goal")
        self.feature_names = [f"{p}_margin_{d}" for p in points for d in DIRECTION_NAMES]
        self.feature_names += [f"{p}_support_distance" for p in points]
        self.feature_names += ["plan_support_distance", "plan_height_margin", "goal_height"]
        self.feature_names += [f"clearance_{i}" for i in range(kinematics.num_contacts)]
        self.feature_names += ["height_over_lowest", "height_under_highest", "yaw_error"]
        self.feature_names += [f"tracking_error_{axis}" for axis in "xyz"]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Returns the signed margins (3,) [m] of a state; minus infinity without one."""
        if not is_state(q, v):
            return np.full(len(self.names), -np.inf)
        kinematics, limits = self.kinematics, self.limits
        height, (lowest, highest) = float(q[6]), limits.height_m
        support = support_margin(kinematics, q, limits.support_clearance_m)
        fall = fall_margin(kinematics, q, limits.fall_height_m, self._cos_fall_tilt)
        return np.array([support, min(height - lowest, highest - height), fall])

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """Returns the features (n_f,), from the desired base positions in the stance frame (M, 3).

        A directional margin is positive if the support polygon extends beyond the point in that
        direction. All are NaN without a finite state with an orientation.
        """
        if not is_state(q, v, preview):
            return np.full(len(self.feature_names), np.nan)
        kinematics, limits = self.kinematics, self.limits
        p_WC = kinematics.contact_positions(q)
        x, y, yaw = kinematics.stance_pose(q)
        c, s = math.cos(yaw), math.sin(yaw)
        R_SW = np.array([[c, s], [-s, c]])
        origin = np.array([x, y])
        contacts = (p_WC[:, :2] - origin) @ R_SW.T
        clearance = p_WC[:, 2] - kinematics.foot_radii
        is_support = clearance < limits.support_clearance_m
        if not is_support.any():
            is_support = np.ones_like(is_support)
        base, height = R_SW @ (q[4:6] - origin), q[6]
        velocity = R_SW @ v[3:5]
        capture_point = base + velocity * math.sqrt(max(height, 0.05) / GRAVITY_M_S2)
        reach = (contacts[is_support] @ DIRECTIONS).max(axis=0)
        corners = convex_hull(contacts[is_support].tolist())
        points = np.stack([base, capture_point, preview[-1, :2]])
        qw, qx, qy, qz = q[:4]
        base_yaw = math.atan2(2 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
        yaw_error = math.remainder(base_yaw - yaw, 2 * math.pi)
        lowest, highest = limits.height_m
        heights = preview[:, 2].tolist()
        on_plan = [signed_distance_to_polygon(p, corners) for p in preview[:, :2].tolist()]
        return np.concatenate(
            [
                (reach - points @ DIRECTIONS).ravel(),
                [signed_distance_to_polygon(p, corners) for p in points.tolist()],
                [min(on_plan), min(min(heights) - lowest, highest - max(heights)), heights[-1]],
                clearance,
                [height - lowest, highest - height, yaw_error],
                preview[0, :2] - base,
                [preview[0, 2] - height],
            ]
        )
