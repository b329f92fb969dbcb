"""``python -m studies truth``: Γ against the truth simulated on a grid."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any

import typer

from drake_safety.cli.console import (
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import (
    MODES,
    check_fresh,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.metrics import Estimate
from drake_safety.learning.seeds import EVALUATION
from drake_safety.simulation.scenario import load_scenario
from studies import command_line
from studies.known_truth import agreement, random_plan_estimates, simulate_truth
from studies.known_truth_figure import known_truth_figure


def truth(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: Annotated[
        int, typer.Option(help="Fresh nominal episodes, for random plans.", min=1)
    ] = 1000,
    resolution: Annotated[
        int, typer.Option(help="Starts simulated along either axis of a state plane.", min=2)
    ] = 41,
    seed: Annotated[
        int, typer.Option(help="Seed of the fresh ones: those of `evaluate` by default.")
    ] = EVALUATION.first,
    workers: WorkersOption = None,
) -> None:
    """Compare Γ of both modes with the truth on state planes and on random plans, at k = 0.

    Writes ASSESSMENT/known_truth.json and a figure for each mode.
    """
    loaded = load_scenario(scenario)
    loop = loaded.make_loop()
    planes = loop.state_planes
    if not planes:
        raise ValueError(f"truth: task '{type(loop).__name__}' has no state planes")
    assessments = {mode: load_assessment(assessment, mode) for mode in MODES}
    for gamma in assessments.values():
        check_fresh(gamma, loaded, (seed,))
    with open_stages() as stages:
        progress = partial(stages, "fresh nominal episodes")
        fresh = run_fresh_episodes(loaded, assessment, episodes, seed, progress, workers)
        truths = [
            simulate_truth(
                loaded,
                plane,
                resolution,
                num_workers=workers,
                progress=partial(stages, f"truth, {plane}"),
            )
            for plane in planes
        ]
    table = new_table(
        "mode",
        "plan",
        "safe [%]",
        "IoU",
        "confident errors [%]",
        "their band [% of a side]",
        title=f"Γ against the truth on {resolution} x {resolution} simulated starts",
    )
    pictures = []
    entries: dict[str, Any] = {}
    estimates: dict[str, Estimate] = {}
    for mode, gamma in assessments.items():
        panels = []
        for one in truths:
            probability = one.safety_probability(gamma)
            found = agreement(one.is_safe, probability)
            panels.append((one, probability, found))
            entries[f"{mode}.{one.plane}"] = asdict(found) | {
                "resolution": resolution,
                "safe_share": float(one.is_safe.mean()),
            }
            table.add_row(
                mode,
                one.plane,
                f"{100 * one.is_safe.mean():.1f}",
                f"{found.intersection_over_union:.3f}",
                f"{100 * found.confident_errors:.2f}",
                f"{100 * found.band:.1f}",
            )
        random = random_plan_estimates(gamma, fresh)
        table.add_row(
            mode,
            f"{len(fresh)} random ones",
            interval(random["safe_share"], 100, 1),
            interval(random["intersection_over_union"]),
            interval(random["confident_errors"], 100, 2),
            "–",
        )
        estimates |= {f"known_truth.{mode}.random.{key}": value for key, value in random.items()}
        figure = known_truth_figure(panels, f"{loaded.name}, {mode}")
        pictures += save(figure, assessment / f"known_truth_{mode}")
    report = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": loaded.simulation_hash(),
        "seed": seed,
        "versions": versions(),
        "known_truth": entries,
        **{key: estimate.to_json() for key, estimate in estimates.items()},
    }
    file = assessment / "known_truth.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    console.print(table)
    print_path("figures", file)
    for path in pictures:
        print_path("picture", path)
