"""CommandGuard: passes on the accepted velocity command nearest to the asked one."""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.policies.policy import CommandLimits
from drake_safety.systems.periodic_update import declare_update

_SHARES = np.linspace(0.0, 1.0, 6)  # Factors on each entry of the asked command.


class CommandGuard(LeafSystem):
    """Replaces commands to a walking robot's policy that Γ does not accept.

    .. pydrake_system::

        name: CommandGuard
        input_ports: [command: 3, state: n_s, features: n_f, learned: abstract (optional)]
        output_ports: [desired_output: n_z, desired_preview: H n_z, desired_outlook: M n_z,
          is_changed: 1, safety_probability: 1]

    Every ``period_s`` the guard assesses the asked command, held from now on. It passes on a
    command whose probability, ``safety_probability``, reaches the threshold. Otherwise
    ``desired_output`` is the nearest accepted candidate, measured in the policy's ranges, or the
    most probable. Candidates scale each entry of the asked command down. ``learned`` of a
    :class:`~drake_safety.systems.safety_assessor.SafetyAssessor` replaces the assessment's beliefs.
    ``with_commands`` maps features (n_f,) and commands (C, 3) to the commands' features (C, n_f).
    """

    def __init__(
        self,
        assessment: SafetyAssessment,
        with_commands: Callable[[np.ndarray, np.ndarray], np.ndarray],
        limits: CommandLimits,
        *,
        threshold: float,
        period_s: float,
        offset_s: float = 0.0,
        num_outlook: int,
    ):
        super().__init__()
        info = assessment.info_
        self._assessment, self._with_commands = assessment, with_commands
        self._threshold, self._horizon = threshold, info.horizon
        self._lowest, self._highest = np.array(limits.lowest), np.array(limits.highest)
        self._command_port = self.DeclareVectorInputPort("command", 3)
        self._state_port = self.DeclareVectorInputPort("state", len(info.state_names))
        self._features_port = self.DeclareVectorInputPort("features", len(info.feature_names))
        self._learned_port = self.DeclareAbstractInputPort("learned", Value[object]({}))
        self._is_acting = self.DeclareNumericParameter(BasicVector([1.0]))
        command = self._command = self.DeclareDiscreteState(3)
        self._is_changed, self._probability = map(self.DeclareDiscreteState, (1, 1))
        declare_update(self, self._update, self._update, period_s, offset_s)
        self.DeclareStateOutputPort("desired_output", command)
        for name, count in (("desired_preview", info.horizon), ("desired_outlook", num_outlook)):
            self.DeclareVectorOutputPort(
                name,
                BasicVector(3 * count),
                lambda context, output, count=count: output.SetFromVector(
                    np.tile(context.get_discrete_state(self._command).get_value(), count)
                ),
                {self.discrete_state_ticket(command)},
            )
        self.DeclareStateOutputPort("is_changed", self._is_changed)
        self.DeclareStateOutputPort("safety_probability", self._probability)

    def set_acting(self, context: Context, is_acting: bool) -> None:
        """Sets whether the guard acts, from its next decision on."""
        context.get_mutable_numeric_parameter(self._is_acting).SetAtIndex(0, float(is_acting))

    def candidates(self, asked: np.ndarray) -> np.ndarray:
        """Commands that may replace an asked one, nearest first, (C, 3) [m/s, rad/s]."""
        shares = np.stack(np.meshgrid(*[_SHARES] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = np.clip(asked, self._lowest, self._highest)
        commands = np.vstack([inside, shares * asked, shares * inside])
        distance = np.linalg.norm((commands - asked) / (self._highest - self._lowest), axis=1)
        return commands[np.argsort(distance, kind="stable")]

    def _probabilities(self, context: Context, commands: np.ndarray) -> np.ndarray:
        state, features = self._state_port.Eval(context), self._features_port.Eval(context)
        if not (np.isfinite(state).all() and np.isfinite(features).all()):
            return np.zeros(len(commands))
        learned = self._learned_port.Eval(context) if self._learned_port.HasValue(context) else {}
        return self._assessment.predict(
            np.tile(state, (len(commands), 1)),
            np.tile(commands, self._horizon),
            self._with_commands(features, commands),
            **learned,
        ).probability

    def _decide(self, context: Context, asked: np.ndarray) -> tuple[np.ndarray, float]:
        if not np.isfinite(asked).all():
            return np.zeros(3), 0.0
        asked_probability = float(self._probabilities(context, asked[None])[0])
        if asked_probability >= self._threshold:
            return asked, asked_probability
        commands = self.candidates(asked)
        probability = self._probabilities(context, commands)
        is_accepted = probability >= self._threshold
        chosen = int(np.argmax(is_accepted)) if is_accepted.any() else int(np.argmax(probability))
        if not probability[chosen] > 0:  # Nothing is known: as asked, within the ranges.
            return np.clip(asked, self._lowest, self._highest), asked_probability
        return commands[chosen], asked_probability

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        asked = self._command_port.Eval(context)
        command, probability = self._decide(context, asked)
        if np.isfinite(asked).all() and not context.get_numeric_parameter(self._is_acting)[0] > 0:
            command = asked
        discrete_state.set_value(self._command, command)
        discrete_state.set_value(self._is_changed, [float(np.any(command != asked))])
        discrete_state.set_value(self._probability, [probability])
