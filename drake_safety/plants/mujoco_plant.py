"""MujocoPlant: a robot simulated by MuJoCo, in place of a MultibodyPlant."""

import logging
from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.segments import DivergenceError
from drake_safety.plants.mujoco_model import build_model, import_mujoco
from drake_safety.robots.robot import PlantVariation, Scratch, servo_joints
from drake_safety.robots.robot_model import RobotModel

_LOGGER = logging.getLogger("drake_safety")
_NUM_BASE_POSITIONS, _NUM_BASE_VELOCITIES = 7, 6


class MujocoPlant(LeafSystem):
    """A robot and its scene in MuJoCo; all ports are in Drake's convention.

    .. pydrake_system::

        name: MujocoPlant
        input_ports: [command: n_j (or 2 n_j), applied_spatial_force: abstract (optional)]
        output_ports: [state: n_q + n_v, positions: n_q]

    ``command`` has joint torques, or with ``servos`` the desired joint state ``[q; v]``, in the
    order of ``joint_names``. The discrete state is MuJoCo's ``[qpos, qvel, qacc_warmstart]``, with
    the solver's warm start, so that steps are deterministic. MuJoCo's free joint has the position
    before the quaternion, and the origin's world velocity before the *body's* angular velocity.
    """

    def __init__(
        self,
        robot: RobotModel,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        variation: PlantVariation,
        *,
        time_step_s: float,
        servos: bool,
    ):
        super().__init__()
        self._mujoco = mujoco = import_mujoco()
        if mujoco.get_mju_user_warning() is None:
            # By default MuJoCo writes warnings to a file in the working directory.
            mujoco.set_mju_user_warning(lambda text: _LOGGER.debug("MuJoCo: %s", text))
        self._robot, self._plant = robot, plant
        model, commands = build_model(
            robot, plant, scene_graph, variation, time_step_s=time_step_s, servos=servos
        )
        self.model, self.command_places = model, np.array(commands, dtype=int)
        self._scratch = Scratch(lambda: mujoco.MjData(model))
        self.joint_names = servo_joints(plant, robot)
        self.num_command = len(self.joint_names) * (2 if servos else 1)
        # The free base is first in both engines; the order of joints differs.
        joints = [model.joint(name) for name in self.joint_names]
        self._q_joints = np.array([joint.qposadr[0] for joint in joints], dtype=int)
        self._v_joints = np.array([joint.dofadr[0] for joint in joints], dtype=int)
        self._command_port = self.DeclareVectorInputPort("command", self.num_command)
        self._force_port = self.DeclareAbstractInputPort(
            "applied_spatial_force", Value[list[ExternallyAppliedSpatialForce]]()
        )
        instance = plant.GetModelInstanceByName(robot.name)
        default = plant.GetPositionsAndVelocities(plant.CreateDefaultContext(), instance)
        state = self.DeclareDiscreteState(self.state_from(default))
        self.DeclarePeriodicDiscreteUpdateEvent(time_step_s, 0.0, self._update)
        for name, size in (("state", model.nq + model.nv), ("positions", model.nq)):
            self.DeclareVectorOutputPort(
                name,
                BasicVector(size),
                lambda context, output, size=size: output.SetFromVector(
                    self.plant_state(context.get_discrete_state_vector().get_value())[:size]
                ),
                {self.discrete_state_ticket(state)},
            )

    def _parts(self, state: np.ndarray) -> list[np.ndarray]:
        return np.split(state, [self.model.nq, self.model.nq + self.model.nv])

    def state_from(self, plant_state: np.ndarray) -> np.ndarray:
        """MuJoCo's state, without a warm start, from Drake's ``[q; v]`` (n_q + n_v,)."""
        q, v = np.split(plant_state, [self.model.nq])
        state = np.zeros(self.model.nq + 2 * self.model.nv)
        qpos, qvel, _ = self._parts(state)
        quaternion = q[:4] / np.linalg.norm(q[:4])
        inverse = quaternion * [1.0, -1.0, -1.0, -1.0]
        qpos[:3], qpos[3:7] = q[4:7], quaternion
        qpos[self._q_joints] = q[_NUM_BASE_POSITIONS:]
        qvel[:3] = v[3:6]
        self._mujoco.mju_rotVecQuat(qvel[3:6], v[:3], inverse)
        qvel[self._v_joints] = v[_NUM_BASE_VELOCITIES:]
        return state

    def plant_state(self, state: np.ndarray) -> np.ndarray:
        """Drake's ``[q; v]``, (n_q + n_v,), from MuJoCo's state."""
        qpos, qvel, _ = self._parts(state)
        plant_state = np.empty(self.model.nq + self.model.nv)
        q, v = np.split(plant_state, [self.model.nq])
        q[:4], q[4:7] = qpos[3:7], qpos[:3]
        q[_NUM_BASE_POSITIONS:] = qpos[self._q_joints]
        self._mujoco.mju_rotVecQuat(v[:3], qvel[3:6], qpos[3:7])
        v[3:6] = qvel[:3]
        v[_NUM_BASE_VELOCITIES:] = qvel[self._v_joints]
        return plant_state

    def step(
        self,
        state: np.ndarray,
        command: np.ndarray,
        forces: Sequence[ExternallyAppliedSpatialForce] = (),
    ) -> np.ndarray:
        """MuJoCo's next state, with forces on bodies of the Drake plant; or a `DivergenceError`."""
        if not (np.isfinite(state).all() and np.isfinite(command).all()):
            raise DivergenceError(f"robot '{self._robot.name}': MuJoCo cannot step from NaN")
        mujoco, model, scratch = self._mujoco, self.model, self._scratch.value
        scratch.time = 0.0
        scratch.qpos[:], scratch.qvel[:], scratch.qacc_warmstart[:] = self._parts(state)
        scratch.ctrl[:] = command[self.command_places]
        scratch.qfrc_applied[:] = 0.0
        if forces:
            mujoco.mj_kinematics(model, scratch)
            mujoco.mj_comPos(model, scratch)
        for force in forces:
            index = model.body(self._plant.get_body(force.body_index).name()).id
            point = scratch.xpos[index] + scratch.xmat[index].reshape(3, 3) @ force.p_BoBq_B
            f, tau = force.F_Bq_W.translational(), force.F_Bq_W.rotational()
            mujoco.mj_applyFT(model, scratch, f, tau, point, index, scratch.qfrc_applied)
        mujoco.mj_step(model, scratch)
        kinds = [getattr(mujoco.mjtWarning, f"mjWARN_BADQ{part}") for part in ("POS", "VEL", "ACC")]
        if any(scratch.warning[int(kind)].number for kind in kinds):
            mujoco.mj_resetData(model, scratch)
            raise DivergenceError(f"robot '{self._robot.name}': MuJoCo's simulation is unstable")
        return np.concatenate([scratch.qpos, scratch.qvel, scratch.qacc_warmstart])

    def set_state(self, context: Context, plant_state: np.ndarray) -> None:
        """Sets the state in this system's Context to Drake's ``[q; v]``, (n_q + n_v,)."""
        context.SetDiscreteState(self.state_from(plant_state))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = context.get_discrete_state_vector().get_value()
        command = self._command_port.Eval(context)
        forces = self._force_port.Eval(context) if self._force_port.HasValue(context) else ()
        discrete_state.set_value(self.step(state, command, forces))
