"""SensorFaults: faults of a vector signal, between what measures it and what reads it."""

import re
from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.files.schema import check_times
from drake_safety.robots.shift import Fault

_TOLERANCE_S = 1e-9


class SensorFaults(LeafSystem):
    """Passes a vector with faults of some entries, one after the other, each from its start on.

    .. pydrake_system::

        name: SensorFaults
        input_ports: [input: n]
        output_ports: [output: n]

    A delay's output is the input of ``value / period_s`` samples ago, or the first sample until
    that is so old. ``fade`` moves the entries in ``value`` seconds to the same entries of a port
    ``rest``, by default to zero.

    Args:
        names: Names of the n entries; `Fault.entries` are patterns of these.
        period_s, offset_s: Time between samples of delays and ``freeze``, and of the first [s].

    Example: ``sensor = SensorFaults(loop.state_names, [Fault(kind="freeze")], period_s=0.01)``
    """

    def __init__(
        self,
        names: Sequence[str],
        faults: Sequence[Fault] = (),
        *,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        check_times("sensor faults", or_zero=["offset_s"], period_s=period_s, offset_s=offset_s)
        self._period_s = period_s
        self._input = self.DeclareVectorInputPort("input", len(names))
        if any(fault.kind == "fade" for fault in faults):
            self._rest = self.DeclareVectorInputPort("rest", len(names))
        self._faults = [(fault, _indices(fault, list(names))) for fault in faults]
        # Samples held by each fault, the latest first; NaN before the first sample.
        self._shapes = [(self._num_held(fault), len(entries)) for fault, entries in self._faults]
        for shape in self._shapes:
            self.DeclareDiscreteState(np.full(shape, np.nan).ravel())
        if any(num_held for num_held, _ in self._shapes):
            self.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, self._update)
        self.DeclareVectorOutputPort("output", len(names), self._calc_output)

    def _num_held(self, fault: Fault) -> int:
        if fault.kind != "delay":
            return int(fault.kind == "freeze")
        periods = (fault.value or 0.0) / self._period_s
        if abs(periods - round(periods)) > 1e-6:  # Between samples nothing is known of the signal.
            period = f"the period {self._period_s:g} s; got {fault.value:g}"
            raise ValueError(f"sensor faults: a delay must be a multiple of {period}")
        return round(periods)

    def _held(self, context: Context, index: int) -> np.ndarray:
        return context.get_discrete_state(index).get_value().reshape(self._shapes[index])

    def _signals(self, context: Context) -> list[np.ndarray]:
        """The input, and the signal after each fault."""
        signals = [self._input.Eval(context)]
        for i, (fault, entries) in enumerate(self._faults):
            signals.append(signals[-1].copy())
            elapsed_s = context.get_time() - fault.start_s
            if elapsed_s >= -_TOLERANCE_S:
                x = signals[-1][entries]
                signals[-1][entries] = self._faulty(context, i, x, max(elapsed_s, 0.0))
        return signals

    def _faulty(self, context: Context, index: int, x: np.ndarray, elapsed_s: float) -> np.ndarray:
        fault = self._faults[index][0]
        value = fault.value or 0.0
        match fault.kind:
            case "bias":
                return x + value
            case "drift":
                return x + value * elapsed_s
            case "zero":
                return np.zeros_like(x)
            case "scale":
                return value * x
            case "fade":
                has_rest, entries = self._rest.HasValue(context), self._faults[index][1]
                rest = self._rest.Eval(context)[entries] if has_rest else np.zeros_like(x)
                return x + min(elapsed_s / value, 1.0) * (rest - x)
        held = self._held(context, index)
        return x if not len(held) or np.isnan(held).any() else held[-1]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now = context.get_time() + _TOLERANCE_S
        for i, signal in enumerate(self._signals(context)[:-1]):
            fault, entries = self._faults[i]
            held, latest = self._held(context, i), signal[entries]
            if np.isnan(held).any():
                discrete_state.set_value(i, np.tile(latest, len(held)))
            elif fault.kind == "delay" or (fault.kind == "freeze" and now < fault.start_s):
                discrete_state.set_value(i, np.vstack([latest, held])[: len(held)].ravel())

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._signals(context)[-1])


def _indices(fault: Fault, names: list[str]) -> list[int]:
    indices = set[int]()
    for entry in fault.entries:
        matching = {i for i, name in enumerate(names) if entry == name or re.fullmatch(entry, name)}
        if not matching:
            raise ValueError(f"sensor faults: no entry '{entry}'; they are {names}")
        indices |= matching
    return sorted(indices)
