"""``drake-safety check``: what a scenario lacks, before a rollout is wasted."""

from __future__ import annotations

from typing import Annotated

import typer

from drake_safety.cli.arguments import ScenarioArgument
from drake_safety.cli.console import console
from drake_safety.learning.seeds import DEMONSTRATION


def check(
    scenario: ScenarioArgument,
    episodes: Annotated[
        int, typer.Option(help="Episodes simulated for the share of unsafe ones.", min=0)
    ] = 16,
    seed: Annotated[int, typer.Option(help="Seed of these episodes.")] = DEMONSTRATION.first,
) -> None:
    """Say what a scenario and its robot lack, item by item, and how to mend it.

    The exit code is 1 when there is a problem.
    """
    from drake_safety.simulation.scenario_check import check_scenario

    num_problems = 0
    for finding in check_scenario(scenario, num_episodes=episodes, seed=seed):
        num_problems += not finding.is_ok
        word, style = ("OK     ", "green") if finding.is_ok else ("problem", "red")
        console.print(f"{word}  ", style=style, end="")
        console.print(
            f"{finding.item}: {finding.message}", markup=False, highlight=False, soft_wrap=True
        )
        if not finding.is_ok:
            console.print(
                f"         mend: {finding.remedy}", markup=False, highlight=False, soft_wrap=True
            )
    if num_problems:
        console.print(f"{num_problems} problems", style="red", highlight=False)
        raise typer.Exit(1)
    console.print("ready: drake-safety train", scenario, "--out FOLDER", highlight=False)
