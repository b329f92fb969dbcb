"""NoveltyMonitor: an alarm when plant or sensors no longer behave as in training."""

from __future__ import annotations

import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.blas_threads import one_blas_thread
from drake_safety.learning.innovation import KINDS, Innovation, describe
from drake_safety.learning.novelty import Novelty

LEVELS = KINDS[1:]
"""What the monitor watches, in the order of its port ``levels``."""


class NoveltyMonitor(LeafSystem):
    """Watches how each measured state follows from the last one.

    .. pydrake_system::

        name: NoveltyMonitor
        input_ports:
        - state
        - desired_preview
        - features (read in the sharpened mode only)
        - hold (optional)
        output_ports:
        - alarm
        - levels
        - alarm_cause

    Every step of training it predicts the state from the last inputs, and updates the charts of
    :class:`~drake_safety.learning.innovation.Innovation`. ``levels`` has five numbers in units of
    their limits: repeated inputs, the sums of the distance of x and of the innovation's norm, the
    fast and the slow chart. When one exceeds 1, ``alarm`` becomes 1 and stays so until the Context
    is reset, and ``alarm_cause`` says what was seen. While ``hold`` is above 0.5, as during a
    recovery step that training does not have, the charts wait. Innovation and novelty are a
    parameter of the Context, see :meth:`adopt`.
    """

    def __init__(self, assessment: SafetyAssessment):
        super().__init__()
        info, innovation = assessment.info_, assessment.innovation_
        self._assessment = assessment
        self.reads_features = assessment.uses_features and bool(info.feature_names)
        self._state_names = assessment.state_names
        self._learned = self.DeclareAbstractParameter(Value(_learned(assessment)))
        self._inputs = {
            "state": self.DeclareVectorInputPort("state", len(info.state_names)),
            "desired_preview": self.DeclareVectorInputPort(
                "desired_preview", info.horizon * len(info.output_names)
            ),
            "features": self.DeclareVectorInputPort("features", len(info.feature_names)),
        }
        self._hold_port = self.DeclareVectorInputPort("hold", 1)
        n_s, sizes = innovation.num_states, {}
        sizes["x"] = innovation.num_inputs
        sizes |= {"fast": n_s, "slow": n_s, "sums": 2, "repeats": 1, "levels": len(LEVELS)}
        sizes |= {"kind": 1, "seen": n_s}
        starts = np.cumsum([0, *sizes.values()]).tolist()
        self._places = {
            name: slice(start, start + size)
            for (name, size), start in zip(sizes.items(), starts, strict=False)
        }
        initial = np.zeros(starts[-1])
        initial[self._places["x"]] = np.nan
        state = self.DeclareDiscreteState(initial)
        self.DeclarePeriodicDiscreteUpdateEvent(info.step_s, 0.0, self._update)
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("alarm", BasicVector(1), self._calc_alarm, ticket)
        self.DeclareVectorOutputPort("levels", BasicVector(len(LEVELS)), self._calc_levels, ticket)
        self.DeclareAbstractOutputPort(
            "alarm_cause", lambda: Value(""), self._calc_alarm_cause, ticket
        )

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over innovation and novelty of an assessment adapted from this system's own."""
        context.get_mutable_abstract_parameter(self._learned).set_value(_learned(adapted))

    def reset(self, context: Context) -> None:
        """Ends the alarm and empties the charts."""
        state = context.get_mutable_discrete_state_vector()
        initial = np.zeros(state.size())
        initial[self._places["x"]] = np.nan
        state.SetFromVector(initial)

    @one_blas_thread
    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        innovation, novelty = context.get_abstract_parameter(self._learned).get_value()
        values = context.get_discrete_state_vector().get_value().copy()
        part = {name: values[place] for name, place in self._places.items()}  # Views.
        x = self._assessment.inputs_of(
            self._inputs["state"].Eval(context),
            self._inputs["desired_preview"].Eval(context),
            self._inputs["features"].Eval(context) if self.reads_features else None,
        )
        is_held = self._hold_port.HasValue(context) and self._hold_port.Eval(context)[0] > 0.5
        # Compares false for inputs that are not finite.
        is_usable = bool(x @ x < math.inf) and not is_held
        previous = part["x"].copy()
        part["x"][:] = x if is_usable else np.nan
        if is_usable and not math.isnan(previous[0]):
            is_repeated = np.array_equal(x, previous)
            part["repeats"][0] = part["repeats"][0] + 1.0 if is_repeated else 0.0
            error = innovation.of(previous[None], x[None, : innovation.num_states])[0]
            levels = part["levels"]
            for i, rate in enumerate(innovation.rates):
                average = part[("fast", "slow")[i]]
                average += rate * (error - average)
                whitened = average @ innovation.chart_whitenings[i]
                norm = math.sqrt(whitened @ whitened)
                levels[LEVELS.index("fast") + i] = norm / innovation.chart_limits[i]
            distance = novelty.of(x[None])[0]
            part["sums"][:] = innovation.next_sums(part["sums"], distance, error)
            levels[LEVELS.index("frozen")] = part["repeats"][0] / innovation.longest_repeat
            first = LEVELS.index("distance")
            levels[first : first + 2] = part["sums"] / innovation.sums[:, 2]
            if part["kind"][0] == 0.0 and levels.max() > 1.0:
                kind = 1 + int(np.argmax(levels > 1.0))
                part["kind"][0] = kind
                if KINDS[kind] in ("fast", "slow"):
                    part["seen"][:] = innovation.deviations(KINDS[kind], part[KINDS[kind]])
        discrete_state.set_value(values)

    def _of(self, context: Context, name: str) -> np.ndarray:
        values: np.ndarray = context.get_discrete_state_vector().get_value()[self._places[name]]
        return values

    def _calc_alarm(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._of(context, "kind")[0] > 0.0))

    def _calc_levels(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._of(context, "levels"))

    def _calc_alarm_cause(self, context: Context, output: Value) -> None:
        kind = KINDS[int(self._of(context, "kind")[0])]
        output.set_value(describe(kind, self._of(context, "seen"), self._state_names))


def _learned(assessment: SafetyAssessment) -> tuple[Innovation, Novelty]:
    return assessment.innovation_, assessment.novelty_
