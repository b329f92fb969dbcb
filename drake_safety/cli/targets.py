"""Targets on the command line: parsing them, and printing verdicts."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from drake_safety.cli.console import COMMAND, TARGET, console
from drake_safety.files.reading import did_you_mean, is_number
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.causes import describe_margin
from drake_safety.planning.goal_verdict import GoalVerdict
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.simulation.capabilities import GoalWords, HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop

TargetOption = Annotated[
    str | None,
    typer.Option(
        TARGET,
        COMMAND,
        metavar="X Y Z | NAME",
        help="Target, three numbers in the world frame [m], or command, v_x v_y [m/s] and yaw rate "
        "[rad/s]; or a name in the scenario.",
    ),
]
HandOption = Annotated[
    str | None, typer.Option("--hand", help="Reaching hand; the trained one by default.")
]

_SEARCH_SEED = 0  # Fixed, so that results are reproducible.


def parse_target(loop: ClosedLoop, text: str) -> np.ndarray:
    """The goal of ``--target`` or ``--command``, (3,).

    Args:
        loop: The closed loop, which names targets.
        text: A name, or three numbers separated by spaces.

    Raises:
        ValueError: The plans of the task have no goal, or the text is neither.
    """
    with_goals = require(loop, HasGoals, TARGET)
    named_targets, words = with_goals.named_targets, goal_words(with_goals)
    if text in named_targets:
        return np.array(named_targets[text], dtype=float)
    entries = text.split()
    if len(entries) == 3 and all(map(is_number, entries)):
        return np.array([float(entry) for entry in entries])
    raise ValueError(
        f"{words.goal} '{text}'{did_you_mean(text, named_targets)}: give {' '.join(words.axes)}, "
        "three numbers "
        f"[{', '.join(words.units)}], or one of the names that scenario '{loop.scenario.name}' "
        f"gives: {list(named_targets)}"
    )


def nearest_accepted(
    loop: ClosedLoop, assessment: SafetyAssessment, verdict: GoalVerdict
) -> GoalVerdict | None:
    """The nearest target accepted with reserve to a refused one, if any."""
    return nearest_accepted_goal(
        loop,
        assessment,
        verdict.goal,
        threshold=verdict.threshold,
        rng=np.random.default_rng(_SEARCH_SEED),
    )


def print_verdict(
    loop: ClosedLoop, verdict: GoalVerdict, nearest: GoalVerdict | None, origin: str
) -> None:
    """Prints a verdict; for a refusal also the likely cause and the nearest accepted target.

    Args:
        loop: The closed loop.
        verdict: The verdict.
        nearest: The nearest accepted target, for a refusal.
        origin: Where the threshold comes from.
    """
    words = goal_words(require(loop, HasGoals))
    of = f" of {words.subject}" if words.is_point else ""
    lines = {words.goal: f"{words.value(verdict.goal)}{of}"}
    if verdict.reason:
        lines["verdict"] = f"{verdict.verdict}: {verdict.reason}"
    else:
        sign = "<" if verdict.probability < verdict.threshold else "≥"
        lines["verdict"] = (
            f"{verdict.verdict}: probability {verdict.probability:.3f} {sign} "
            f"threshold {verdict.threshold:.3f}"
        )
    if np.isfinite(verdict.probability):
        safe, unsafe, unknown = verdict.belief.tolist()
        lines["belief"] = f"safe {safe:.2f}, unsafe {unsafe:.2f}, don't know {unknown:.2f}"
    if not verdict.is_accepted:
        lines |= _refusal(loop, words, verdict, nearest)
    if nearest is not None or np.isfinite(verdict.probability):
        lines["threshold"] = f"{verdict.threshold:.3f}, {origin}"
    for name, text in lines.items():
        console.print(f"{name:<16}  {text}", highlight=False, soft_wrap=True)


def _refusal(
    loop: ClosedLoop, words: GoalWords, verdict: GoalVerdict, nearest: GoalVerdict | None
) -> dict[str, str]:

    lines = {}
    if np.isfinite(verdict.cause_margin):
        lines["likely cause"] = describe_margin(
            verdict.cause, verdict.cause_margin, loop.angular_constraints
        )
    elif verdict.cause:
        share = verdict.cause_probability.max() / verdict.cause_probability.sum()
        lines["likely cause"] = f"{verdict.cause} ({100 * share:.0f} %)"
    if not np.isfinite(verdict.goal).all():
        return lines
    if nearest is None:
        lines["nearest accepted"] = "none found that is accepted with reserve"
    else:
        lines["nearest accepted"] = (
            f"{words.value(nearest.goal)}, {words.distance(nearest.goal - verdict.goal)} away, "
            f"probability {nearest.probability:.3f}"
        )
    return lines
