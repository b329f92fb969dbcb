"""Simulation of a diagram from a start to an end, and its log."""

import logging
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, EventStatus, PortDataType, System

from drake_safety.files.schema import check_times
from drake_safety.learning.segments import (
    DIVERGED,
    LARGEST,
    RECORDED,
    DivergenceError,
    Episode,
    EpisodeError,
)
from drake_safety.simulation.closed_loop import ClosedLoop, require_ports

_SAME_TIME = 1e-3  # Largest difference between the times reached and asked for, in steps.
_ENDED = SimulatorStatus.ReturnReason.kReachedTerminationCondition
_FAILED = EventStatus.Failed
_LOGGER = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True)
class End:
    """When a simulated motion ends, whatever comes first."""

    duration_s: float  # Since the start.
    after_leaving_s: float = math.inf  # Outside the safe set.
    after_fall_s: float = 0.0  # After a violation of the diagram's `fall_name`.
    until: str = ""  # Constraint whose violation ends the motion.
    until_first_row: bool = False  # Whether the first row with an undisturbed future ends it.


@dataclass(kw_only=True, eq=False)
class Motion:
    """Log of a simulated motion; ``motion[name]`` is a logged port, (N, size)."""

    time_s: np.ndarray  # Times of the rows, since the start, (N,).
    ports: dict[str, np.ndarray]
    leave_time_s: float = math.inf  # When it left the safe set, if it did.
    cause: str = ""  # The constraint that was violated then.
    fall_time_s: float = math.inf
    failure: str = ""  # Why the simulation ended early, if it did.
    first_row: int = 0  # The first with an undisturbed future.
    index: int = 0
    push_time_s: float = math.inf  # Start of a push, or impact of the first ball.

    def __getitem__(self, port: str) -> np.ndarray:
        return self.ports[port]

    @property
    def has_left(self) -> bool:
        """Whether the state left the safe set."""
        return math.isfinite(self.leave_time_s)

    @property
    def has_fallen(self) -> bool:
        """Whether the robot fell."""
        return math.isfinite(self.fall_time_s)

    @property
    def recovery_intervals_s(self) -> list[tuple[float, float]]:
        """First and last time of each recovery [s]."""
        return self.intervals_s("recovery_active")

    def intervals_s(self, port: str) -> list[tuple[float, float]]:
        """First and last times at which a port was 1 [s]; what lasts to the end ends there."""
        active = self.ports.get(port, np.zeros((len(self.time_s), 1)))[:, 0]
        begins, ends = np.diff(active, prepend=0.0) > 0, np.diff(active, append=0.0) < 0
        return [*zip(self.time_s[begins].tolist(), self.time_s[ends].tolist(), strict=True)]

    def episode(self, num_features: int = 0) -> Episode:
        """The motion as an episode, with the defaults of `record_episodes` for unlogged ports."""
        num_rows, cause = len(self.time_s), DIVERGED if self.failure else self.cause
        rows: dict[str, Any] = {
            "true_state": self["state"],
            "desired_output": self["desired_preview"][:, : self["output"].shape[1]],
            "features": np.zeros((num_rows, num_features)),
            "num_controller_failures": np.zeros((num_rows, 1)),
        } | self.ports
        return Episode(
            index=self.index,
            time_s=self.time_s,
            **{name: rows[name] for name in RECORDED},
            is_safe=cause == "",
            cause=cause,
            first_step=min(self.first_row, num_rows - 1),
            num_controller_failures=int(rows["num_controller_failures"][-1, 0]),
        )


