"""Goals judged before anything moves: what Γ says of one, and which one near it Γ accepts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.calibration import SAFE, UNKNOWN, UNSAFE
from drake_safety.learning.causes import NO_CAUSE, likely_causes
from drake_safety.learning.prediction import is_unknown
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop

RESERVE = 0.8
"""Share of the way from the threshold to certainty by which a suggested goal exceeds the threshold.

At the threshold itself as many goals are safe as not: a suggestion must be better than that."""

_FIRST_RADIUS_M = 0.05
_GROWTH = 1.6  # From one ball of candidates to the next.
_LAST_CHANCE = (
    16  # Times as many candidates, all over the region, when no ball had an accepted one.
)
_SPREAD = 0.25  # How far these lie from it, as a share of its distance to the goal.


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


def nearest_accepted_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    rng: np.random.Generator,
    reserve: float = RESERVE,
    num_candidates: int = 64,
    num_rounds: int = 6,
    resolution_m: float = 1e-3,
    known: GoalVerdict | None = None,
) -> GoalVerdict | None:
    """The goal nearest to a given one that is accepted with reserve, as far as a search finds it.

    With reserve: Γ ≥ threshold + reserve (1 - threshold). The nearest goal lies at the limit that
    was searched with, and of those at the threshold itself many are unsafe.

    Candidates fill growing balls about the goal, in the end the whole region, until one of them is
    accepted. From there on the search goes down: a bisection towards the goal, then candidates
    about the best one and in the ball that it bounds, and so on. All candidates lie on a grid of
    ``resolution_m``: rounded to it, an accepted goal stays an accepted one.

    Args:
        loop: A closed loop whose plans have a goal.
        assessment: What was learned from its episodes.
        goal: In the world, (3,) [m]; it may lie outside the region sampled in training.
        threshold: From which Γ, calibrated, on a goal is safe.
        rng: Source of the candidates.
        reserve: Share of the way from the threshold to certainty, in [0, 1]; 0 suggests whatever
            is accepted.
        num_candidates: That are judged at a time.
        num_rounds: How often candidates are drawn about the best one that was found.
        resolution_m: Spacing of the grid of candidates [m].
        known: What is accepted with reserve already: balls grow only as far as that lies, with half
            as many candidates, and the whole region is not searched.

    Returns:
        The verdict on it, by the threshold itself; None when the goal is not finite, or nothing in
        the region is accepted with reserve.

    Raises:
        ValueError: The reserve is not in [0, 1], or the goal is not three numbers.
    """
    stricter = threshold_with_reserve(threshold, reserve)
    goal = checked_goal(goal)
    if not np.isfinite(goal).all():
        return None
    box = target_box(loop)
    centre = np.clip(goal, *box)

    def nearest_of(candidates: np.ndarray) -> GoalVerdict | None:
        points = np.unique(on_grid(candidates, resolution_m), axis=0)
        inside = points[np.all((points >= box[0]) & (points <= box[1]), axis=1)]
        verdicts = assess_goals(loop, assessment, inside, threshold=stricter)
        accepted = [verdict for verdict in verdicts if verdict.is_accepted]
        return min(accepted, key=lambda one: _distance(one.goal, goal), default=None)

    best = nearest_of(centre[None])
    radius, farthest = _FIRST_RADIUS_M, _distance(*box)
    num_in_ball = num_candidates
    if known is not None:
        farthest, num_in_ball = _distance(known.goal, goal), max(num_candidates // 2, 1)
    while best is None and radius < farthest:
        best = nearest_of(centre + radius * _in_unit_ball(rng, num_in_ball))
        radius *= _GROWTH
    if known is not None and (best is None or _distance(best.goal, goal) > farthest):
        best = known
    if best is None:
        best = nearest_of(rng.uniform(box[0], box[1], (_LAST_CHANCE * num_candidates, 3)))
    if best is None:
        return None

    for _ in range(num_rounds):
        best = _bisected(best, centre, nearest_of, resolution_m)
        distance = _distance(best.goal, goal)
        if distance < resolution_m:
            break
        about = best.goal + _SPREAD * distance * _in_unit_ball(rng, num_candidates // 2)
        ball = goal + distance * _in_unit_ball(rng, num_candidates - num_candidates // 2)
        candidates = np.clip(np.concatenate([about, ball]), *box)
        is_nearer = np.linalg.norm(candidates - goal, axis=1) < distance
        found = nearest_of(candidates[is_nearer])
        if found is not None and _distance(found.goal, goal) < distance:
            best = found
    return replace(best, threshold=threshold)


def threshold_with_reserve(threshold: float, reserve: float) -> float:
    """What Γ has to reach for a goal to be suggested.

    Args:
        threshold: From which Γ, calibrated, on a goal is safe.
        reserve: Share of the way from the threshold to certainty, in [0, 1].

    Raises:
        ValueError: The reserve is not in [0, 1].
    """
    if not 0.0 <= reserve <= 1.0:
        raise ValueError(f"nearest accepted goal: reserve is {reserve}, expected a value in [0, 1]")
    return threshold + reserve * max(1.0 - threshold, 0.0)


def _bisected(
    best: GoalVerdict, centre: np.ndarray, nearest_of: Any, resolution_m: float
) -> GoalVerdict:
    """Moves an accepted goal straight towards the centre for as long as it stays accepted."""
    refused = centre
    while _distance(best.goal, refused) > resolution_m:
        between = 0.5 * (best.goal + refused)
        found = nearest_of(between[None])
        if found is None:
            refused = between
        elif _distance(found.goal, centre) < _distance(best.goal, centre):
            best = found
        else:
            break
    return best


def on_grid(points: np.ndarray, resolution_m: float) -> np.ndarray:
    """The nearest points of the grid that suggested goals lie on.

    Args:
        points: In the world, (..., 3) [m].
        resolution_m: Spacing of the grid [m].
    """
    # A multiple of the spacing is not yet the number that is read back from its digits.
    return np.round(np.round(points / resolution_m) * resolution_m, 9)


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


def _in_unit_ball(rng: np.random.Generator, num_points: int) -> np.ndarray:
    """Points spread evenly in the unit ball, (N, 3)."""
    directions = rng.normal(size=(num_points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(rng.uniform(size=(num_points, 1)))


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
