"""Recording of a diagram's output ports, and of whole episodes."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, PortDataType

from drake_safety.learning.segments import (
    DIVERGED,
    RECORDED,
    DivergenceError,
    Episode,
    EpisodeError,
)

LARGEST = 1e12
"""Any quantity in SI units is smaller; a larger one means that the simulation diverged."""
_LOGGER = logging.getLogger("drake_safety")


class Recorder:
    """Records output ports of a diagram, row by row.

    Args:
        names: Ports to record; a mapping from recorded names to those of ports renames them.
    """

    def __init__(self, diagram: Diagram, names: Iterable[str] | Mapping[str, str] = RECORDED):
        named = names if isinstance(names, Mapping) else {name: name for name in names}
        self._ports = {name: diagram.GetOutputPort(port) for name, port in named.items()}
        self._rows: list[dict[str, np.ndarray]] = []
        self._times: list[float] = []

    def record(self, context: Context, time_s: float | None = None) -> None:
        """Appends a row, unless a port raises; a given time is without rounding errors [s]."""
        self._rows.append(
            {name: np.array(port.Eval(context)) for name, port in self._ports.items()}
        )
        self._times.append(context.get_time() if time_s is None else time_s)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns ``time_s`` (N,) [s] and, by name, (N, size) for a vector port, else (N,)."""
        arrays = {}
        for name, port in self._ports.items():
            is_vector = port.get_data_type() == PortDataType.kVectorValued
            shape = (len(self._rows), port.size()) if is_vector else len(self._rows)
            arrays[name] = np.array([row[name] for row in self._rows]).reshape(shape)
        return {"time_s": np.array(self._times), **arrays}


def advance_to(simulator: Simulator, time_s: float) -> None:
    """Advances a simulation to a time, before the updates due at that time.

    The state of a discrete plant is then that of the given time. The update due then already
    computes the next state, so a row recorded after it (``AdvancePendingEvents``, or a time rounded
    upwards) would not belong to its time.
    """
    # Both this time and Drake's time of an update are products, rounded in the last bit or two.
    before_s = time_s - 4.0 * math.ulp(time_s)
    if before_s > simulator.get_context().get_time():
        simulator.AdvanceTo(before_s)


@dataclass(frozen=True, kw_only=True)
class EpisodeTiming:
    """Sampling times of an episode.

    Attributes:
        step_s: Time between two rows [s].
        num_steps: T, steps of a safe episode.
        monitor_period_s: Sampling period of the safe set, counted from each row [s].
    """

    step_s: float
    num_steps: int
    monitor_period_s: float

    def monitor_times(self, step: int) -> list[float]:
        """Times at which the safe set is sampled in a step, from 1, its end included [s]."""
        count = max(math.ceil(self.step_s / self.monitor_period_s - 1e-6), 1)
        begin_s = (step - 1) * self.step_s
        within = [begin_s + i * self.monitor_period_s for i in range(1, count)]
        return [*within, step * self.step_s]


def record_episode(
    simulator: Simulator,
    ports: Mapping[str, str],
    timing: EpisodeTiming,
    *,
    constraint_names: list[str],
    who: str,
    index: int = 0,
    first_step: int = 0,
) -> Episode:
    """Simulates an episode, which ends when it leaves the safe set or its time is over.

    Args:
        ports: The diagram's port for each of the names in ``RECORDED``, and for ``safe``. ``safe``
            defaults to no margin being negative, ``true_state`` to ``state``, ``desired_output``
            to the preview's first sample, and ``features`` to none.

    Returns:
        The episode. If the simulation fails, its cause is ``diverged`` and it has the rows that
        are finite.

    Raises:
        EpisodeError: A system raised an error other than a failure of the simulation.
    """
    context = simulator.get_mutable_context()
    diagram = simulator.get_system()
    recorder = Recorder(diagram, {name: port for name, port in ports.items() if name != "safe"})
    margins = diagram.GetOutputPort(ports["margins"])
    safe = diagram.GetOutputPort(ports["safe"]) if "safe" in ports else None
    is_finite_at_start = np.isfinite(_state(context))

    def is_safe() -> bool:
        return bool(margins.Eval(context).min() >= 0 if safe is None else safe.Eval(context) >= 1)

    is_diverged = has_left = False
    try:
        simulator.Initialize()
        recorder.record(context, 0.0)
        has_left = not is_safe()
        for step in range(1, timing.num_steps + 1):
            if has_left:
                break
            for time_s in timing.monitor_times(step):
                advance_to(simulator, time_s)
                if has_left := not is_safe():
                    break
            recorder.record(context, time_s)
    except (Exception, SystemExit) as error:
        is_diverged = _is_divergence(error, context, is_finite_at_start)
        if not is_diverged or not recorder.arrays()["time_s"].size:
            raise EpisodeError(f"{who}: {type(error).__name__}: {error}") from error
        _LOGGER.info("%s diverged: %s", who, error)
    arrays: dict[str, Any] = recorder.arrays()
    arrays.setdefault("true_state", arrays["state"])
    arrays.setdefault("desired_output", arrays["desired_preview"][:, : arrays["output"].shape[1]])
    arrays.setdefault("features", np.empty((len(arrays["time_s"]), 0)))
    is_finite = np.all([(np.abs(arrays[name]) < LARGEST).all(axis=1) for name in RECORDED], axis=0)
    if is_diverged or not is_finite.all():
        num_rows = len(is_finite) if is_finite.all() else int(np.argmin(is_finite))
        if num_rows == 0:
            wrong = [name for name in RECORDED if not (np.abs(arrays[name][0]) < LARGEST).all()]
            raise EpisodeError(f"{who}: ports {wrong} are not finite at the start")
        cause = DIVERGED
        arrays = {name: rows[:num_rows] for name, rows in arrays.items()}
    else:
        worst = int(np.argmin(arrays["margins"][-1]))
        cause = constraint_names[worst] if has_left else ""
    return Episode(
        index=index,
        **arrays,
        is_safe=cause == "",
        cause=cause,
        first_step=min(first_step, len(arrays["time_s"]) - 1),
    )


_NUMERICAL_FAILURE = re.compile(
    r"solver failed to converge|Detected NaN|is NaN\b|non-finite value|step smaller than minimum"
    r"|Failure at .*(solver|multibody|integrator)"
)
"""Messages of numerical failures of Drake's contact solver, SceneGraph and integrators.

Drake raises them as RuntimeError, like any other error, and failed assertions, such as TAMSI's on a
huge force, as SystemExit."""


def _is_divergence(error: BaseException, context: Context, is_finite_at_start: np.ndarray) -> bool:
    """Whether an error is a numerical failure of the simulation, not a programming error."""
    if isinstance(error, DivergenceError):
        return True
    if type(error) in (RuntimeError, SystemExit) and _NUMERICAL_FAILURE.search(str(error)):
        return True
    # Any error that follows a state that became non-finite.
    state = _state(context)
    return bool((is_finite_at_start & ~np.isfinite(state)).any())


def _state(context: Context) -> np.ndarray:
    """Continuous and discrete state of a Context."""
    discrete = context.get_discrete_state()
    groups = [discrete.value(i) for i in range(discrete.num_groups())]
    return np.concatenate([context.get_continuous_state_vector().CopyToVector(), *groups])
