"""``python -m studies adaptation``: adaptation by feedback, beside training from scratch."""

from __future__ import annotations

import json
import math
from typing import Annotated

import typer
from rich.table import Table

from drake_safety.cli.adapt import fresh_actual_episodes, paired_episodes
from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    WorkersOption,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
    print_shipped,
    versions,
)
from drake_safety.cli.training_folder import (
    MODES,
    adapted_folder,
    assessment_folder,
    check_fresh,
    load_assessment,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import ADAPTATION
from drake_safety.simulation.scenario import load_scenario
from studies import command_line
from studies.adaptation_figure import adaptation_figure, study_figure
from studies.adaptation_losses import STEPS, losses
from studies.adaptation_study import AdaptationStudy, Pool, TestSet, study, train_baselines

_SCRATCH_SIZES = (40, 160, 400)
_POOL_STRIDE = 10  # Between the first seeds of two pools.


def adaptation(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    feedback: Annotated[
        int, typer.Option(help="Actual episodes, each beside its nominal twin.", min=1)
    ] = 160,
    variation: Annotated[str, typer.Option(help="Variation of the actual plant.")] = "actual",
    evaluate: Annotated[
        int, typer.Option(help="Fresh actual episodes for evaluation.", min=1)
    ] = 600,
    pools: Annotated[
        int, typer.Option(help="Independent pools of feedback and test episodes.", min=1)
    ] = 3,
    oracle: Annotated[
        int, typer.Option(help="Other actual episodes to train an oracle on.", min=0)
    ] = 0,
    scratch: Annotated[
        bool, typer.Option("--scratch", help="Also train from scratch on the feedback itself.")
    ] = False,
    seed: Annotated[
        int, typer.Option(help="First of the seeds of fresh simulations.")
    ] = ADAPTATION.first,
    workers: WorkersOption = None,
) -> None:
    """Evaluate Γ before and after feedback of a simulated plant, on independent pools.

    Episodes are shared with `drake-safety adapt`; results and figures are written to
    ASSESSMENT/adapted-VARIATION.
    """
    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    priors = {mode: load_assessment(learned.path, mode) for mode in MODES}
    seeds = [ADAPTATION.seeds(seed + _POOL_STRIDE * i) for i in range(pools)]
    for prior in priors.values():
        check_fresh(prior, loaded, [one for block in seeds for one in block.values()])
    print_shipped(learned)
    folder = adapted_folder(learned.out, variation)
    pictures = []
    with open_stages() as stages:
        common = (learned.out, workers, stages)
        drawn = [
            paired_episodes(loaded, feedback, variation, block["adaptation"], *common)
            for block in seeds
        ]
        sets = [pairs.feedback() for pairs in drawn]
        fresh = [
            fresh_actual_episodes(
                loaded, evaluate, variation, block["evaluation of the adaptation"], *common
            )
            for block in seeds
        ]
        learned_from = {}
        if oracle:
            learned_from["oracle"] = fresh_actual_episodes(
                loaded,
                oracle,
                variation,
                seeds[0]["oracle"],
                *common,
                what="episodes of the oracle",
            )
        if scratch:
            learned_from |= {
                f"scratch.{n}": drawn[0].actual[:n] for n in _SCRATCH_SIZES if n <= feedback
            }
        studies: dict[str, AdaptationStudy] = {}
        for mode, prior in priors.items():
            baselines: dict[str, SafetyAssessment] = {}
            if learned_from:
                baselines = train_baselines(
                    prior, learned_from, num_workers=workers, progress=stages
                )
            judged = [
                Pool(feedback=one, test=TestSet.of(episodes, prior.parameters.shortest))
                for one, episodes in zip(sets, fresh, strict=True)
            ]
            studies[mode] = study(prior, judged, baselines=baselines, progress=stages)
            if mode == "paper" and oracle:
                studies[mode].estimates |= losses(
                    prior, sets[0], learned_from["oracle"], judged[0].test
                )
            if len(sets[0]) >= prior.parameters.adaptation.update_interval:
                picture = adaptation_figure(prior, sets[0])
                pictures += save(picture, folder / f"adaptation_{mode}")
    for published in ("calibrated", "grid"):
        picture = study_figure(studies, published=published)
        pictures += save(picture, folder / f"study_{published}")
    report = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": drawn[0].actual.info.scenario_hash,
        "nominal_hash": drawn[0].nominal.info.scenario_hash,
        "variation": variation,
        "seed": seed,
        "pools": pools,
        "feedback_sets": [len(one) for one in sets],
        "differing_pairs": [sum(pair.differs for pair in one) for one in sets],
        "versions": versions(),
        **{
            f"{mode}.{key}": estimate.to_json()
            for mode, found in studies.items()
            for key, estimate in found.estimates.items()
        },
    }
    file = folder / "study.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    for mode, found in studies.items():
        for published in ("calibrated", "grid") if mode == "sharpened" else ("grid",):
            console.print(_study_table(found, mode, published, variation))
        if "losses.x.brier" in found.estimates:
            console.print(_losses_table(found, mode))
    print_path("figures", file)
    for path in pictures:
        print_path("picture", path)


def _losses_table(found: AdaptationStudy, mode: str) -> Table:
    brier = {name: found.estimates[f"losses.{name}.brier"].value for name in STEPS}
    table = new_table("", "Brier", "lost", title=f"{mode}: where the Brier score is lost")
    table.add_row("gradient boosting on x, from the oracle's episodes", f"{brier['x']:.3f}", "")
    for name, before, label in (
        ("psi", "x", "Ψ: their nearest in the embedding"),
        ("grid", "psi", "the grid: their share in the cell"),
        ("update", "grid", "the update, from all feedback"),
        ("update_without_gpr", "grid", "the update without the discrepancy function"),
    ):
        table.add_row(label, f"{brier[name]:.3f}", f"{brier[name] - brier[before]:+.3f}")
    return table


def _study_table(found: AdaptationStudy, mode: str, published: str, variation: str) -> Table:
    columns = ("brier", "auc", "unsafe_recall", "safe_recall", "unknown")
    estimates = found.estimates
    table = new_table(
        "",
        *columns,
        "better in",
        "gap closed",
        title=f"{mode}, {published}: fresh episodes of '{variation}', {found.num_pools} pools of "
        "feedback (mean, least and largest)",
    )
    names = {"prior": "before feedback"}
    names |= {f"adapted.{n}": f"after {n} sets" for n in found.sizes}
    names |= {f"scratch.{n}": f"from scratch on {n}" for n in _SCRATCH_SIZES}
    names["oracle"] = "oracle"
    for who, label in names.items():
        key = f"{who}.{published}"
        if f"{key}.brier" not in estimates:
            continue
        won, closed = estimates.get(f"{key}.pools_won"), estimates.get(f"{key}.gap_closed")
        table.add_row(
            label,
            *(interval(estimates[f"{key}.{column}"]) for column in columns),
            f"{round(won.value * won.n)} of {won.n}" if won is not None else "",
            f"{100 * closed.value:.0f} %"
            if closed is not None and math.isfinite(closed.value)
            else "",
        )
    return table
