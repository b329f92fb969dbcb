"""SafetyAssessor: a fitted assessment as a system."""

from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import EMPTY, empty
from drake_safety.learning.causes import is_on, is_outside, violated
from drake_safety.systems.periodic_update import declare_update

_LARGEST_NOVELTY = 1e6


class SafetyAssessor(LeafSystem):
    """Evaluates Γ on the measured state and the upcoming desired trajectory.

    .. pydrake_system::

        name: SafetyAssessor
        input_ports: [state: n_s, desired_preview: H n_z,
          features: n_f (read in the sharpened mode only), margins: n_c (with ``checks_margins``),
          alarm: 1 (with ``heeds_alarm``)]
        output_ports: [safety_probability: 1, belief: 3, cause_probability: n_c, embedding: 2,
          predicted_margins: n_c, novelty: 1, probability_without_alarm: 1, belief_without_alarm: 3,
          fall_probability: 1, learned: abstract]

    - ``belief`` has the paper's Γ first. It is (0, 0, 1) for inputs that are novel or not finite,
      before the first evaluation, and during an alarm.
    - ``safety_probability`` is from the maps' heads with the correction from feedback, or the
      belief's first entry in the paper's mode.
    - ``fall_probability`` is 1 for inputs that are not finite, and NaN if no falls were learned.
    - ``learned``, the only output with direct feedthrough, is for a `CommandGuard`.

    Beliefs, correction and novelty are parameters of the Context, see :meth:`adopt`.

    Args:
        period_s: Time between two evaluations [s], between which the outputs are held.
        checks_margins: Whether the belief's mass for "safe" counts as unsafe while one of the
            measured state's ``margins`` is negative or not finite.
        heeds_alarm: Whether beliefs are empty during an alarm.

    Example: ``assessor = builder.AddSystem(SafetyAssessor(assessment, period_s=0.04))``
    """

    def __init__(
        self,
        assessment: SafetyAssessment,
        *,
        period_s: float,
        checks_margins: bool = True,
        heeds_alarm: bool = True,
    ):
        super().__init__()
        info = assessment.info_
        self._assessment = assessment
        self._shape = assessment.beliefs_.shape
        # A diagram without features has no port to connect.
        self.reads_features = assessment.uses_features and bool(info.feature_names)
        n_c = len(info.constraint_names)
        beliefs = BasicVector(np.asarray(assessment.beliefs_, dtype=float).ravel())
        self._beliefs = self.DeclareNumericParameter(beliefs)
        corrections = assessment.correction_, assessment.novelty_
        self._corrections = self.DeclareAbstractParameter(Value(corrections))
        self._state_port = self.DeclareVectorInputPort("state", len(info.state_names))
        num_preview = info.horizon * len(info.output_names)
        self._preview_port = self.DeclareVectorInputPort("desired_preview", num_preview)
        self._features_port = self.DeclareVectorInputPort("features", len(info.feature_names))
        self._margins_port = self._alarm_port = None
        learned_from = {self.all_parameters_ticket()}
        if checks_margins:
            self._margins_port = self.DeclareVectorInputPort("margins", n_c)
        if heeds_alarm:
            self._alarm_port = self.DeclareVectorInputPort("alarm", 1)
            learned_from.add(self.input_port_ticket(self._alarm_port.get_index()))
        initial = {
            "safety_probability": np.zeros(1),
            "belief": EMPTY,
            "cause_probability": np.zeros(n_c),
            "embedding": np.zeros(2),
            "predicted_margins": np.zeros(n_c),
            "novelty": np.zeros(1),
            "probability_without_alarm": np.zeros(1),
            "belief_without_alarm": EMPTY,
            "fall_probability": np.full(1, np.nan),
        }
        self._outputs = {name: self.DeclareDiscreteState(value) for name, value in initial.items()}
        for name, index in self._outputs.items():
            self.DeclareStateOutputPort(name, index)
        declare_update(self, self._update, self._update, period_s, 0.0)
        self.DeclareAbstractOutputPort(
            "learned", lambda: Value[object]({}), self._calc_learned, learned_from
        )

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over what an assessment adapted from this system's own has learned."""
        own, other = self._assessment.embedding_, adapted.embedding_
        if other is not own and not other.is_same(own):
            raise ValueError("safety assessor: the assessment has other maps; build a new diagram")
        beliefs = np.asarray(adapted.beliefs_, dtype=float).ravel()
        context.get_mutable_numeric_parameter(self._beliefs).SetFromVector(beliefs)
        corrections = adapted.correction_, adapted.novelty_
        context.get_mutable_abstract_parameter(self._corrections).set_value(corrections)

    def _is_alarmed(self, context: Context) -> bool:
        return self._alarm_port is not None and is_on(self._alarm_port.Eval(context)[0])

    def _learned(self, context: Context) -> dict[str, Any]:
        correction, novelty = context.get_abstract_parameter(self._corrections).get_value()
        beliefs = context.get_numeric_parameter(self._beliefs).get_value().reshape(self._shape)
        return {"beliefs": beliefs, "correction": correction, "novelty": novelty}

    def _calc_learned(self, context: Context, output: Value) -> None:
        learned = self._learned(context)
        if self._is_alarmed(context):
            learned["beliefs"] = empty(self._shape[:-1], self._shape[-1] - 3)
        output.set_value(learned)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        without_alarm = self._assessment.predict_one(
            self._state_port.Eval(context),
            self._preview_port.Eval(context),
            self._features_port.Eval(context) if self.reads_features else None,
            **self._learned(context),
        )
        if self._margins_port is not None:
            margins = self._margins_port.Eval(context)
            if is_outside(margins):
                without_alarm = without_alarm.outside(violated(margins))
        prediction = without_alarm.unknown() if self._is_alarmed(context) else without_alarm
        values = vars(prediction) | {
            "safety_probability": prediction.probability,
            "novelty": min(prediction.novelty, _LARGEST_NOVELTY),
            "probability_without_alarm": without_alarm.probability,
            "belief_without_alarm": without_alarm.belief,
        }
        for name, index in self._outputs.items():
            discrete_state.set_value(index, np.atleast_1d(values[name]))
