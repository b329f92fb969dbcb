"""The safe set of a reaching robot: standing, clear of obstacles, off its joint stops."""

import functools
import math
from types import MappingProxyType
from typing import Annotated

import numpy as np
from pydantic import Field

from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    is_state,
    planar_pose,
)
from drake_safety.control.safe_sets import (
    DIRECTION_NAMES,
    DIRECTIONS,
    convex_hull,
    fall_margin,
    signed_distance_to_polygon,
    support_margin,
)
from drake_safety.control.whole_body_model import WholeBodyModel
from drake_safety.diagrams.reaching.kinematic_preview import KinematicPreview, chain_joints
from drake_safety.files.schema import NotNegative, schema
from drake_safety.plants.obstacles import Clearance
from drake_safety.robots.robot_size import GRAVITY_M_S2

_NUM_PREVIEWED = 8  # Samples of the plan in the whole-body preview.
_SOON_S = 0.1  # Horizon of the extrapolation at constant velocity.


@schema(kw_only=True)
class ReachingLimits:
    """Limits of :class:`ReachingSafeSet`."""

    joint_margin_rad: NotNegative = 0.03  # Least safe distance of a joint from a stop.
    # Height below which a contact point is part of the support polygon.
    support_clearance_m: NotNegative = 0.03
    # The robot has fallen below this share of its standing height, or beyond the tilt.
    fall_height_share: Annotated[float, Field(gt=0, lt=1)] = 0.7
    fall_tilt_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 0.6


