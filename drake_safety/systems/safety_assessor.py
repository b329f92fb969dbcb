"""SafetyAssessor: a fitted assessment as a system."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import EMPTY, empty
from drake_safety.learning.causes import is_on, is_outside, violated
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.prediction import Correction
from drake_safety.learning.segments import floats
from drake_safety.systems.periodic_update import declare_update

_LARGEST_NOVELTY = 1e6


class SafetyAssessor(LeafSystem):
    """Evaluates Γ on the measured state and the upcoming desired trajectory.

    .. pydrake_system::

        name: SafetyAssessor
        input_ports:
        - state: n_s
        - desired_preview: H n_z
        - features: n_f (read in the sharpened mode only)
        - margins: n_c (with ``checks_margins``)
        - alarm: 1 (with ``heeds_alarm``)
        output_ports:
        - safety_probability: 1
        - belief: 3
        - cause_probability: n_c
        - embedding: 2
        - predicted_margins: n_c
        - novelty: 1
        - probability_without_alarm: 1
        - belief_without_alarm: 3
        - fall_probability: 1
        - learned: abstract

    Γ is evaluated every ``period_s`` and held, so no output but ``learned`` has direct feedthrough.
    ``belief`` is (safe, unsafe, don't know), and its first entry the paper's Γ.
    ``safety_probability`` is the probability of staying safe, by the maps' heads with the
    correction from feedback; the paper's mode has no heads, and it is the belief's first entry. It
    is 0 where the belief is "don't know". ``novelty`` is the distance of the inputs from those of
    training, novel above 1. ``fall_probability`` is 1 for inputs that are not finite, and NaN for
    an assessment that has learned no falls. The belief of inputs that are novel or not finite is
    (0, 0, 1), and so is the belief before the first evaluation, and every belief while ``alarm`` is
    above 0.5, as that of a :class:`~drake_safety.systems.change_monitor.ChangeMonitor`, or not
    finite. While one of ``margins``, those of the measured state, is negative or not finite, no
    belief is safe: its mass for "safe" counts as unsafe by the first constraint that is not finite,
    else the most violated one. The beliefs of the grid, the correction and the novelty are
    parameters of the Context: :meth:`adopt` replaces them by those of an adapted assessment,
    between simulations and during them. ``probability_without_alarm`` and ``belief_without_alarm``
    are what they are without an alarm, for a recovery. ``learned`` has all three, with empty
    beliefs during an alarm, for a
    :class:`~drake_safety.diagrams.walking.command_guard.CommandGuard`. The embedding is immutable.

    Args:
        period_s: Time between two evaluations [s].
        checks_margins: Whether no belief is safe outside the safe set.
        heeds_alarm: Whether every belief is unknown during an alarm.
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
        self._belief_index = self.DeclareNumericParameter(
            BasicVector(np.asarray(assessment.beliefs_, dtype=float).ravel())
        )
        self._learned = self.DeclareAbstractParameter(Value(_learned(assessment)))
        self._state_port = self.DeclareVectorInputPort("state", len(info.state_names))
        self._preview_port = self.DeclareVectorInputPort(
            "desired_preview", info.horizon * len(info.output_names)
        )
        self._features_port = self.DeclareVectorInputPort("features", len(info.feature_names))
        self._margins_port = self._alarm_port = None
        if checks_margins:
            self._margins_port = self.DeclareVectorInputPort("margins", n_c)
        if heeds_alarm:
            self._alarm_port = self.DeclareVectorInputPort("alarm", 1)
        sizes = {
            "safety_probability": 1,
            "belief": 3,
            "cause_probability": n_c,
            "embedding": 2,
            "predicted_margins": n_c,
            "novelty": 1,
            "probability_without_alarm": 1,
            "belief_without_alarm": 3,
            "fall_probability": 1,
        }
        first = np.concatenate(
            [EMPTY if "belief" in name else np.zeros(size) for name, size in sizes.items()]
        )
        first[-1] = np.nan  # The probability of a fall.
        state = self._state = self.DeclareDiscreteState(first)
        declare_update(self, self._update, self._update, period_s, 0.0)
        start = 0
        for name, size in sizes.items():
            rows = slice(start, start + size)
            start += size
            self.DeclareVectorOutputPort(
                name,
                BasicVector(size),
                lambda context, output, rows=rows: output.SetFromVector(
                    context.get_discrete_state(self._state).get_value()[rows]
                ),
                {self.discrete_state_ticket(state)},
            )
        ports = filter(None, [self._alarm_port])
        self.DeclareAbstractOutputPort(
            "learned",
            lambda: Value[object]({}),
            lambda context, output: output.set_value(self._present(context)),
            {self.all_parameters_ticket(), *(self.input_port_ticket(p.get_index()) for p in ports)},
        )

    def get_beliefs(self, context: Context) -> np.ndarray:
        """Returns the beliefs in a Context, shaped as the assessment's ``beliefs_``."""
        return context.get_numeric_parameter(self._belief_index).get_value().reshape(self._shape)

    def set_beliefs(self, context: Context, beliefs: np.ndarray) -> None:
        """Replaces the beliefs of every cell."""
        beliefs = floats(beliefs)
        if beliefs.shape != self._shape:
            raise ValueError(
                f"safety assessor: beliefs must have shape {self._shape}; got {beliefs.shape}"
            )
        if not np.isfinite(beliefs).all():
            raise ValueError("safety assessor: beliefs must be finite numbers; got NaN or inf")
        context.get_mutable_numeric_parameter(self._belief_index).SetFromVector(beliefs.ravel())

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over what an assessment adapted from this system's own has learned."""
        if adapted.embedding_ is not self._assessment.embedding_ and not (
            adapted.embedding_.is_same(self._assessment.embedding_)
        ):
            raise ValueError(
                "safety assessor: the assessment to adopt has other maps; build the diagram anew"
            )
        self.set_beliefs(context, adapted.beliefs_)
        context.get_mutable_abstract_parameter(self._learned).set_value(_learned(adapted))

    def _is_alarmed(self, context: Context) -> bool:
        return self._alarm_port is not None and is_on(self._alarm_port.Eval(context)[0])

    def _beliefs_now(self, context: Context) -> dict[str, Any]:
        """What has been learned, as arguments of a prediction."""
        correction, novelty = context.get_abstract_parameter(self._learned).get_value()
        beliefs = self.get_beliefs(context)
        return {"beliefs": beliefs, "correction": correction, "novelty": novelty}

    def _present(self, context: Context) -> dict[str, Any]:
        """The same; during an alarm all beliefs are empty."""
        none = {"beliefs": empty(self._shape[:-1], self._shape[-1] - 3)}
        return self._beliefs_now(context) | (none if self._is_alarmed(context) else {})

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        prediction = self._assessment.predict_one(
            self._state_port.Eval(context),
            self._preview_port.Eval(context),
            self._features_port.Eval(context) if self.reads_features else None,
            **self._beliefs_now(context),
        )
        if self._margins_port is not None:
            margins = self._margins_port.Eval(context)
            if is_outside(margins):
                prediction = prediction.outside(violated(margins))
        without_alarm = prediction
        if self._is_alarmed(context):
            prediction = prediction.unknown()
        # In the order of the ports.
        discrete_state.set_value(
            self._state,
            np.concatenate(
                [
                    (prediction.probability,),
                    prediction.belief,
                    prediction.cause_probability,
                    prediction.embedding,
                    prediction.predicted_margins,
                    (min(prediction.novelty, _LARGEST_NOVELTY),),
                    (without_alarm.probability,),
                    without_alarm.belief,
                    (prediction.fall_probability,),
                ]
            ),
        )


def _learned(assessment: SafetyAssessment) -> tuple[Correction, Novelty]:
    return assessment.correction_, assessment.novelty_
