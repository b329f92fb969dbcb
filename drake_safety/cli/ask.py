"""``drake-safety ask``: the verdict on a target, without motion; and targets of other commands."""

from typing import Annotated, Any

import numpy as np
from typer import Exit, Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.files.reading import is_number
from drake_safety.learning.calibration import UNSAFE
from drake_safety.learning.causes import describe_margin
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goal, goal_threshold
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.simulation.capabilities import HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop


def ask(
    scenario: console.ScenarioArgument,
    target: console.TargetOption = None,
    assessment: console.AssessmentOption = None,
    hand: console.HandOption = None,
    duration: Annotated[
        float | None,
        Option(help="Duration of a command [s], then a stop; by default an episode.", min=0.1),
    ] = None,
    mode: console.ModeOption = MODES[0],
) -> None:
    """Print the verdict on a target, or on a command of a walking robot; nothing moves.

    Exit code: 0 accepted, 1 refused ("don't know" is a refusal), 2 error.
    """
    with console.console.capture() as origin:  # The origin of Γ, printed last.
        loaded, _, gamma = folders.open_assessment(scenario, assessment, mode)
    loop = loaded.make_loop(assessment=gamma, **console.given(hand=hand, command_s=duration))
    if not isinstance(loop, HasGoals):
        raise ValueError(
            f"ask: task '{type(loop).__name__}' has no targets or commands to ask about; "
            f"`drake-safety run {scenario}` shows what Γ says during its motion"
        )
    if target is None:
        raise ValueError("ask: pass --target, or for a walking robot --command")
    goal, rule = parse_target(loop, target), goal_threshold(gamma)
    verdict, nearest = judge_target(loop, goal)
    print_verdict(loop, verdict, nearest, rule.origin)
    console.say(origin.get().rstrip())
    if not verdict.is_accepted:
        raise Exit(1)


def parse_target(loop: ClosedLoop, text: str) -> np.ndarray:
    """The goal of ``--target`` or ``--command``, (3,): a name, or three numbers with spaces."""
    with_goals = require(loop, HasGoals, "--target")
    named_targets, words = with_goals.named_targets, goal_words(with_goals)
    if text in named_targets:
        return np.array(named_targets[text], dtype=float)
    entries = text.split()
    if len(entries) == 3 and all(map(is_number, entries)):
        return np.array([float(entry) for entry in entries])
    raise ValueError(
        f"{words.goal} '{text}': give {' '.join(words.axes)} [{', '.join(words.units)}], or one of "
        f"the names that scenario '{loop.scenario.name}' gives: {list(named_targets)}"
    )


def judge_target(loop: Any, goal: np.ndarray) -> tuple[GoalVerdict, GoalVerdict | None]:
    """The verdict on a target and, for a refusal, on the nearest one accepted with reserve."""
    gamma = loop.assessment
    verdict = assess_goal(loop, gamma, goal)
    if verdict.is_accepted:
        return verdict, None
    rng = np.random.default_rng(0)  # The same answer every time.
    return verdict, nearest_accepted_goal(loop, gamma, goal, threshold=verdict.threshold, rng=rng)


def print_verdict(
    loop: ClosedLoop, verdict: GoalVerdict, nearest: GoalVerdict | None, origin: str
) -> None:
    """Prints a verdict and its reason, for a refusal what would be accepted, then numbers."""
    words = goal_words(require(loop, HasGoals))
    probability, threshold = verdict.probability, verdict.threshold
    subject = f" of {words.subject}" if words.is_point else ""
    sign = "<" if probability < threshold else "≥"
    numbers = f"probability {probability:.3f} {sign} threshold {threshold:.3f}"
    because, name, margin = verdict.reason or numbers, verdict.cause, verdict.cause_margin
    if verdict.verdict == UNSAFE and np.isfinite(margin):
        size = describe_margin(name, abs(margin), loop.angular_constraints)
        happens = "within {} of its limit" if margin > 0.0 else "violated by {}"
        because = f"the constraint '{name}' would be {happens.format(size.partition('+')[2])}"
    lines = {"verdict": f"{verdict.verdict}: {because}"}
    if nearest is not None:
        away = f"{words.distance(nearest.goal - verdict.goal)} away"
        value, probability_there = words.value(nearest.goal), nearest.probability
        lines["nearest accepted"] = f"{value}, {away}, probability {probability_there:.3f}"
    elif not verdict.is_accepted and np.isfinite(verdict.goal).all():
        lines["nearest accepted"] = "none found that is accepted with reserve"
    lines[words.goal] = f"{words.value(verdict.goal)}{subject}"
    if name and not verdict.is_accepted and because in (verdict.reason, numbers):
        lines.update([verdict.cause_words(loop.angular_constraints)])
    if np.isfinite(probability):
        if because != numbers:
            lines["probability"] = numbers.partition(" ")[2]
        safe, unsafe, unknown = verdict.belief.tolist()
        lines["belief"] = f"safe {safe:.2f}, unsafe {unsafe:.2f}, don't know {unknown:.2f}"
    if nearest is not None or np.isfinite(probability):
        lines["threshold"] = f"{threshold:.3f}, {origin}"
    width = max(map(len, lines))
    for name, text in lines.items():
        console.say(f"{name:<{width}}  {text}")
