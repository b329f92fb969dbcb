"""Adaptation during a simulation: an update of Γ after every k_u pairs of episodes."""

import itertools
import math
from collections import deque

import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from drake_safety.extras import require_extra
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.feedback import EpisodePair
from drake_safety.simulation.feedback import pair_windows
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor

_KEPT_UPDATES = 8
_KEPT_MOTION_S = 600.0


class OnlineAdaptation:
    """Advances a simulation and adapts the assessor of its diagram meanwhile.

    "For computational efficiency, the online adaptation process is performed once every k_u sets of
    feedback data" (paper). Nominal twins of the recorder's windows are simulated; after every k_u
    windows the prior assessment is adapted to the newest ``capacity`` pairs and the motion of at
    most ten minutes, and the assessor adopts the result. ``adapted`` has the newest eight.
    """

    def __init__(
        self,
        scenario: Scenario,
        prior: SafetyAssessment,
        recorder: FeedbackRecorder,
        assessor: MonitoredSafetyAssessor,
        *,
        capacity: int = 400,
    ):
        require_extra("train", "OnlineAdaptation", "sklearn")
        self._scenario, self._prior = scenario, prior
        self._recorder, self._assessor = recorder, assessor
        self._capacity, self._num_new = capacity, 0
        # Rows of the monitor, and None between motions.
        num_rows = round(_KEPT_MOTION_S / prior.detector_.step_s)
        self._motion: deque[np.ndarray | None] = deque(maxlen=num_rows)
        self._last_row_s = -math.inf
        self.feedback: list[EpisodePair] = []
        self.adapted: list[SafetyAssessment] = []
        self.num_updates = 0

    def advance(self, simulator: Simulator, until_s: float) -> SimulatorStatus:
        """Advances the simulation in place of `AdvanceTo`, with the updates that become due."""
        # Events and monitors of a simulation must not change its Context: updates are between two
        # calls of `AdvanceTo`, at the times of the recorder's rows.
        context, step_s = simulator.get_mutable_context(), self._recorder.info.step_s
        while True:
            status = self._advance_to_row(simulator, min(_next_row_s(context, step_s), until_s))
            is_ended = status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime
            if is_ended or context.get_time() >= until_s:
                return status
            simulator.AdvancePendingEvents()  # The row is recorded.
            self._update(context)

    def _advance_to_row(self, simulator: Simulator, until_s: float) -> SimulatorStatus:
        context, monitor = simulator.get_mutable_context(), self._assessor.monitor
        step_s = self._prior.detector_.step_s
        while monitor is not None and (row_s := _next_row_s(context, step_s)) <= until_s + 1e-9:
            # A row is of the time before the updates that are due at it.
            status = simulator.AdvanceTo(min(row_s - 4.0 * math.ulp(row_s), until_s))
            if status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime:
                return status
            if not math.isclose(row_s, self._last_row_s + step_s, rel_tol=0.0, abs_tol=1e-6):
                self._motion.append(None)  # The simulation began anew, or went on alone.
            own_context, self._last_row_s = monitor.GetMyContextFromRoot(context), row_s
            row = monitor.row(own_context)
            is_usual = not monitor.is_held(own_context) and np.isfinite(row).all()
            self._motion.append(row if is_usual else None)
        return simulator.AdvanceTo(until_s)

    def _update(self, root_context: Context) -> None:
        # Most rows finish no window; the mutable Context would invalidate caches.
        if not self._recorder.recording(self._recorder.GetMyContextFromRoot(root_context)).windows:
            return
        recorder_context = self._recorder.GetMyMutableContextFromRoot(root_context)
        windows = self._recorder.take_windows(recorder_context)
        pairs = pair_windows(self._scenario, self._recorder, windows)
        self.feedback = [*self.feedback, *pairs][-self._capacity :]
        self._num_new += len(pairs)
        if self._num_new < self._prior.parameters.adaptation.update_interval:
            return
        self._num_new = 0
        runs = itertools.groupby(self._motion, lambda row: row is not None)
        motions = [np.array([*rows]) for is_motion, rows in runs if is_motion]
        adapted = self._prior.adapt(self.feedback, motions=motions)
        self.adapted = [*self.adapted, adapted][-_KEPT_UPDATES:]
        self.num_updates += 1
        self._assessor.adopt(self._assessor.GetMyMutableContextFromRoot(root_context), adapted)


def _next_row_s(context: Context, step_s: float) -> float:
    return step_s * (math.floor(context.get_time() / step_s + 1e-6) + 1)
