"""Mirror: the reflection of a robot's state through the sagittal plane of its stance."""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import Joint, PrismaticJoint, RevoluteJoint

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, RobotKinematics

_POLAR = np.array([1.0, -1.0, 1.0])  # Reflection of positions and velocities.
_AXIAL = -_POLAR  # Reflection of angular velocities, torques and rotation vectors.
_SAME_AXIS = 1e-3  # Tolerance of axes' directions [rad] and positions [m].


class Mirror:
    """The reflection of a symmetric robot through the x-z plane of its stance.

    Each joint is exchanged with its partner in robot.yaml's ``mirror``, with the sign of their axes
    at zero. The base's x-z plane is its plane of symmetry.
    """

    def __init__(self, kinematics: RobotKinematics):
        self._kinematics = kinematics
        names, plant = kinematics.joint_names, kinematics.plant
        self._partners = kinematics.robot.mirror_partners(names)
        order = np.array([names.index(self._partners[name]) for name in names], dtype=int)
        q = np.zeros(kinematics.num_positions)
        q[0] = 1.0
        kinematics.set_positions(q)
        instance = plant.GetModelInstanceByName(kinematics.robot.name)
        axes = [self._axis(plant.GetJointByName(name, instance)) for name in names]
        signs = np.zeros(len(names))
        for i, (axis, point, is_revolute) in enumerate(axes):
            partner_axis, partner_point, is_partner_revolute = axes[order[i]]
            reflection = _AXIAL if is_revolute else _POLAR
            signs[i] = np.sign(reflection * axis @ partner_axis)
            apart = signs[i] * reflection * axis - partner_axis
            if is_revolute:
                apart = np.append(apart, np.cross(_POLAR * point - partner_point, partner_axis))
            if is_revolute != is_partner_revolute or np.abs(apart).max() > _SAME_AXIS:
                pair = f"joint '{names[i]}' with '{names[order[i]]}', which is not its reflection"
                lines = f"axis {axis} through {point}, {partner_axis} through {partner_point}"
                raise ValueError(f"robot '{kinematics.robot.name}': mirror pairs {pair}: {lines}")
        # Mirrored joint i has the value of joint `order[i]`, times its sign.
        self._joint_order, self._joint_signs = order, signs
        self._state_order = np.concatenate([np.arange(12), 12 + order, 12 + len(order) + order])
        self._state_signs = np.concatenate([_POLAR, _AXIAL, _AXIAL, _POLAR, signs, signs])

    def _axis(self, joint: Joint) -> tuple[np.ndarray, np.ndarray, bool]:
        """Direction, a point, and whether the joint turns about it, in the world."""
        X_WJ = joint.frame_on_parent().CalcPoseInWorld(self._kinematics.context)
        is_revolute = isinstance(joint, RevoluteJoint)
        if not (is_revolute or isinstance(joint, PrismaticJoint)):
            raise ValueError(f"mirror: joint '{joint.name()}' must be revolute or prismatic")
        axis = joint.revolute_axis() if is_revolute else joint.translation_axis()
        return X_WJ.rotation() @ axis, X_WJ.translation(), is_revolute

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Reflects joint positions, rates or torques, (..., n_j)."""
        return self._joint_signs * values[..., self._joint_order]

    def points(self, p: np.ndarray) -> np.ndarray:
        """Reflects positions or velocities in the stance frame, (..., 3): y becomes -y."""
        return _POLAR * p

    def stance_state(self, state: np.ndarray) -> np.ndarray:
        """Reflects states (..., 12 + 2 n_j) of `drake_safety.control.observation.stance_state`."""
        return self._state_signs * state[..., self._state_order]

    def plant_state(
        self, q: np.ndarray, v: np.ndarray, stance_pose: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Reflects (q, v) in the x-z plane of a stance ``[x, y, yaw]``, by default of ``q``."""
        if stance_pose is None:
            stance_pose = self._kinematics.stance_pose(q)
        x, y, yaw = stance_pose
        R_WS = RotationMatrix.MakeZRotation(yaw).matrix()
        across = (R_WS * _POLAR) @ R_WS.T  # Reflection in the world.
        origin = np.array([x, y, 0.0])
        # The base's orientation is reflected in the stance frame.
        turn = Quaternion([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)])
        w, a, b, c = turn.inverse().multiply(Quaternion(q[:4] / np.linalg.norm(q[:4]))).wxyz()
        quaternion = turn.multiply(Quaternion([w, -a, b, -c])).wxyz()
        position = origin + across @ (q[4:NUM_BASE_POSITIONS] - origin)
        mirrored_q = [quaternion, position, self.joints(q[NUM_BASE_POSITIONS:])]
        velocity = across @ v[3:NUM_BASE_VELOCITIES]
        mirrored_v = [-across @ v[:3], velocity, self.joints(v[NUM_BASE_VELOCITIES:])]
        return np.concatenate(mirrored_q), np.concatenate(mirrored_v)

    def hand(self, name: str) -> str:
        """Returns the name of the mirrored reaching frame."""
        robot = self._kinematics.robot
        wanted = {self._partners[joint] for joint in robot.reaching_frame(name).joints}
        for other, frame in robot.reaching_frames.items():
            if set(frame.joints) == wanted:
                return other
        what = f"no reaching frame has the joints {sorted(wanted)} opposite hand '{name}'"
        raise ValueError(f"robot '{robot.name}': {what}")
