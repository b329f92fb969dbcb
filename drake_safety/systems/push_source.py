"""PushSource: a force on a body of the robot during an interval."""

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.plants.pushes import Push
from drake_safety.systems.periodic_update import declare_update

_BODY, _FORCE, _START, _DURATION = 0, slice(1, 4), 4, 5
_SIZE = 6
_TOLERANCE_S = 1e-9


class PushSource(LeafSystem):
    """Pushes one body of a robot at its centre of mass; the push is a parameter of the Context.

    .. pydrake_system::

        name: PushSource
        output_ports: [applied_spatial_force: abstract]

    A push begins and ends with the plant's first step after a multiple of ``period_s`` [s], the
    first that is not before its time.
    """

    def __init__(self, plant: MultibodyPlant, instance: ModelInstanceIndex, *, period_s: float):
        super().__init__()
        bodies = map(plant.get_body, plant.GetBodyIndices(instance))
        self._bodies = {body.name(): body for body in bodies}
        self._parameter = self.DeclareNumericParameter(BasicVector(np.zeros(_SIZE)))
        state = self.DeclareDiscreteState(1)
        declare_update(self, self._update, None, period_s, 0.0)
        self.DeclareAbstractOutputPort(
            "applied_spatial_force",
            lambda: Value[list[ExternallyAppliedSpatialForce]](),
            self._calc_force,
            {self.discrete_state_ticket(state)},
        )

    def set_push(self, context: Context, push: Push) -> None:
        """Sets the push; it replaces an earlier one."""
        if push.body not in self._bodies:
            raise ValueError(f"push: no body '{push.body}'; there are {list(self._bodies)}")
        body = float(self._bodies[push.body].index())
        values = np.array([body, *push.force_n, push.time_s, push.duration_s])
        context.get_mutable_numeric_parameter(self._parameter).SetFromVector(values)

    def push(self, context: Context) -> np.ndarray:
        """Index of the body, force [N], start and duration [s] of the push, (6,)."""
        return context.get_numeric_parameter(self._parameter).get_value().copy()

    def clear_push(self, context: Context) -> None:
        """Removes the push from the next update on."""
        context.get_mutable_numeric_parameter(self._parameter).SetFromVector(np.zeros(_SIZE))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        push = self.push(context)
        elapsed = context.get_time() - push[_START] + _TOLERANCE_S
        discrete_state.set_value([float(0.0 <= elapsed < push[_DURATION])])

    def _calc_force(self, context: Context, output: Value) -> None:
        if not context.get_discrete_state_vector().GetAtIndex(0):
            output.set_value([])
            return
        push = self.push(context)
        body = next(b for b in self._bodies.values() if int(b.index()) == int(push[_BODY]))
        force = ExternallyAppliedSpatialForce()
        force.body_index = body.index()
        force.p_BoBq_B = body.default_com()
        force.F_Bq_W = SpatialForce(np.zeros(3), push[_FORCE])
        output.set_value([force])
