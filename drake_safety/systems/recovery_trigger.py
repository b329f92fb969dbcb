"""RecoveryTrigger: latches when the safety probability falls below its threshold."""

from __future__ import annotations

from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    InputPortIndex,
    LeafSystem,
)


class RecoveryTrigger(LeafSystem):
    """Switches to recovery when Γ < Γ_thre, and back when the recovery reports that it is done.

    .. pydrake_system::

        name: RecoveryTrigger
        input_ports:
        - safety_probability
        - recovery_done (optional)
        output_ports:
        - port_selector
        - recovery_active

    The trigger latches: once fired it stays active, whatever Γ does, until ``recovery_done``
    is 1. A Γ that is NaN fires. ``port_selector`` drives a PortSwitch whose ports were declared
    ``nominal`` first, ``recovery`` second.

    Args:
        threshold: Γ_thre in [0, 1]; the paper's value is 0.6.
        period_s: Time between two looks at Γ [s].
        offset_s: Time of the first look [s].

    Raises:
        ValueError: The threshold is outside [0, 1].
    """

    def __init__(self, *, threshold: float = 0.6, period_s: float, offset_s: float = 0.0):
        super().__init__()
        if not 0 <= threshold <= 1:
            raise ValueError(f"recovery trigger: threshold must be in [0, 1]; got {threshold}")
        self.threshold = threshold
        self.DeclareVectorInputPort("safety_probability", 1)
        self.DeclareVectorInputPort("recovery_done", 1)
        state = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, self._update)
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort(
            "port_selector", lambda: Value(InputPortIndex(1)), self._calc_selector, ticket
        )
        self.DeclareVectorOutputPort("recovery_active", BasicVector(1), self._calc_active, ticket)

    def _is_active(self, context: Context) -> bool:
        return bool(context.get_discrete_state_vector().GetAtIndex(0) > 0)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._is_active(context):
            done = self.GetInputPort("recovery_done")
            active = not (done.HasValue(context) and done.Eval(context)[0] > 0)
        else:
            probability = self.GetInputPort("safety_probability").Eval(context)[0]
            active = not probability >= self.threshold
        discrete_state.set_value([float(active)])

    def _calc_selector(self, context: Context, output: Value) -> None:
        output.set_value(InputPortIndex(2 if self._is_active(context) else 1))

    def _calc_active(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._is_active(context)))
