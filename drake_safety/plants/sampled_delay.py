"""SampledDelay: a vector signal that is late, or repeats itself."""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

_TOLERANCE_S = 1e-9


class SampledDelay(LeafSystem):
    """Delays a signal by a multiple of a sampling period, and freezes it at a given time.

    .. pydrake_system::

        name: SampledDelay
        input_ports:
        - input
        output_ports:
        - output

    Until the first sample is ``delay_s`` old, the output is the first sample.

    Args:
        size: Width of the signal.
        delay_s: Delay [s], rounded to periods.
        period_s: Sampling period [s].
        frozen_at_s: Time from which the last sample is repeated [s].
    """

    def __init__(
        self, size: int, delay_s: float, *, period_s: float, frozen_at_s: float | None = None
    ):
        super().__init__()
        self._num_delayed = round(delay_s / period_s)
        self._frozen_at_s = math.inf if frozen_at_s is None else frozen_at_s
        self._input = self.DeclareVectorInputPort("input", size)
        self._shape = (max(1, self._num_delayed), size)
        # The samples, the latest first; NaN before the first one.
        self.DeclareDiscreteState(np.full(math.prod(self._shape), np.nan))
        # Last of the updates within a period, so that a command is sampled after its update.
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.95 * period_s, self._update)
        self.DeclareVectorOutputPort("output", BasicVector(size), self._calc_output)

    def _samples(self, context: Context) -> np.ndarray:
        return context.get_discrete_state_vector().get_value().reshape(self._shape)

    def _is_frozen(self, context: Context) -> bool:
        return context.get_time() >= self._frozen_at_s - _TOLERANCE_S

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        samples = self._samples(context)
        latest = self._input.Eval(context)
        if np.isnan(samples).any():
            discrete_state.set_value(np.tile(latest, self._shape[0]))
        elif not self._is_frozen(context):
            discrete_state.set_value(np.concatenate([latest, samples[:-1].ravel()]))

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        oldest = self._samples(context)[-1]
        is_direct = self._num_delayed == 0 and not self._is_frozen(context)
        if is_direct or np.isnan(oldest).any():
            oldest = self._input.Eval(context)
        output.SetFromVector(oldest)
