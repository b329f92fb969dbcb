"""SafetyMonitor: the signed margins of the safe set."""

import math
from typing import Protocol

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.learning.causes import is_outside
from drake_safety.learning.segments import floats


class SafeSet(Protocol):
    """A safe set: constraints with signed margins; features are further inputs of assessors."""

    names: tuple[str, ...]
    feature_names: list[str]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Signed margins (n_c,) of a state, negative where violated."""

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """Features (n_f,) of a measured state and the preview (H, n_z)."""


def finite_margins(safe_set: SafeSet, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Margins (n_c,) of a state; minus infinity if it is not finite."""
    if q.dot(q) + v.dot(v) < math.inf:
        return floats(safe_set.margins(q, v))
    return np.full(len(safe_set.names), -np.inf)


class SafetyMonitor(LeafSystem):
    """Evaluates the safe set on the plant's true state.

    .. pydrake_system::

        name: SafetyMonitor
        input_ports: [plant_state: n_q + n_v]
        output_ports: [margins: n_c, safe: 1]

    ``safe`` is 1 while every margin is finite and not negative. The margins of a state that is not
    finite are minus infinity.
    """

    def __init__(self, safe_set: SafeSet, num_positions: int, num_velocities: int):
        super().__init__()
        self._safe_set = safe_set
        self._n_q = num_positions
        self.constraint_names = list(safe_set.names)
        size = num_positions + num_velocities
        self._state_port = self.DeclareVectorInputPort("plant_state", size)
        ticket = {self.input_port_ticket(self._state_port.get_index())}
        self._margins_port = self.DeclareVectorOutputPort(
            "margins", len(self.constraint_names), self._calc_margins, ticket
        )
        self.DeclareVectorOutputPort("safe", 1, self._calc_safe, ticket)

    def _calc_margins(self, context: Context, output: BasicVector) -> None:
        q, v = np.split(self._state_port.Eval(context), [self._n_q])
        output.SetFromVector(finite_margins(self._safe_set, q, v))

    def _calc_safe(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(not is_outside(self._margins_port.Eval(context))))
