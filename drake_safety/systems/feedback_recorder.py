"""FeedbackRecorder: labelled windows of a running robot's motion, for adaptation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, State

from drake_safety.files.schema import check_times
from drake_safety.learning.causes import violated
from drake_safety.learning.segments import RECORDED, Episode, Episodes, EpisodesInfo

_MOST_WINDOWS = 400


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedWindow:
    """A labelled window of a robot's motion."""

    episode: Episode
    plant_state: np.ndarray
    start_time_s: float
    controller_memory: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """State of a recorder; immutable, so that copies of the Context share it."""

    rows: tuple[tuple[np.ndarray, ...], ...] = ()
    times_s: tuple[float, ...] = ()
    start: Mapping[str, np.ndarray] = field(default_factory=dict)
    windows: tuple[RecordedWindow, ...] = ()
    num_finished: int = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Recording:
        return self


class FeedbackRecorder(LeafSystem):
    """Records windows of a running robot's motion; the label of each is how it ended.

    .. pydrake_system::

        name: FeedbackRecorder
        input_ports: [state: n_s, true_state: n_s (optional), output: n_z, desired_output: n_z,
          desired_preview: H n_z, features: n_f, margins: n_c, safe: 1, plant_state: n_q + n_v,
          controller_memory: n (with ``controller_memory_size``), recovery_active: 1 (optional)]
        output_ports: [num_finished: 1]

    A window ends safe after ``num_steps`` steps, and the next begins with its last row. It ends
    unsafe as soon as ``safe`` is below one, and the next begins when ``safe`` is one again. The
    open window is dropped when time jumps, and during recovery, which its twin lacks. The newest
    400 windows are state of the Context. ``true_state`` defaults to ``state``. A window's twin
    begins at ``plant_state`` and ``controller_memory``.

    Args:
        info: Names of the ports' entries, and the time between two rows, ``step_s``.
        watch_period_s: Sampling period of ``safe`` [s].
    """

    def __init__(
        self,
        info: EpisodesInfo,
        *,
        num_steps: int,
        plant_state_size: int,
        watch_period_s: float,
        controller_memory_size: int = 0,
    ):
        super().__init__()
        check_times("feedback recorder", watch_period_s=watch_period_s, step_s=info.step_s)
        self.info = info
        self._num_steps = num_steps
        num_outputs, num_margins = len(info.output_names), len(info.constraint_names)
        sizes = {
            "state": len(info.state_names),
            "true_state": len(info.state_names),
            "output": num_outputs,
            "desired_output": num_outputs,
            "desired_preview": info.horizon * num_outputs,
            "features": len(info.feature_names),
            "margins": num_margins,
            "safe": 1,
            "plant_state": plant_state_size,
        }
        self._start_ports = ["plant_state"]
        if controller_memory_size:
            sizes["controller_memory"] = controller_memory_size
            self._start_ports.append("controller_memory")
        sizes["recovery_active"] = 1
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        # A latch: when the safe set was left since the last row, and the margins at that time.
        self._closed_latch = np.append(-np.inf, np.zeros(num_margins))
        self.DeclareDiscreteState(self._closed_latch)
        self._index = self.DeclareAbstractState(Value(Recording()))
        self.DeclarePeriodicDiscreteUpdateEvent(watch_period_s, 0.0, self._watch)
        self.DeclarePeriodicUnrestrictedUpdateEvent(info.step_s, 0.0, self._record)
        self.DeclareVectorOutputPort("num_finished", 1, self._calc_num_finished)

    def recording(self, context: Context) -> Recording:
        """Returns the recorder's state in a Context."""
        return context.get_abstract_state(int(self._index)).get_value()

    def take_windows(self, context: Context) -> list[RecordedWindow]:
        """Removes the finished windows from a Context and returns them."""
        recording = self.recording(context)
        context.SetAbstractState(int(self._index), replace(recording, windows=()))
        return list(recording.windows)

    def _calc_num_finished(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.array([self.recording(context).num_finished], dtype=float))

    def _is_safe(self, context: Context) -> bool:
        return bool(self._ports["safe"].Eval(context)[0] >= 1.0)

    def _watch(self, context: Context, discrete_state: DiscreteValues) -> None:
        latch = context.get_discrete_state_vector().get_value()
        if latch[0] == -np.inf and not self._is_safe(context):
            margins = self._ports["margins"].Eval(context)
            discrete_state.set_value(np.append(context.get_time(), margins))

    def _record(self, context: Context, state: State) -> None:
        recording, time_s = self.recording(context), context.get_time()
        ports = dict(self._ports)
        if not ports["true_state"].HasValue(context):
            ports["true_state"] = ports["state"]
        row = tuple(ports[name].Eval(context).copy() for name in RECORDED)
        left_s, *left_margins = context.get_discrete_state_vector().get_value()
        # A latch of before a jump in time says nothing.
        was_left = 0.0 <= time_s - left_s <= 1.01 * self.info.step_s
        if was_left:
            row = (*row[:-1], np.minimum(row[-1], left_margins))
        has_left = was_left or not self._is_safe(context)
        without_open = Recording(windows=recording.windows, num_finished=recording.num_finished)
        step_s, recovery = self.info.step_s, ports["recovery_active"]
        if recording.times_s and abs(time_s - recording.times_s[-1] - step_s) > 0.01 * step_s:
            recording = without_open
        if recovery.HasValue(context) and recovery.Eval(context)[0] != 0.0:
            recording = without_open
        elif recording.rows or not has_left:
            recording = self._extended(context, recording, row)
            is_full = len(recording.rows) == self._num_steps + 1
            if has_left or is_full:
                recording = self._finished(recording, is_safe=not has_left)
            if is_full and not has_left:
                recording = self._extended(context, recording, row)
        state.get_mutable_discrete_state().set_value(self._closed_latch)
        state.get_mutable_abstract_state(int(self._index)).set_value(recording)

    def _extended(
        self, context: Context, recording: Recording, row: tuple[np.ndarray, ...]
    ) -> Recording:
        start = recording.start
        if not recording.rows:
            start = {name: self._ports[name].Eval(context).copy() for name in self._start_ports}
        rows, times_s = (*recording.rows, row), (*recording.times_s, context.get_time())
        return replace(recording, rows=rows, times_s=times_s, start=start)

    def _finished(self, recording: Recording, *, is_safe: bool) -> Recording:
        columns = [np.array(column) for column in zip(*recording.rows, strict=True)]
        arrays: dict[str, Any] = dict(zip(RECORDED, columns, strict=True))
        times_s = np.array(recording.times_s)
        episode = Episode(
            index=recording.num_finished,
            time_s=times_s - times_s[0],
            **arrays,
            is_safe=is_safe,
            cause="" if is_safe else self.info.constraint_names[violated(arrays["margins"][-1])],
        )
        Episodes(self.info, [episode])  # Checks the shapes.
        window = RecordedWindow(episode=episode, start_time_s=float(times_s[0]), **recording.start)
        windows = (*recording.windows, window)[-_MOST_WINDOWS:]
        return Recording(windows=windows, num_finished=recording.num_finished + 1)
