"""SafetyMonitor: is the robot inside its safe set, and by how much."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.systems.float_system import FloatSystem


class SafeSet(Protocol):
    """What a safe set offers: the names of its constraints and their signed margins."""

    names: tuple[str, ...]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Signed margins (n_c,) of a state, negative where violated."""
        ...


class SafetyMonitor(FloatSystem, LeafSystem):
    """Watches the plant's true state against the safe set.

    .. pydrake_system::

        name: SafetyMonitor
        input_ports:
        - plant_state
        output_ports:
        - safe
        - margins

    Margins are evaluated every ``period_s`` and held: ``safe`` is 1 while none is negative. A
    state that is not finite has margins of minus infinity.

    Args:
        safe_set: The constraints.
        num_positions: n_q of the plant state.
        num_velocities: n_v of the plant state.
        period_s: Time between two evaluations [s].
    """

    def __init__(
        self, safe_set: SafeSet, num_positions: int, num_velocities: int, *, period_s: float
    ):
        super().__init__()
        self._safe_set = safe_set
        self._n_q = num_positions
        self.constraint_names = list(safe_set.names)
        n_c = len(self.constraint_names)
        self._state_port = self.DeclareVectorInputPort(
            "plant_state", num_positions + num_velocities
        )
        margins = self.DeclareDiscreteState(n_c)
        self.DeclareInitializationDiscreteUpdateEvent(self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)
        ticket = {self.discrete_state_ticket(margins)}
        self.DeclareVectorOutputPort("safe", BasicVector(1), self._calc_safe, ticket)
        self.DeclareStateOutputPort("margins", margins)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._state_port.Eval(context)
        if np.isfinite(state).all():
            margins = self._safe_set.margins(state[: self._n_q], state[self._n_q :])
        else:
            margins = np.full(len(self.constraint_names), -np.inf)
        discrete_state.set_value(margins)

    def _calc_safe(self, context: Context, output: BasicVector) -> None:
        margins = context.get_discrete_state_vector().get_value()
        output.SetAtIndex(0, float(margins.min() >= 0))
