"""MotorCurves: desired joint states whose servos ask for no more torque than DC motors have."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import LeafSystem


class MotorCurves(LeafSystem):
    """Moves desired joint positions so that a servo's torque falls with speed.

    .. pydrake_system::

        name: MotorCurves
        input_ports: [desired_joint_state: 2 n_j, joint_state: 2 n_j]
        output_ports: [desired_joint_state: 2 n_j]

    A motor's largest torque along its motion falls linearly from the effort limit at rest to zero
    at the joint's largest speed. Against its motion it is the effort limit (``DCMotor`` of Isaac
    Lab with that saturation effort). Below it the desired state is unchanged.
    """

    def __init__(self, plant: MultibodyPlant, instance: ModelInstanceIndex, names: list[str]):
        super().__init__()
        actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
        servos = {a.joint().name(): a for a in actuators if a.has_controller()}
        # Dry friction is an actuator too, without a stiffness.
        servos = {n: a for n, a in servos.items() if a.get_controller_gains().p > 0.0}
        if missing := [name for name in names if name not in servos]:
            raise ValueError(f"motors: dc needs joints with position servos; {missing} have none")
        ordered = [servos[name] for name in names]
        self._p, self._d = np.array(
            [[a.get_controller_gains().p, a.get_controller_gains().d] for a in ordered]
        ).T
        self._effort = np.array([a.effort_limit() for a in ordered])
        self._speed = np.array([a.joint().velocity_upper_limit() for a in ordered])
        wanted = self.DeclareVectorInputPort("desired_joint_state", 2 * len(names))
        actual = self.DeclareVectorInputPort("joint_state", 2 * len(names))
        self.DeclareVectorOutputPort(
            "desired_joint_state",
            2 * len(names),
            lambda context, output: output.SetFromVector(
                self.limited(wanted.Eval(context), actual.Eval(context))
            ),
        )

    def limited(self, wanted: np.ndarray, actual: np.ndarray) -> np.ndarray:
        """The desired joint state (2 n_j,) within the motors' torques at the actual one."""
        (q_wanted, v_wanted), (q, v) = np.split(wanted, 2), np.split(actual, 2)
        torque = self._p * (q_wanted - q) + self._d * (v_wanted - v)
        speed = v / self._speed
        low = -self._effort * np.clip(1.0 + speed, 0.0, 1.0)
        high = self._effort * np.clip(1.0 - speed, 0.0, 1.0)
        excess = torque - np.clip(torque, low, high)
        return np.concatenate([q_wanted - excess / self._p, v_wanted])
