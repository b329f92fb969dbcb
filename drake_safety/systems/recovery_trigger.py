"""RecoveryTrigger: a latch that is set when the probability falls below its threshold."""

import math

from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, InputPortIndex, LeafSystem

from drake_safety.files.schema import check_times
from drake_safety.learning.prediction import is_unknown
from drake_safety.systems.periodic_update import declare_update


class RecoveryTrigger(LeafSystem):
    """Switches to recovery when the probability falls below Γ_thre, and back when that is done.

    .. pydrake_system::

        name: RecoveryTrigger
        input_ports: [safety_probability: 1, belief: 3 (optional), recovery_done: 1 (optional)]
        output_ports: [port_selector: abstract, recovery_active: 1]

    Once active it stays active until ``recovery_done`` is 1. A probability that is not finite
    activates it. ``port_selector`` drives a PortSwitch with the ports ``nominal``, ``recovery``.

    Args:
        threshold: Γ_thre.
        persistence_s: Time below Γ_thre [s] that activates it during a "don't know".
        initial_uncertainty: The assessment's μ_ini, which marks "don't know".
    """

    def __init__(
        self,
        *,
        threshold: float = 0.6,
        persistence_s: float = 0.0,
        initial_uncertainty: float = 0.3,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        if not 0 <= threshold <= 1:
            raise ValueError(f"recovery trigger: threshold must be in [0, 1]; got {threshold}")
        check_times("recovery trigger", or_zero=["persistence_s"], persistence_s=persistence_s)
        declare_update(self, self._update, None, period_s, offset_s)
        self.threshold = threshold
        self._initial_uncertainty = initial_uncertainty
        self._num_waited = math.ceil(persistence_s / period_s - 1e-6)
        self._probability_port = self.DeclareVectorInputPort("safety_probability", 1)
        self._belief_port = self.DeclareVectorInputPort("belief", 3)
        self._done_port = self.DeclareVectorInputPort("recovery_done", 1)
        self._active = self.DeclareDiscreteState(1)
        self._num_below = self.DeclareDiscreteState(1)  # Updates below Γ_thre, up to now.
        ticket = {self.discrete_state_ticket(self._active)}
        self.DeclareAbstractOutputPort(
            "port_selector", lambda: Value(InputPortIndex(1)), self._calc_selector, ticket
        )
        self.DeclareStateOutputPort("recovery_active", self._active)

    def _is_active(self, context: Context) -> bool:
        return bool(context.get_discrete_state(self._active).GetAtIndex(0) > 0)

    def _calc_selector(self, context: Context, output: Value) -> None:
        output.set_value(InputPortIndex(2 if self._is_active(context) else 1))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        num_below = 0.0
        if self._is_active(context):
            done = self._done_port
            is_active = not (done.HasValue(context) and 0 < done.Eval(context)[0] < math.inf)
        else:
            is_below = not self.threshold <= self._probability_port.Eval(context)[0] < math.inf
            if is_below:
                num_below = context.get_discrete_state(self._num_below).GetAtIndex(0) + 1.0
            belief = self._belief_port
            may_wait = belief.HasValue(context) and is_unknown(
                belief.Eval(context), self._initial_uncertainty
            )
            is_active = is_below and (not may_wait or num_below > self._num_waited)
        discrete_state.set_value(self._active, [float(is_active)])
        discrete_state.set_value(self._num_below, [num_below])