class ReachingSafeSet:
    """Safe set of a reaching robot: base over its feet, arms clear, joints off their stops.

    - ``support_polygon``: signed distance of the base to the edge of the polygon of the feet [m];
    - ``collision``: distance of the arms to the nearest obstacle, at most the clearance's range;
    - ``joint_limits``: distance of the joint nearest to a stop less ``joint_margin_rad`` [rad];
    - ``fall``: the smaller of the height over the lowest height and the height that a rigid
      pendulum of the standing height loses before ``fall_tilt_rad`` [m].

    With ``is_mirrored``, a hand has the features of the other hand in the mirrored scene.
    """

    names = ("support_polygon", "collision", "joint_limits", "fall")
    fall_name = "fall"
    angular_names = ("joint_limits",)
    watched_features = MappingProxyType(
        {"capture_point_margin": "capture_point_support", "support_margin": "now_support_polygon"}
    )

    def __init__(
        self,
        model: WholeBodyModel,
        clearance: Clearance,
        limits: ReachingLimits,
        *,
        is_mirrored: bool = False,
    ):
        self.model = model
        self.kinematics = kinematics = model.kinematics
        self.clearance = clearance
        self.limits = limits
        self._preview = KinematicPreview(model)
        self._hand = hand = self._preview.hand
        if not hand.joints:
            raise ValueError(f"reaching frame '{hand.name}' must have the joints of its arm")
        self._shoulder = kinematics.plant.GetJointByName(hand.joints[0]).frame_on_parent()
        self._chain = chain_joints(kinematics, hand)
        self._reflect = np.array([1.0, -1.0 if is_mirrored else 1.0, 1.0])
        self._lowest_height = limits.fall_height_share * kinematics.standing_height
        self._cos_fall_tilt = math.cos(limits.fall_tilt_rad)
        self.feature_names = [
            *(f"goal_{axis}" for axis in "xyz"),
            *(f"goal_from_shoulder_{axis}" for axis in "xyz"),
            "goal_distance",
            *(f"tracking_error_{axis}" for axis in "xyz"),
            "center_of_mass_height",
            "base_height",
            *(f"now_{name}" for name in self.names[:3]),
            *(f"center_of_mass_margin_{name}" for name in DIRECTION_NAMES),
            "plan_clearance",
            "goal_clearance",
            *(f"preview_lowest_{name}" for name in self.names[:3]),
            *(f"preview_last_{name}" for name in self.names[:3]),
            "preview_last_miss",
            "preview_lowest_center_of_mass_support",
            *(f"preview_last_stop_{i}" for i in range(len(self._chain))),
            *(f"center_of_mass_velocity_{axis}" for axis in "xyz"),
            *(f"hand_velocity_{axis}" for axis in "xyz"),
            "capture_point_support",
            *(f"capture_point_margin_{name}" for name in DIRECTION_NAMES),
            "soon_support_polygon",
            "soon_joint_limits",
        ]

    def _joint_margins(self, q: np.ndarray) -> np.ndarray:
        lowest, highest = self.kinematics.position_limits.T
        joints = q[..., NUM_BASE_POSITIONS:]
        # Finite for joints without stops.
        distance = np.minimum(np.minimum(joints - lowest, highest - joints), math.pi)
        return distance - self.limits.joint_margin_rad

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Returns the signed margins (4,) of a state; minus infinity without one."""
        if not is_state(q, v):
            return np.full(len(self.names), -np.inf)
        return np.array(
            [
                support_margin(self.kinematics, q, self.limits.support_clearance_m),
                self.clearance.of_arms(q),
                self._joint_margins(q).min(),
                fall_margin(self.kinematics, q, self._lowest_height, self._cos_fall_tilt),
            ]
        )

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """Margins (n_f,) [m, rad] now, along the plan, and along a preview of the whole body.

        ``preview`` has the desired positions of the hand from now to the goal, in the stance frame,
        (M, 3) [m]. Features are NaN if an argument is not finite, or the quaternion zero.
        """
        if not is_state(q, v, preview):
            return np.full(len(self.feature_names), np.nan)
        kinematics, model, body = self.kinematics, self.model, self._hand.body
        plant, context = kinematics.plant, kinematics.context
        p_WC = kinematics.contact_positions(q)
        X_WS = planar_pose(kinematics.stance_pose(q))
        R_SW = X_WS.rotation().matrix().T
        path = np.asarray(X_WS @ preview.T).T  # In the world.
        center_of_mass = kinematics.center_of_mass(q)  # Sets the positions.
        plant.SetVelocities(context, v)
        v_WC = plant.CalcCenterOfMassTranslationalVelocityInWorld(context)
        p_BH_W = body.EvalPoseInWorld(context).rotation() @ self._hand.point
        v_WH = body.EvalSpatialVelocityInWorld(context).Shift(p_BH_W).translational()
        rate = math.sqrt(max(center_of_mass[2], 0.1 * kinematics.standing_height) / GRAVITY_M_S2)
        capture_point = center_of_mass[:2] + rate * v_WC[:2]
        shoulder = self._shoulder.CalcPoseInWorld(context).translation()
        hand = model.reaching_position(q)
        from_shoulder = self._reflect * (R_SW @ (path[-1] - shoulder))
        in_stance = np.asarray(X_WS.inverse() @ p_WC.T).T * self._reflect
        com_in_stance = np.asarray(X_WS.inverse() @ center_of_mass) * self._reflect
        extent = (in_stance[:, :2] @ DIRECTIONS).max(axis=0)
        v_SC, v_SH = self._reflect * (R_SW @ v_WC), self._reflect * (R_SW @ v_WH)
        capture_in_stance = com_in_stance[:2] + rate * v_SC[:2]
        on_path = self.clearance.of_points(path, self._hand.radius_m)

        ahead = self._preview.follow(q, path[_previewed(len(path))])
        corners = convex_hull(p_WC[:, :2].tolist())
        previewed = np.column_stack(
            [
                [signed_distance_to_polygon(at[4:6], corners) for at in ahead],
                [self.clearance.of_arms(at) for at in ahead],
                self._joint_margins(ahead).min(axis=1),
            ]
        )
        com_ahead = [kinematics.center_of_mass(at)[:2] for at in ahead]
        com_support = min(signed_distance_to_polygon(at, corners) for at in com_ahead)
        soon = q.copy()
        soon[NUM_BASE_POSITIONS:] += _SOON_S * v[NUM_BASE_VELOCITIES:]
        miss = float(np.linalg.norm(path[-1] - model.reaching_position(ahead[-1])))
        return np.concatenate(
            [
                self._reflect * preview[-1],
                from_shoulder,
                [np.linalg.norm(from_shoulder)],
                self._reflect * (R_SW @ (path[0] - hand)),
                [center_of_mass[2], q[6]],
                self.margins(q, v)[:3],
                extent - com_in_stance[:2] @ DIRECTIONS,
                [on_path.min(), on_path[-1]],
                previewed.min(axis=0),
                previewed[-1],
                [miss, com_support],
                self._joint_margins(ahead[-1])[self._chain],
                v_SC,
                v_SH,
                [signed_distance_to_polygon(capture_point, corners)],
                extent - capture_in_stance @ DIRECTIONS,
                [
                    signed_distance_to_polygon(q[4:6] + _SOON_S * v[3:5], corners),
                    self._joint_margins(soon).min(),
                ],
            ]
        )


@functools.cache
def _previewed(num_samples: int) -> np.ndarray:
    spaced = np.linspace(0, num_samples - 1, _NUM_PREVIEWED + 1).round().astype(int)
    chosen = np.unique(spaced)
    return chosen[1:] if len(chosen) > 1 else chosen
