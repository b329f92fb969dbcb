"""Footholds and swing curves of a recovery step (Raibert 1986)."""

import math

import numpy as np

from drake_safety.control.safe_sets import signed_distance_to_polygon
from drake_safety.files.schema import Count, NotNegative, Positive, schema
from drake_safety.robots.robot_size import GRAVITY_M_S2


@schema(kw_only=True)
class RecoveryStepParameters:
    """Parameters of a recovery step."""

    step_duration_s: Positive = 0.09  # Duration of a swing [s].
    lift_m: Positive = 0.06
    velocity_gain_s: float = 0.05  # Raibert's gain: distance past the neutral point per speed [s].
    velocity_gain_growth: NotNegative = 0.1  # Growth of this gain with every swing, as its share.
    max_reach_m: Positive = 0.18  # Largest distance of a foothold from its hip's projection [m].
    min_lateral_m: float = 0.11  # Smallest distance of a foothold from the base's midline [m].
    # Largest difference of desired and measured base yaw; with 0 no heading is held [rad].
    max_twist_rad: NotNegative = 0.3
    # Offset of the desired base yaw from the heading against the yaw rate, per yaw rate [s].
    yaw_damping_s: float = 0.1
    min_steps: Count = 2
    max_steps: int = 100  # Most swings; a robot that stops before it can stand falls.
    settle_heading_rad: float = 0.35  # Largest difference of yaw and heading for stopping [rad].
    settle_margin_m: float = 0.08  # Least depth of the capture point in the polygon to stop [m].
    resume_margin_m: float = 0.02  # Depth of this point below which a robot steps again [m].
    return_duration_s: Positive = 0.5  # Duration of the base's return over its feet [s].

    def __post_init__(self) -> None:
        for low, high in (("resume_margin_m", "settle_margin_m"), ("min_steps", "max_steps")):
            least, most = getattr(self, low), getattr(self, high)
            if not least <= most:
                raise ValueError(f"{low} must not exceed {high}; got {least}, {most}")


def gait_groups(foot_positions: np.ndarray) -> list[list[int]]:
    """Two groups of feet (n_feet, 2) [m] that swing together: every second one around the body."""
    around = np.argsort(np.arctan2(foot_positions[:, 1], foot_positions[:, 0]), kind="stable")
    return [sorted(around[0::2].tolist()), sorted(around[1::2].tolist())]


def capture_point(p_WB: np.ndarray, v_WB: np.ndarray) -> np.ndarray:
    """Returns the capture point of a linear inverted pendulum, p + v √(z/g), (2,) [m]."""
    return p_WB[:2] + v_WB[:2] * math.sqrt(max(float(p_WB[2]), 0.05) / GRAVITY_M_S2)


def come_to_rest(p_WB: np.ndarray, v_WB: np.ndarray, elapsed_s: float) -> np.ndarray:
    """Position (3,) [m] of a linear inverted pendulum with its support at the capture point."""
    time_constant_s = math.sqrt(p_WB[2] / GRAVITY_M_S2)
    return p_WB - v_WB * time_constant_s * math.expm1(-elapsed_s / time_constant_s)


def minimum_jerk(s: float) -> float:
    """Returns the minimum-jerk profile, from 0 to 1 for ``s`` from 0 to 1."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def first_group(groups: list[list[int]], feet: np.ndarray, point: np.ndarray) -> int:
    """The group whose swing leaves the other's stance line nearest the capture point (2,) [m]."""
    # While one group swings, the other stands. No point is inside a line.
    lines = [feet[[group[0], group[-1]]].tolist() for group in groups[::-1]]
    return int(np.argmax([signed_distance_to_polygon(point, line) for line in lines]))


def foothold(
    p_WB: np.ndarray,
    v_WB: np.ndarray,
    yaw: float,
    hip_offset: np.ndarray,
    remaining_s: float,
    parameters: RecoveryStepParameters,
    num_steps: int = 0,
) -> np.ndarray:
    """Returns the foothold of a swinging foot, on the ground (2,) [m].

    Raibert's neutral point is the hip at touchdown plus half the distance travelled in the next
    stance, ``p + v (t_rem + T/2)``; the foothold adds ``k v``, where k grows with every swing. It
    is within reach of the hip at touchdown, and on its own side of the base. ``hip_offset`` is the
    standing foot's position in the heading frame, (2,) [m].
    """
    c, s = math.cos(yaw), math.sin(yaw)
    R_WS = np.array([[c, -s], [s, c]])
    v_S = R_WS.T @ v_WB[:2]
    gain_s = parameters.velocity_gain_s * (1.0 + parameters.velocity_gain_growth * num_steps)
    step = v_S * (0.5 * parameters.step_duration_s + gain_s)
    reach = float(np.hypot(*step))
    if reach > parameters.max_reach_m:
        step = step * (parameters.max_reach_m / reach)
    place = hip_offset + step
    side = 1.0 if hip_offset[1] >= 0 else -1.0
    if side * place[1] < parameters.min_lateral_m:
        place[1] = side * min(parameters.min_lateral_m, abs(hip_offset[1]))
    return p_WB[:2] + v_WB[:2] * remaining_s + R_WS @ place


def swing_position(start: np.ndarray, goal: np.ndarray, phase: float, lift_m: float) -> np.ndarray:
    """A point (3,) [m] of a minimum-jerk swing from start to goal, ``lift_m`` higher halfway."""
    s = min(max(phase, 0.0), 1.0)
    point = start + minimum_jerk(s) * (goal - start)
    point[2] += lift_m * math.sin(math.pi * s) ** 2
    return point
