"""Verdicts on goals before the robot moves."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.calibration import PLAN, SAFE, UNKNOWN, UNSAFE
from drake_safety.learning.causes import cause_words, likely_cause
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import floats
from drake_safety.simulation.capabilities import HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop

_DEFAULT_THRESHOLD = 0.5  # Without a calibration.


class GoalThreshold(NamedTuple):
    """Thresholds from which a goal is safe and below which it is unsafe, and their origin."""

    threshold: float
    unsafe_below: float
    origin: str


def goal_threshold(assessment: SafetyAssessment) -> GoalThreshold:
    """The thresholds of verdicts on goals that `calibrate` has chosen; else the default."""
    if (stored := assessment.calibrations_.get(PLAN)) is not None:
        return GoalThreshold(stored.threshold, stored.unsafe_below, stored.origin)
    origin = "the default, which promises nothing: `drake-safety calibrate` chooses one"
    return GoalThreshold(_DEFAULT_THRESHOLD, _DEFAULT_THRESHOLD, origin)


@dataclass(frozen=True, kw_only=True, eq=False)
class GoalVerdict:
    """The verdict of an assessment on a goal, before the robot moves."""

    goal: np.ndarray  # In the world, (3,) [m].
    belief: np.ndarray = field(default_factory=lambda: np.array(EMPTY, dtype=float))
    """(safe, unsafe, don't know), (3,); its first entry is the paper's Γ."""
    probability: float = math.nan  # To stay safe; NaN outside the region sampled in training.
    threshold: float
    constraint_names: tuple[str, ...]
    cause_probability: np.ndarray
    predicted_margins: np.ndarray  # Smallest margin of each constraint [m, rad], (n_c,), or NaN.
    margin_unit: float = 1.0  # Scale by which margins are compared [m, rad].
    reason: str = ""  # Why the verdict is "don't know"; "" otherwise.

    @property
    def verdict(self) -> str:
        """The verdict: "safe", "unsafe" or "don't know"."""
        if self.reason:
            return UNKNOWN
        return SAFE if self.probability >= self.threshold else UNSAFE

    @property
    def is_accepted(self) -> bool:
        """Whether the verdict is "safe"."""
        return self.verdict == SAFE

    @property
    def cause(self) -> str:
        """The constraint most likely to be violated; "" without evidence."""
        return likely_cause(
            self.constraint_names, self.cause_probability, self.predicted_margins, self.margin_unit
        )

    @property
    def cause_margin(self) -> float:
        """The margin predicted for the cause [m, rad]; NaN if there is none."""
        names, cause = self.constraint_names, self.cause
        return float(self.predicted_margins[names.index(cause)]) if cause else math.nan

    def cause_words(self, angular_constraints: Collection[str]) -> tuple[str, str]:
        """Words for the cause and for its margin; see the function."""
        is_known = self.verdict != UNKNOWN
        return cause_words(self.cause, self.cause_margin, angular_constraints, is_known=is_known)


def assess_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float | None = None,
    unsafe_below: float | None = None,
) -> GoalVerdict:
    """Assesses the motion from standing to a goal, by state and plan at its start.

    Args:
        goal: (3,) [m], or a command; outside the region sampled in training it is "don't know".
        threshold: Probability from which the goal is safe; without it both thresholds are
            the calibrated ones of `goal_threshold`.
        unsafe_below: Probability below which it is unsafe, the threshold by default; in between
            it is "don't know".
    """
    if threshold is None:
        threshold, unsafe_below, _ = goal_threshold(assessment)
    goal, with_goals = checked_goal(goal), require(loop, HasGoals)
    box, words = with_goals.target_box, goal_words(with_goals)
    if np.all((goal >= box[0]) & (goal <= box[1])):
        return assess_goals(
            loop, assessment, goal[None], threshold=threshold, unsafe_below=unsafe_below
        )[0]
    place = "is outside" if np.isfinite(goal).all() else "is not finite, so not in"
    entries = zip(words.axes, *box.tolist(), strict=True)
    region = ", ".join(f"{axis} {low:g}…{high:g}" for axis, low, high in entries)
    region += " m" if words.is_point else ""
    margins = np.full(len(loop.constraint_names), np.nan)
    return GoalVerdict(
        goal=goal,
        threshold=threshold,
        constraint_names=tuple(loop.constraint_names),
        cause_probability=np.zeros_like(margins),
        predicted_margins=margins,
        reason=f"the {words.goal} {place} the region sampled in training, {region}",
    )


def assess_goals(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goals: np.ndarray,
    *,
    threshold: float,
    unsafe_below: float | None = None,
) -> list[GoalVerdict]:
    """Assesses goals (N, 3) inside the region sampled in training, as `assess_goal` does."""
    if len(goals) == 0:
        return []
    unsafe_below = threshold if unsafe_below is None else unsafe_below
    noun, inputs = goal_words(require(loop, HasGoals)).goal, goal_inputs(loop, goals)
    prediction = assessment.predict(*inputs)
    has_no_data = is_unknown(prediction.belief, assessment.parameters.initial_uncertainty)

    def reason(i: int) -> str:
        probability = prediction.probability[i]
        if prediction.novelty[i] > 1.0:
            name, deviation = assessment.strangest_input(*(part[i] for part in inputs))
            by = f"{abs(deviation):.0f} standard deviations from what the other entries say"
            return f"the input is unlike the training inputs: '{name}' differs by {by}"
        if has_no_data[i]:
            return f"too little training data near this {noun}'s embedding"
        if unsafe_below <= probability < threshold:
            where = f"{threshold:.3f}, where safe and unsafe {noun}s cannot be distinguished"
            return f"the probability {probability:.3f} lies between {unsafe_below:.3f} and {where}"
        return ""

    return [
        GoalVerdict(
            goal=np.array(goal, dtype=float),
            belief=prediction.belief[i],
            probability=float(prediction.probability[i]),
            threshold=threshold,
            constraint_names=tuple(loop.constraint_names),
            cause_probability=prediction.cause_probability[i],
            predicted_margins=prediction.predicted_margins[i],
            margin_unit=assessment.parameters.margin_unit,
            reason=reason(i),
        )
        for i, goal in enumerate(goals)
    ]


def goal_inputs(loop: ClosedLoop, goals: np.ndarray) -> list[np.ndarray]:
    """State, preview and features (N, ...) at the start of motions from standing to goals."""
    with_goals, context = require(loop, HasGoals), loop.CreateDefaultContext()
    ports = [loop.GetOutputPort(name) for name in ("state", "desired_preview", "features")]
    rows = []
    for goal in goals:
        with_goals.reset_standing(context, goal)
        rows.append([port.Eval(context).copy() for port in ports])
    return [np.array(column) for column in zip(*rows, strict=True)]


def checked_goal(goal: np.ndarray) -> np.ndarray:
    """Returns a goal as an array, (3,) [m]; it need not be finite."""
    goal = floats(goal)
    if goal.shape != (3,):
        raise ValueError(f"a goal is three numbers; got {goal.tolist()}")
    return goal
