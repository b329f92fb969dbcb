"""Periodic updates of a state that begins once: a copied Context goes on as its original."""

import math
from collections.abc import Callable

from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.files.schema import check_times

_Update = Callable[[Context, DiscreteValues], None]


def declare_update(
    system: LeafSystem, update: _Update, start: _Update | None, period_s: float, offset_s: float
) -> None:
    """Declares a periodic discrete update and, with ``start``, one at initialisation.

    Once the state has begun, an initialisation does nothing, unless time has jumped back.
    """
    who = type(system).__name__
    check_times(who, or_zero=["offset_s"], period_s=period_s, offset_s=offset_s)
    if start is None:
        system.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, update)
        return
    latest = system.DeclareDiscreteState([math.inf])  # Time of a start that is still allowed.

    def begin(context: Context, discrete_state: DiscreteValues) -> None:
        if context.get_time() <= discrete_state.get_value(latest)[0]:
            start(context, discrete_state)
            discrete_state.set_value(latest, [context.get_time()])

    def go_on(context: Context, discrete_state: DiscreteValues) -> None:
        update(context, discrete_state)
        discrete_state.set_value(latest, [math.nextafter(context.get_time(), -math.inf)])

    system.DeclareInitializationDiscreteUpdateEvent(begin)
    system.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, go_on)
