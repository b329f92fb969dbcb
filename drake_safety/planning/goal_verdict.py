"""Goals judged before anything moves: what Γ says of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.calibration import SAFE, UNKNOWN, UNSAFE
from drake_safety.learning.prediction import NO_CAUSE, is_unknown, likely_causes
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop


@dataclass(frozen=True, kw_only=True, eq=False)
class GoalVerdict:
    """What an assessment says of a goal, before anything moves.

    Attributes:
        goal: The goal in the world, (3,) [m].
        verdict: "safe", "unsafe" or "don't know".
        belief: (safe, unsafe, don't know), (3,).
        safety_probability: Γ, calibrated; NaN where Γ was not asked, because the goal is
            outside what it has learned.
        threshold: From which Γ on a goal is safe.
        constraint_names: The n_c constraints, the possible causes.
        cause_probability: b_unsafe split by the constraint that will be violated, (n_c,).
        predicted_margins: Smallest margin of each constraint that is expected, (n_c,); NaN where
            none is predicted.
        margin_unit: Margin that counts as one when margins are compared [m, rad].
        reason: Why the answer is "don't know"; "" otherwise.
    """

    goal: np.ndarray
    verdict: str
    belief: np.ndarray
    safety_probability: float
    threshold: float
    constraint_names: tuple[str, ...]
    cause_probability: np.ndarray
    predicted_margins: np.ndarray
    margin_unit: float = 1.0
    reason: str = ""

    @property
    def is_accepted(self) -> bool:
        """Whether the robot may go there."""
        return self.verdict == SAFE

    @property
    def cause(self) -> str:
        """The constraint that is most likely to be violated; "" where nothing speaks for any."""
        (column,) = likely_causes(
            self.cause_probability[None], self.predicted_margins[None], self.margin_unit
        )
        return "" if column == NO_CAUSE else self.constraint_names[column]

    @property
    def cause_margin(self) -> float:
        """The margin that is predicted for the cause [m, rad]; NaN where none is."""
        if not self.cause:
            return math.nan
        return float(self.predicted_margins[self.constraint_names.index(self.cause)])

    def to_json(self) -> dict[str, Any]:
        """As plain values; what is unknown is None."""
        by_name = zip(self.constraint_names, self.cause_probability.tolist(), strict=True)
        return {
            "goal": [_finite(value) for value in self.goal.tolist()],
            "verdict": self.verdict,
            "reason": self.reason,
            "belief": dict(zip(("safe", "unsafe", "unknown"), self.belief.tolist(), strict=True)),
            "safety_probability": _finite(self.safety_probability),
            "threshold": self.threshold,
            "cause": self.cause or None,
            "cause_probability": dict(by_name),
            "cause_margin": _finite(self.cause_margin),
        }


def assess_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    unsafe_below: float | None = None,
) -> GoalVerdict:
    """What an assessment says of going from the standing posture to a goal.

    Nothing is simulated: the state, the plan and the features of the first instant are judged.

    Args:
        loop: A closed loop whose plans have a goal.
        assessment: What was learned from its episodes.
        goal: In the world, (3,) [m]. One that is not finite, or outside the region that was
            sampled in training, is answered with "don't know" and the region.
        threshold: From which Γ, calibrated, on a goal is safe.
        unsafe_below: Below which it is unsafe, and "don't know" in between; the threshold by
            default.

    Raises:
        ValueError: The loop's plans have no goal, or the goal is not three numbers.
    """
    goal = checked_goal(goal)
    box = target_box(loop)
    if np.isfinite(goal).all() and np.all((goal >= box[0]) & (goal <= box[1])):
        (verdict,) = assess_goals(
            loop, assessment, goal[None], threshold=threshold, unsafe_below=unsafe_below
        )
        return verdict
    what = "is outside" if np.isfinite(goal).all() else "is not finite, so not in"
    names = tuple(loop.constraint_names)
    return GoalVerdict(
        goal=goal,
        verdict=UNKNOWN,
        belief=np.array(EMPTY, dtype=float),
        safety_probability=math.nan,
        threshold=threshold,
        constraint_names=names,
        cause_probability=np.zeros(len(names)),
        predicted_margins=np.full(len(names), np.nan),
        reason=f"the target {what} the region sampled in training, {_region(box)}",
    )


def assess_goals(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goals: np.ndarray,
    *,
    threshold: float,
    unsafe_below: float | None = None,
) -> list[GoalVerdict]:
    """What an assessment says of goals inside the region that was sampled in training.

    Γ is taken for unknown where more than half of the belief comes from cells that know nothing.

    Args:
        loop: A closed loop whose plans have a goal.
        assessment: What was learned from its episodes.
        goals: In the world, (N, 3) [m].
        threshold: From which Γ, calibrated, on a goal is safe.
        unsafe_below: Below which it is unsafe, and "don't know" in between; the threshold by
            default.
    """
    if len(goals) == 0:
        return []
    unsafe_below = threshold if unsafe_below is None else unsafe_below
    said = assessment.predict(*goal_inputs(loop, goals))
    is_open = is_unknown(said.belief, assessment.parameters.initial_uncertainty)
    verdicts = []
    for i, goal in enumerate(goals):
        reason = ""
        verdict = SAFE if said.calibrated[i] >= threshold else UNSAFE
        if unsafe_below <= said.calibrated[i] < threshold:
            verdict = UNKNOWN
            reason = (
                f"Γ {said.calibrated[i]:.3f} lies between {unsafe_below:.3f} and "
                f"{threshold:.3f}, where safe and unsafe targets cannot be told apart"
            )
        if is_open[i]:
            verdict = UNKNOWN
            reason = "training came too seldom near what this target looks like to the assessment"
        verdicts.append(
            GoalVerdict(
                goal=np.array(goal, dtype=float),
                verdict=verdict,
                belief=said.belief[i],
                safety_probability=float(said.calibrated[i]),
                threshold=threshold,
                constraint_names=tuple(loop.constraint_names),
                cause_probability=said.cause_probability[i],
                predicted_margins=said.predicted_margins[i],
                margin_unit=assessment.parameters.margin_unit,
                reason=reason,
            )
        )
    return verdicts


def goal_inputs(loop: ClosedLoop, goals: np.ndarray) -> tuple[np.ndarray, ...]:
    """What an assessment judges goals by: the first instant on the way from standing to each.

    Args:
        loop: A closed loop whose plans have a goal.
        goals: In the world, (N, 3) [m], N ≥ 1.

    Returns:
        State (N, n_s), desired preview (N, H n_z) and features (N, n_f).
    """
    context = loop.CreateDefaultContext()
    ports = [loop.GetOutputPort(name) for name in ("state", "desired_preview", "features")]
    rows = []
    with_goals = require(loop, HasGoals)
    for goal in goals:
        with_goals.reset_standing(context, goal)
        rows.append([port.Eval(context).copy() for port in ports])
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def target_box(loop: ClosedLoop) -> np.ndarray:
    """Lowest and highest corner of the goals that were sampled in training, (2, 3) [m].

    Raises:
        ValueError: The task's plans have no goal.
    """
    return require(loop, HasGoals).target_box


def checked_goal(goal: np.ndarray) -> np.ndarray:
    """A goal as an array, (3,) [m]; it need not be finite.

    Raises:
        ValueError: It is not three numbers.
    """
    goal = np.asarray(goal, dtype=float)
    if goal.shape != (3,):
        raise ValueError(f"a target is three numbers [m]; got {goal.tolist()}")
    return goal


def _region(box: np.ndarray) -> str:
    return (
        ", ".join(f"{axis} {low:g}…{high:g}" for axis, low, high in zip("xyz", *box, strict=True))
        + " m"
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
