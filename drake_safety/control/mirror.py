"""Mirror: the reflection of a robot's state through the sagittal plane of its stance."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, RobotKinematics

_POLAR = np.array([1.0, -1.0, 1.0])  # Reflection of positions and velocities.
_AXIAL = -_POLAR  # Reflection of angular velocities, torques and rotation vectors.
_SAME_AXIS = 1e-3  # Tolerance of axes' directions [rad] and positions [m].


class Mirror:
    """The reflection of a symmetric robot through the x-z plane of its stance.

    Each joint is exchanged with its partner in robot.yaml's ``mirror``. Its sign follows from the
    joints' axes with all joints at zero, as pseudovectors are reflected to (-x, y, -z). The base's
    x-z plane is its plane of symmetry. Reflecting twice is the identity.
    """

    def __init__(self, kinematics: RobotKinematics):
        self._kinematics = kinematics
        names = kinematics.joint_names
        partners = kinematics.robot.mirror_partners(names)
        self.joint_order = np.array([names.index(partners[name]) for name in names], dtype=int)
        """Partner of every joint: mirrored joint i has the value of joint ``joint_order[i]``,"""
        self.joint_signs = self._signs()
        """times this, (n_j,)."""
        n_j, order = kinematics.num_joints, self.joint_order
        base = np.concatenate([_POLAR, _AXIAL, _AXIAL, _POLAR])
        self._state_order = np.concatenate([np.arange(12), 12 + order, 12 + n_j + order])
        self._state_signs = np.concatenate([base, self.joint_signs, self.joint_signs])

    def _signs(self) -> np.ndarray:
        kinematics = self._kinematics
        plant = kinematics.plant
        kinematics.set_positions(
            np.concatenate([[1.0, 0.0, 0.0, 0.0], np.zeros(3 + kinematics.num_joints)])
        )
        instance = plant.GetModelInstanceByName(kinematics.robot.name)
        axes = []
        for name in kinematics.joint_names:
            joint = plant.GetJointByName(name, instance)
            X_WJ = joint.frame_on_parent().CalcPoseInWorld(kinematics.context)
            if isinstance(joint, RevoluteJoint):
                axes.append((X_WJ.rotation() @ joint.revolute_axis(), X_WJ.translation(), True))
            elif isinstance(joint, PrismaticJoint):
                axes.append((X_WJ.rotation() @ joint.translation_axis(), X_WJ.translation(), False))
            else:
                raise ValueError(
                    f"robot '{kinematics.robot.name}': joint '{name}' must be revolute or "
                    f"prismatic; it is {joint.type_name()}"
                )
        signs = np.zeros(kinematics.num_joints)
        for i, (axis, point, turns) in enumerate(axes):
            partner = self.joint_order[i]
            partner_axis, partner_point, partner_turns = axes[partner]
            signs[i] = np.sign((_AXIAL if turns else _POLAR) * axis @ partner_axis)
            reflected = signs[i] * (_AXIAL if turns else _POLAR) * axis
            apart = np.cross(_POLAR * point - partner_point, partner_axis) if turns else 0.0
            if (
                turns != partner_turns
                or np.linalg.norm(reflected - partner_axis) > _SAME_AXIS
                or np.linalg.norm(apart) > _SAME_AXIS
            ):
                names = kinematics.joint_names
                raise ValueError(
                    f"robot '{kinematics.robot.name}': mirror pairs joint '{names[i]}' with "
                    f"'{names[partner]}', which is not its reflection: axis {axis} through "
                    f"{point} against {partner_axis} through {partner_point}; its patterns are "
                    f"{kinematics.robot.mirror}"
                )
        return signs

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Reflects joint positions, rates or torques, (..., n_j)."""
        return self.joint_signs * values[..., self.joint_order]

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
        kinematics = self._kinematics
        if stance_pose is None:
            stance_pose = kinematics.stance_pose(q)
        x, y, yaw = stance_pose
        R_WS = RotationMatrix.MakeZRotation(yaw)
        across = (R_WS.matrix() * _POLAR) @ R_WS.matrix().T  # Reflection in the world.
        origin = np.array([x, y, 0.0])
        half = 0.5 * yaw
        # The base's orientation is reflected in the stance frame.
        turn = Quaternion([np.cos(half), 0.0, 0.0, np.sin(half)])
        w, a, b, c = turn.inverse().multiply(Quaternion(q[:4] / np.linalg.norm(q[:4]))).wxyz()
        quaternion = turn.multiply(Quaternion([w, -a, b, -c])).wxyz()
        mirrored_q = np.concatenate(
            [
                quaternion,
                origin + across @ (q[4:NUM_BASE_POSITIONS] - origin),
                self.joints(q[NUM_BASE_POSITIONS:]),
            ]
        )
        mirrored_v = np.concatenate(
            [
                -across @ v[:3],
                across @ v[3:NUM_BASE_VELOCITIES],
                self.joints(v[NUM_BASE_VELOCITIES:]),
            ]
        )
        return mirrored_q, mirrored_v

    def hand(self, name: str) -> str:
        """Returns the name of the mirrored reaching frame."""
        robot, names = self._kinematics.robot, self._kinematics.joint_names
        partners = robot.mirror_partners(names)
        wanted = {partners[joint] for joint in robot.reaching_frame(name).joints}
        for other, frame in robot.reaching_frames.items():
            if set(frame.joints) == wanted:
                return other
        arms = {other: frame.joints for other, frame in robot.reaching_frames.items()}
        raise ValueError(
            f"robot '{robot.name}': no reaching frame has the joints {sorted(wanted)} opposite "
            f"hand '{name}'; there are {arms}"
        )
