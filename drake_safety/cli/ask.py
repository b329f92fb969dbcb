"""``drake-safety ask``: the verdict on a target, without motion."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from drake_safety.cli.console import AssessmentOption, ScenarioArgument, console, print_shipped
from drake_safety.cli.targets import (
    COMMAND,
    TARGET,
    HandOption,
    TargetOption,
    nearest_accepted,
    parse_target,
    print_verdict,
)
from drake_safety.cli.training_folder import assessment_folder, goal_threshold, load_assessment
from drake_safety.planning.goal_verdict import assess_goal
from drake_safety.simulation.scenario import load_scenario


def ask(
    scenario: ScenarioArgument,
    target: TargetOption = None,
    assessment: AssessmentOption = None,
    hand: HandOption = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="Of a command [s], after which the robot stops; an episode by default.", min=0.1
        ),
    ] = None,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the verdict on a target, or on a command of a walking robot; nothing moves.

    Prints belief and verdict; for a refusal also the likely cause and the nearest accepted target.
    Exit code: 0 accepted, 1 refused ("don't know" is a refusal), 2 error.
    """
    if target is None:
        raise ValueError(f"ask: pass {TARGET}, or for a walking robot {COMMAND}")
    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, assessment)
    gamma = load_assessment(folder.path, mode)
    given = {"hand": hand, "command_s": duration}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    loop = loaded.make_loop(assessment=gamma, **options)
    goal = parse_target(loop, target)
    threshold, unsafe_below, origin = goal_threshold(folder.path, gamma)
    verdict = assess_goal(loop, gamma, goal, threshold=threshold, unsafe_below=unsafe_below)
    nearest = None if verdict.is_accepted else nearest_accepted(loop, gamma, verdict)
    if as_json:
        answer = verdict.to_json() | {
            "assessment": str(folder.path),
            "hand": loop.hand,
            "nearest_accepted": None if nearest is None else nearest.goal.tolist(),
            "threshold_origin": origin,
        }
        console.print(json.dumps(answer), soft_wrap=True, highlight=False)
    else:
        print_shipped(folder, gamma)
        print_verdict(loop, verdict, nearest, origin)
    if not verdict.is_accepted:
        raise typer.Exit(1)