class Recorder:
    """Records output ports of a diagram, row by row; a mapping renames recorded ports."""

    def __init__(self, diagram: Diagram, names: Iterable[str] | Mapping[str, str] = RECORDED):
        self.names = names if isinstance(names, Mapping) else {name: name for name in names}
        require_ports(diagram, self.names.values())
        self._ports = {name: diagram.GetOutputPort(port) for name, port in self.names.items()}
        self._rows: list[dict[str, np.ndarray]] = []
        self._times: list[float] = []

    def __len__(self) -> int:
        return len(self._times)

    def record(
        self, context: Context, time_s: float | None = None, *, is_checked: bool = False
    ) -> None:
        """Appends a row; if ``is_checked``, of finite values alone."""
        row = {name: np.array(port.Eval(context)) for name, port in self._ports.items()}
        time_s = context.get_time() if time_s is None else time_s
        if is_checked:
            wrong = [n for n in RECORDED if n in row and not (np.abs(row[n]) < LARGEST).all()]
            if wrong:
                raise DivergenceError(f"ports {wrong} are not finite at {time_s:g} s")
        self._rows.append(row)
        self._times.append(time_s)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns ``time_s`` (N,) [s] and, by name, (N, size) for a vector port, else (N,)."""
        arrays = {}
        for name, port in self._ports.items():
            is_vector = port.get_data_type() == PortDataType.kVectorValued
            shape = (len(self._rows), port.size()) if is_vector else len(self._rows)
            arrays[name] = np.array([row[name] for row in self._rows]).reshape(shape)
        return {"time_s": np.array(self._times), **arrays}


def simulate(
    diagram: Diagram,
    start: Callable[[Context], int | None],
    ports: Iterable[str] | Mapping[str, str],
    end: End,
    *,
    step_s: float = 0.02,
    watch_period_s: float = math.inf,
    events: Iterable[tuple[float, Callable[[Context], object]]] = (),
    each_row: Callable[[Context], object] = lambda context: None,
    monitor: Callable[[Context], object] | None = None,
    constraint_names: Sequence[str] = (),
    may_fail: bool = False,
    index: int = 0,
    who: str = "motion",
) -> Motion:
    """Simulates a diagram from a start to an end, and logs output ports.

    A row shows the state at its time, before the updates that are due then; times count from that
    of the Context after the start. A motion that ends as it leaves the safe set, or as a system
    ends it (``EventStatus.ReachedTermination``), has its last row then, between two others.

    Args:
        start: Sets state, plan and perhaps time of the default root Context. It may return the
            first row whose future is undisturbed, if that is not 0.
        ports: Ports to log; a mapping of logged names to port names renames them, also ``margins``
            and ``safe``. Without a port ``safe`` a negative margin is unsafe.
        step_s: Time between two rows [s].
        watch_period_s: Sampling period of the safe set [s]; by default it is sampled at rows.
        events: Times [s] and functions that change the Context then.
        monitor: Called with the Context after each step of the simulator; it may end it.
        may_fail: Whether a failure of the simulation is a result, ``Motion.failure``, with the rows
            that are finite; otherwise it raises ``EpisodeError``, as an error of a system does.
    """
    times = {"step_s": step_s, "watch_period_s": min(watch_period_s, step_s)}
    check_times(who, or_zero=["duration_s"], duration_s=end.duration_s, **times)
    recorder = Recorder(diagram, ports)
    margins_port = diagram.GetOutputPort(recorder.names.get("margins", "margins"))
    safe = recorder.names.get("safe", "safe")
    safe_port = diagram.GetOutputPort(safe) if diagram.HasOutputPort(safe) else None
    simulator = Simulator(diagram)
    if monitor is not None:
        simulator.set_monitor(monitor)
    context = simulator.get_mutable_context()
    names, fall = list(constraint_names), None
    if isinstance(diagram, ClosedLoop):
        names = names or diagram.constraint_names
        fall = names.index(diagram.fall_name) if diagram.fall_name else None
        diagram.prepare(context)
    first_row = start(context)
    begin_s = context.get_time()
    is_finite_at_start = np.abs(_state(context)) < LARGEST
    waiting = sorted(events, key=lambda event: event[0])
    leave_s = fall_s = math.inf
    now_s, is_ended, is_last = 0.0, False, False
    cause = failure = ""

    def is_over(time_s: float) -> bool:
        nonlocal leave_s, fall_s, cause
        margins = margins_port.Eval(context)
        if len(wrong := np.flatnonzero(~(np.abs(margins) < LARGEST))):
            # The margin that shows a divergence, if there is one.
            k = max(wrong, key=lambda i: not margins[i] > 0.0)
            text = f"constraint '{names[k]}' has a margin of {margins[k]} at {time_s:g} s"
            if margins[k] > 0:
                raise ValueError(f"{text}; cap it at a finite distance, such as a query's range")
            raise DivergenceError(text)
        is_safe = margins.min() >= 0 if safe_port is None else safe_port.Eval(context)[0] >= 1
        if not is_safe and not cause:
            leave_s, cause = time_s, names[int(np.argmin(margins))]
        if fall is not None and margins[fall] < 0:
            fall_s = min(fall_s, time_s)
        if end.until and (cause == end.until or margins[names.index(end.until)] < 0):
            return True
        return time_s >= min(leave_s + end.after_leaving_s, fall_s + end.after_fall_s)

    def advance(to_s: float) -> None:
        nonlocal now_s, is_ended
        is_ended = is_ended or advance_to(simulator, begin_s + to_s)
        reached_s = context.get_time() - begin_s
        now_s = reached_s if is_ended else to_s
        if not abs(reached_s - now_s) < _SAME_TIME * step_s:
            raise ValueError(f"the simulation is at {reached_s} s, expected at {to_s} s")

    try:
        EventStatus.Failed = _failed
        if not 0.0 <= begin_s < math.inf:
            raise ValueError(f"it starts at {begin_s} s; Drake's periodic events begin at 0 s")
        is_ended = simulator.Initialize().reason() == _ENDED
        num_steps = first_row or 0 if end.until_first_row else round(end.duration_s / step_s)
        for row in range(num_steps + 1):
            # The safe set is sampled since the row before, and at the row.
            count = math.ceil(step_s / watch_period_s - 1e-6) if row else 1
            between_s = [(row - 1) * step_s + i * watch_period_s for i in range(1, count)]
            for time_s in (*between_s, row * step_s):
                while waiting and waiting[0][0] <= time_s:
                    event_s, act = waiting.pop(0)
                    advance(event_s)
                    if not is_ended:
                        act(context)
                advance(time_s)
                if is_last := is_over(now_s) or is_ended:
                    break
            if is_ended and row:  # Perhaps at the instant of the row before.
                now_s = max(now_s, math.nextafter((row - 1) * step_s, math.inf))
            recorder.record(context, now_s, is_checked=True)
            each_row(context)
            if is_last:
                break
    except (Exception, SystemExit) as error:
        if not (len(recorder) and _is_divergence(error, context, is_finite_at_start)):
            raise EpisodeError(f"{who}: {type(error).__name__}: {error}") from error
        if not may_fail:
            raise EpisodeError(f"{who}: the simulation failed: {error}") from error
        failure = str(error)
        _LOGGER.info("%s diverged: %s", who, error)
    finally:
        EventStatus.Failed = _FAILED
    arrays = recorder.arrays()
    return Motion(
        time_s=arrays.pop("time_s"),
        ports=arrays,
        leave_time_s=leave_s,
        cause=cause,
        fall_time_s=fall_s,
        failure=failure,
        first_row=int(first_row or 0),  # It may be one of NumPy's.
        index=index,
    )


def _failed(system: System | None, message: str) -> None:
    """Raises a system's failure as an error: pydrake crashes on that of a system in Python."""
    raise RuntimeError(f"system '{system and system.get_name()}' failed: {message}")


