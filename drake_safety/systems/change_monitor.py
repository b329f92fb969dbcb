"""ChangeMonitor: an alarm when plant or sensors no longer behave as in training."""

from __future__ import annotations

import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.blas_threads import one_blas_thread
from drake_safety.learning.change_detector import TIME_CONSTANTS_S, ChangeDetector

SETTLING_S = 0.5
"""Time for which the charts wait on after a disturbance that is known [s]."""


class ChangeMonitor(LeafSystem):
    """Watches how each measured state follows from the last two inputs.

    .. pydrake_system::

        name: ChangeMonitor
        input_ports:
        - state: n_s
        - desired_preview: H n_z
        - features: n_f (only if the prediction reads some)
        - hold: 1 (optional)
        output_ports:
        - alarm: 1
        - levels: n_w
        - alarm_cause: abstract
        - judged_share: 1

    Every step of its training it predicts the state and updates the charts of a
    :class:`~drake_safety.learning.change_detector.ChangeDetector`. ``levels`` has the level of each
    watched state in units of its limit. When one exceeds 1, ``alarm`` becomes 1 and
    ``alarm_cause`` says what was seen; it ends when all were below 0.7 for five seconds, or with a
    reset. Without enough motion for limits there is no alarm. An input that is not finite cannot be
    judged, nor the two after it: ``judged_share`` is the share of the others over the last two
    seconds, and below a half every level is above 1. The charts wait while a disturbance that is
    known acts, such as a ball, a push or a recovery step, and `SETTLING_S` longer: while ``hold``
    is above 0.5, or as told by :meth:`expect_disturbance`. The detector is a parameter of the
    Context, see :meth:`adopt`.
    """

    def __init__(self, assessment: SafetyAssessment):
        super().__init__()
        info, detector = assessment.info_, assessment.detector_
        self.level_names = [info.state_names[i] for i in detector.watched]
        self._detector = self.DeclareAbstractParameter(Value(detector))
        sizes = {
            "state": len(info.state_names),
            "desired_preview": info.horizon * len(info.output_names),
            "features": len(info.feature_names),
        }
        self._inputs = {
            name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        }
        num_without = sizes["state"] + sizes["desired_preview"]
        self.reads_features = bool((detector.columns >= num_without).any())
        self._hold_port = self.DeclareVectorInputPort("hold", 1)
        n_w, n_u = len(detector.watched), len(detector.columns)
        n_charts = 2 * len(TIME_CONSTANTS_S) * n_w
        # `num_lost` rows lack a row before them; `seen` are charts, repeats and share at the alarm.
        parts = {"state": n_w, "x": n_u, "previous": n_u, "charts": n_charts, "repeats": 1}
        parts |= {"judged": 1, "num_lost": 1}
        parts |= {"levels": n_w, "alarm": 1, "calm_s": 1, "seen": n_charts + 2}
        parts |= {"expected_s": 2, "held_s": 1}  # Begin and end; last time with `hold`.
        starts = np.cumsum([0, *parts.values()]).tolist()
        self._places = {
            name: slice(start, start + size)
            for (name, size), start in zip(parts.items(), starts, strict=False)
        }
        self._initial = np.zeros(starts[-1])
        for name in ("x", "previous"):
            self._initial[self._places[name]] = np.nan
        for name in ("expected_s", "held_s"):
            self._initial[self._places[name]] = -math.inf
        self._initial[self._places["judged"]] = 1.0
        state = self.DeclareDiscreteState(self._initial)
        self.DeclarePeriodicDiscreteUpdateEvent(detector.step_s, 0.0, self._update)
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("alarm", BasicVector(1), self._calc_alarm, ticket)
        self.DeclareVectorOutputPort("levels", BasicVector(n_w), self._calc_levels, ticket)
        self.DeclareAbstractOutputPort(
            "alarm_cause", lambda: Value(""), self._calc_alarm_cause, ticket
        )
        self.DeclareVectorOutputPort("judged_share", BasicVector(1), self._calc_share, ticket)

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over the detector of an assessment adapted from this system's own."""
        context.get_mutable_abstract_parameter(self._detector).set_value(adapted.detector_)

    def reset(self, context: Context) -> None:
        """Ends the alarm and empties the charts."""
        context.get_mutable_discrete_state_vector().SetFromVector(self._initial)

    def expect_disturbance(self, context: Context, begin_s: float, end_s: float) -> None:
        """Lets the charts wait in an interval of time [s], and until what it does has settled.

        An interval that begins before the last one has settled extends it, else it replaces it.
        """
        expected_s = context.get_mutable_discrete_state_vector().get_mutable_value()
        expected_s = expected_s[self._places["expected_s"]]
        if context.get_time() < expected_s[1] + SETTLING_S:
            begin_s, end_s = min(begin_s, expected_s[0]), max(end_s, expected_s[1])
        expected_s[:] = begin_s, end_s

    def row(self, context: Context) -> np.ndarray:
        """(state, desired preview, features) at the ports, (n,); features not read are 0."""
        features = self._inputs["features"]
        return np.concatenate(
            [
                self._inputs["state"].Eval(context),
                self._inputs["desired_preview"].Eval(context),
                features.Eval(context) if self.reads_features else np.zeros(features.size()),
            ]
        )

    def is_held(self, context: Context) -> bool:
        """Whether the port ``hold`` makes it wait."""
        return self._hold_port.HasValue(context) and bool(self._hold_port.Eval(context)[0] > 0.5)

    @one_blas_thread
    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        detector = self._detector_of(context)
        values = context.get_discrete_state_vector().get_value().copy()
        part = {name: values[place] for name, place in self._places.items()}  # Views.
        now_s, (begin_s, end_s) = context.get_time(), part["expected_s"]
        if self.is_held(context):
            part["held_s"][0] = now_s
        if begin_s <= now_s:
            part["held_s"][0] = max(part["held_s"][0], min(now_s, end_s))
        if now_s - part["held_s"][0] <= SETTLING_S - 1e-9:
            part["x"][:] = part["previous"][:] = np.nan
            part["repeats"][0] = part["num_lost"][0] = 0.0
        else:
            self._chart(part, detector, self.row(context))
        discrete_state.set_value(values)

    def _chart(
        self, part: dict[str, np.ndarray], detector: ChangeDetector, row: np.ndarray
    ) -> None:
        """Updates charts, levels and alarm in a copy of the discrete state."""
        x, state = row[detector.columns], row[detector.watched]
        is_finite = bool(x @ x < math.inf)  # Not for NaN.
        num_lost, is_charted = part["num_lost"], not math.isnan(part["previous"][0]) and is_finite
        is_lost = not is_finite or num_lost[0] > 0.0
        num_lost[0] = max(num_lost[0] - 1.0, 0.0) if is_finite else 2.0
        part["judged"] += detector.rates[-1] * (float(not is_lost) - part["judged"])
        if is_charted:
            innovation = detector.innovation(part["x"], part["previous"], state - part["state"])
            charts = part["charts"].reshape(-1, len(state))
            part["charts"][:] = detector.updated(charts, innovation).ravel()
        is_repeated = np.array_equal(x, part["x"])  # Not for NaN.
        part["repeats"][0] = part["repeats"][0] + 1.0 if is_repeated else 0.0
        part["previous"][:] = part["x"] if is_finite else np.nan
        part["x"][:], part["state"][:] = x if is_finite else np.nan, state
        if is_lost or is_charted:
            self._judge(part, detector)

    def _judge(self, part: dict[str, np.ndarray], detector: ChangeDetector) -> None:
        """Updates levels and alarm in a copy of the discrete state."""
        seen = part["charts"].reshape(-1, len(self.level_names)), part["repeats"], part["judged"]
        part["levels"][:] = detector.levels(*seen)
        before = part["alarm"][0]
        part["alarm"][0], part["calm_s"][0] = detector.next_alarm(
            before, part["calm_s"][0], float(part["levels"].max())
        )
        if part["alarm"][0] > before:
            part["seen"][:] = np.concatenate([part["charts"], *seen[1:]])

    def _detector_of(self, context: Context) -> ChangeDetector:
        detector: ChangeDetector = context.get_abstract_parameter(self._detector).get_value()
        return detector

    def _of(self, context: Context, name: str) -> np.ndarray:
        values: np.ndarray = context.get_discrete_state_vector().get_value()[self._places[name]]
        return values

    def _calc_alarm(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._of(context, "alarm")[0])

    def _calc_levels(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._of(context, "levels"))

    def _calc_alarm_cause(self, context: Context, output: Value) -> None:
        cause = ""
        if self._of(context, "alarm")[0] > 0.0:
            seen = self._of(context, "seen")
            charts = seen[:-2].reshape(-1, len(self.level_names))
            cause = self._detector_of(context).cause(charts, seen[-2], self.level_names, seen[-1])
        output.set_value(cause)

    def _calc_share(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._of(context, "judged"))
