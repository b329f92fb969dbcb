"""Adaptation during a simulation: an update of Γ after every k_u feedback sets."""

from __future__ import annotations

from collections.abc import Callable

from pydrake.systems.framework import Context, EventStatus

from drake_safety.extras import require_extra
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.feedback import FeedbackSet
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.feedback import feedback_of_windows, run_twins
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.novelty_monitor import NoveltyMonitor
from drake_safety.systems.safety_assessor import SafetyAssessor

_KEPT_UPDATES = 8


class OnlineAdaptation:
    """Adapts the assessor of a running diagram; a monitor of Drake's `Simulator`.

    "For computational efficiency, the online adaptation process is performed once every k_u sets of
    feedback data" (paper). Whenever the recorder has finished windows, their nominal twins are
    simulated; after every k_u windows the prior assessment is adapted to the feedback so far, and
    the assessor adopts the result. The simulation waits meanwhile. The object keeps feedback of one
    simulation; use another one for another Context.

    ```python
    adaptation = OnlineAdaptation(scenario, prior, recorder, assessor)
    simulator.set_monitor(adaptation)
    ```

    Args:
        scenario: The scenario.
        prior: The assessment before feedback.
        recorder: The recorder, a system of the diagram.
        assessor: The assessor, a system of the diagram.
        monitor: The monitor, if the diagram has one.
        method: Method of `SafetyAssessment.adapt`.
        run: Function that simulates the twins; see `feedback_of_windows`.
        capacity: Largest number of feedback sets kept; the oldest are dropped.

    Attributes:
        feedback: All feedback so far, up to the capacity.
        adapted: The assessments after the newest eight updates.
    """

    def __init__(
        self,
        scenario: Scenario,
        prior: SafetyAssessment,
        recorder: FeedbackRecorder,
        assessor: SafetyAssessor,
        *,
        monitor: NoveltyMonitor | None = None,
        method: str | None = None,
        run: Callable[..., Episodes] = run_twins,
        capacity: int = 400,
    ):
        require_extra("train", "OnlineAdaptation", "sklearn")
        if capacity < 1:
            raise ValueError(f"OnlineAdaptation: capacity is {capacity}, expected >= 1")
        self._scenario, self._prior, self._method = scenario, prior, method
        self._recorder, self._assessor, self._run = recorder, assessor, run
        self._monitor = monitor
        self._capacity, self._num_new = capacity, 0
        self.feedback: list[FeedbackSet] = []
        self.adapted: list[SafetyAssessment] = []

    def __call__(self, root_context: Context) -> EventStatus:
        """Takes finished windows and, after every k_u of them, updates the assessor."""
        # Most steps finish no window; the mutable Context would invalidate caches.
        seen = self._recorder.recording(self._recorder.GetMyContextFromRoot(root_context))
        if not seen.windows:
            return EventStatus.DidNothing()
        windows = self._recorder.take_windows(
            self._recorder.GetMyMutableContextFromRoot(root_context)
        )
        new = feedback_of_windows(self._scenario, self._recorder, windows, run=self._run)
        self.feedback = [*self.feedback, *new][-self._capacity :]
        self._num_new += len(new)
        if self._num_new < self._prior.parameters.adaptation.update_interval:
            return EventStatus.Succeeded()
        self._num_new = 0
        adapted = self._prior.adapt(self.feedback, method=self._method)
        self.adapted = [*self.adapted, adapted][-_KEPT_UPDATES:]
        self._assessor.adopt(
            self._assessor.GetMyMutableContextFromRoot(root_context), self.adapted[-1]
        )
        if self._monitor is not None:
            own_context = self._monitor.GetMyMutableContextFromRoot(root_context)
            self._monitor.adopt(own_context, self.adapted[-1])
            self._monitor.reset(own_context)
        return EventStatus.Succeeded()