def advance_to(simulator: Simulator, time_s: float) -> bool:
    """Advances to a time, before its updates; returns whether a system has ended the simulation."""
    # The update due at a time computes the next state: a row after it would not belong to its time.
    # Both this time and Drake's time of an update are products, rounded in the last bit or two.
    before_s = time_s - 4.0 * math.ulp(time_s)
    is_later = before_s > simulator.get_context().get_time()
    return is_later and simulator.AdvanceTo(before_s).reason() == _ENDED


# Drake's contact solver, SceneGraph and integrators raise RuntimeError, as any other error; failed
# assertions, such as TAMSI's on a huge force, are SystemExit.
_NUMERICAL_FAILURE = re.compile(
    r"solver failed to converge|Detected NaN|is NaN\b|non-finite value|step smaller than minimum"
    r"|Failure at .*(solver|multibody|integrator)"
)


def _is_divergence(error: BaseException, context: Context, is_finite_at_start: np.ndarray) -> bool:
    if isinstance(error, DivergenceError):
        return True
    if type(error) in (RuntimeError, SystemExit) and _NUMERICAL_FAILURE.search(str(error)):
        return True
    # Any error that follows a state that became non-finite, or huge.
    return bool((is_finite_at_start & ~(np.abs(_state(context)) < LARGEST)).any())


def _state(context: Context) -> np.ndarray:
    discrete = context.get_discrete_state()
    groups = [discrete.value(i) for i in range(discrete.num_groups())]
    return np.concatenate([context.get_continuous_state_vector().CopyToVector(), *groups])
