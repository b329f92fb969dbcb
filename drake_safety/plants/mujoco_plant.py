"""MujocoPlant: a robot simulated by MuJoCo, in place of a MultibodyPlant."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.plants.mujoco_dynamics import MujocoDynamics


class MujocoPlant(LeafSystem):
    """Steps MuJoCo; all ports are in Drake's convention.

    .. pydrake_system::

        name: MujocoPlant
        input_ports:
        - command
        - applied_spatial_force (optional)
        output_ports:
        - state
        - positions

    ``command`` has joint torques, or the desired joint state ``[q; v]`` of servos, in the order of
    the robot's velocities. ``applied_spatial_force`` is that of a MultibodyPlant. ``state`` is the
    MultibodyPlant's ``[q; v]``, ``positions`` its q. MuJoCo's state, including the solver's warm
    start, is discrete state of the Context. The Drake ``plant`` gives the default state only.
    """

    def __init__(self, dynamics: MujocoDynamics, plant: MultibodyPlant):
        super().__init__()
        self.dynamics = dynamics
        n_q, n_v = dynamics.num_positions, dynamics.num_velocities
        self._n_q = n_q
        instance = plant.GetModelInstanceByName(dynamics.robot.name)
        default = plant.GetPositionsAndVelocities(plant.CreateDefaultContext(), instance)
        self._command_port = self.DeclareVectorInputPort("command", dynamics.num_command)
        self._force_port = self.DeclareAbstractInputPort(
            "applied_spatial_force", Value[list[ExternallyAppliedSpatialForce]]()
        )
        state = self.DeclareDiscreteState(dynamics.state_from(default))
        period_s = float(dynamics.model.opt.timestep)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("state", BasicVector(n_q + n_v), self._calc_state, ticket)
        self.DeclareVectorOutputPort("positions", BasicVector(n_q), self._calc_positions, ticket)

    def set_state(self, context: Context, plant_state: np.ndarray) -> None:
        """Sets the state in this system's Context to Drake's ``[q; v]``, (n_q + n_v,)."""
        context.SetDiscreteState(self.dynamics.state_from(np.asarray(plant_state, dtype=float)))

    def _plant_state(self, context: Context) -> np.ndarray:
        return self.dynamics.plant_state(context.get_discrete_state_vector().get_value())

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = context.get_discrete_state_vector().get_value()
        command = self._command_port.Eval(context)
        forces = self._force_port.Eval(context) if self._force_port.HasValue(context) else ()
        discrete_state.set_value(self.dynamics.step(state, command, forces))

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._plant_state(context))

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._plant_state(context)[: self._n_q])
