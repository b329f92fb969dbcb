"""ChangeMonitor: an alarm when plant or sensors no longer behave as in training."""

import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from drake_safety.learning.change_detector import SETTLING_S, TIME_CONSTANTS_S, ChangeDetector


class ChangeMonitor(LeafSystem):
    """Watches how each measured state follows from the last two inputs.

    .. pydrake_system::

        name: ChangeMonitor
        input_ports: [state: n_s, desired_preview: H n_z,
          features: n_f (only if the prediction reads some), hold: 1 (optional)]
        output_ports: [alarm: 1, levels: n_w, alarm_cause: abstract, judged_share: 1,
          watched_inputs: n_u]

    Every step of its training it predicts the state and updates the charts of a
    :class:`~drake_safety.learning.change_detector.ChangeDetector`. When a watched state's level
    exceeds 1, ``alarm`` becomes 1 and ``alarm_cause`` says why, until all levels were below 0.7 for
    five seconds. Inputs that are not finite, and the two after each, cannot be judged.
    ``judged_share`` is the share of the others over two seconds; below a half every level is above
    1. The charts wait while a known disturbance acts, by ``hold`` or :meth:`expect_disturbance`,
    and `SETTLING_S` longer. ``watched_inputs`` are the newest inputs, named `input_names`, NaN
    while the charts wait. The detector is a parameter of the Context.

    Example: ``monitor = builder.AddSystem(ChangeMonitor(assessment))``
    """

    def __init__(self, assessment: SafetyAssessment):
        super().__init__()
        info, detector = assessment.info_, assessment.detector_
        self.level_names = [info.state_names[i] for i in detector.watched]
        self.input_names = detector.input_names(info)
        self._detector = self.DeclareAbstractParameter(Value(detector))
        num_states, num_preview = len(info.state_names), info.horizon * len(info.output_names)
        self._state_port = self.DeclareVectorInputPort("state", num_states)
        self._preview_port = self.DeclareVectorInputPort("desired_preview", num_preview)
        self._features_port = self.DeclareVectorInputPort("features", len(info.feature_names))
        self._hold_port = self.DeclareVectorInputPort("hold", 1)
        self.reads_features = bool((detector.columns >= num_states + num_preview).any())
        n_w, n_u = len(detector.watched), len(detector.columns)
        num_charts = 2 * len(TIME_CONSTANTS_S) * n_w
        self._initial = {
            "state": np.zeros(n_w),
            "x": np.full(n_u, np.nan),  # The last two inputs.
            "previous": np.full(n_u, np.nan),
            "charts": np.zeros(num_charts),
            "repeats": np.zeros(1),
            "judged_share": np.ones(1),
            "num_lost": np.zeros(1),  # Rows to come that lack a row before them.
            "levels": np.zeros(n_w),
            "alarm": np.zeros(1),
            "below_s": np.zeros(1),
            "at_alarm": np.zeros(num_charts + 2),  # Charts, repeats and share when it began.
            "expected_s": np.full(2, -math.inf),  # Begin and end.
            "held_s": np.full(1, -math.inf),  # Last time with `hold`.
        }
        self._groups = {name: self.DeclareDiscreteState(x) for name, x in self._initial.items()}
        self.DeclarePeriodicDiscreteUpdateEvent(detector.step_s, 0.0, self._update)
        for name in ("alarm", "levels", "judged_share"):
            self.DeclareStateOutputPort(name, self._groups[name])
        self.DeclareStateOutputPort("watched_inputs", self._groups["x"])
        self.DeclareAbstractOutputPort(
            "alarm_cause", lambda: Value(""), self._calc_alarm_cause, {self.xd_ticket()}
        )

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over the detector of an adapted assessment, ends the alarm, empties the charts."""
        context.get_mutable_abstract_parameter(self._detector).set_value(adapted.detector_)
        for name, value in self._initial.items():
            context.SetDiscreteState(self._groups[name], value)

    def expect_disturbance(self, context: Context, begin_s: float, end_s: float) -> None:
        """Lets the charts wait in an interval, and half a second longer.

        Args:
            context: The monitor's Context.
            begin_s, end_s: The interval, in the Context's time [s]; it extends an interval that has
                not settled.
        """
        begin, end = self._value(context, "expected_s")
        if context.get_time() < end + SETTLING_S:
            begin_s, end_s = min(begin_s, begin), max(end_s, end)
        context.SetDiscreteState(self._groups["expected_s"], np.array([begin_s, end_s]))

    def row(self, context: Context) -> np.ndarray:
        """State, preview and features at the ports, (n,); features not read are 0."""
        port = self._features_port
        features = port.Eval(context) if self.reads_features else np.zeros(port.size())
        state, preview = self._state_port.Eval(context), self._preview_port.Eval(context)
        return np.concatenate([state, preview, features])

    def is_held(self, context: Context) -> bool:
        """Whether the port ``hold`` makes it wait."""
        return self._hold_port.HasValue(context) and bool(self._hold_port.Eval(context)[0] > 0.5)

    def _value(self, context: Context, name: str) -> np.ndarray:
        value: np.ndarray = context.get_discrete_state(self._groups[name]).get_value()
        return value

    @ONE_BLAS_THREAD
    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        part = {name: self._value(context, name).copy() for name in self._groups}
        now_s, (begin_s, end_s) = context.get_time(), part["expected_s"]
        if self.is_held(context):
            part["held_s"][0] = now_s
        if begin_s <= now_s:
            part["held_s"][0] = max(part["held_s"][0], min(now_s, end_s))
        if now_s - part["held_s"][0] <= SETTLING_S - 1e-9:
            part["x"][:] = part["previous"][:] = np.nan
            part["repeats"][0] = part["num_lost"][0] = 0.0
        else:
            detector = context.get_abstract_parameter(self._detector).get_value()
            self._chart(part, detector, self.row(context))
        for name, index in self._groups.items():
            discrete_state.set_value(index, part[name])

    def _chart(
        self, part: dict[str, np.ndarray], detector: ChangeDetector, row: np.ndarray
    ) -> None:
        """Updates charts, levels and alarm in a copy of the discrete state."""
        x, state = row[detector.columns], row[detector.watched]
        is_finite = bool(x @ x < math.inf)  # Not for NaN.
        num_lost, is_charted = part["num_lost"], not math.isnan(part["previous"][0]) and is_finite
        is_lost = not is_finite or num_lost[0] > 0.0
        num_lost[0] = max(num_lost[0] - 1.0, 0.0) if is_finite else 2.0
        share = part["judged_share"]
        share += detector.rates[-1] * (float(not is_lost) - share)
        charts = part["charts"].reshape(-1, len(state))  # A view.
        if is_charted:
            innovation = detector.innovation(part["x"], part["previous"], state - part["state"])
            charts[:] = detector.updated(charts, innovation)
        is_repeated = np.array_equal(x, part["x"])  # Not for NaN.
        part["repeats"][0] = part["repeats"][0] + 1.0 if is_repeated else 0.0
        part["previous"][:] = part["x"] if is_finite else np.nan
        part["x"][:], part["state"][:] = x if is_finite else np.nan, state
        if is_lost or is_charted:
            levels, before = detector.levels(charts, part["repeats"], share), part["alarm"][0]
            part["levels"][:] = levels
            below_s, highest = part["below_s"][0], float(levels.max())
            part["alarm"][0], part["below_s"][0] = detector.next_alarm(before, below_s, highest)
            if part["alarm"][0] > before:
                part["at_alarm"][:] = np.concatenate([part["charts"], part["repeats"], share])

    def _calc_alarm_cause(self, context: Context, output: Value) -> None:
        cause = ""
        if self._value(context, "alarm")[0] > 0.0:
            *_, repeats, share = at_alarm = self._value(context, "at_alarm")
            charts = at_alarm[:-2].reshape(-1, len(self.level_names))
            detector = context.get_abstract_parameter(self._detector).get_value()
            cause = detector.cause(charts, repeats, self.level_names, share)
        output.set_value(cause)
