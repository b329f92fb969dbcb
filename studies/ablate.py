"""``python -m studies ablate``: ablation of the choices in learning Γ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

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
    episodes_folder,
    fresh_episodes_folder,
    load_assessment,
)
from drake_safety.files.progress import StageProgress
from drake_safety.learning.seeds import ADAPTATION, EVALUATION
from studies import command_line

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.learning.assessment import AssessmentParameters
    from drake_safety.simulation.scenario import Scenario
    from studies.ablation import AblationSets, EpisodeSet
    from studies.ablation_study import AblationRow

_COLUMNS = {
    "auc": "AUC",
    "auc_gain": "over the baseline",
    "safe_recall": "safe recall",
    "unsafe_recall": "unsafe recall",
    "brier": "Brier",
    "calibrated_auc": "AUC, probability",
    "k0.auc": "AUC, k = 0",
    "k0.auc_gain": "over the baseline, k = 0",
}
_QUICK_EPISODES, _QUICK_TEST, _QUICK_CALIBRATION, _QUICK_EPOCHS = 256, 200, 100, 6


def ablate(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="One variant per choice, one map with short training, fewer episodes."
        ),
    ] = False,
    episodes: Annotated[
        int | None, typer.Option(help="Fresh nominal episodes; 1000, or 200.", min=2)
    ] = None,
    calibration_episodes: Annotated[
        int | None,
        typer.Option(help="Other ones, for thresholds of the recalls; 300, or 100.", min=2),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the fresh ones: those of `evaluate` by default.")
    ] = EVALUATION.first,
    workers: WorkersOption = None,
) -> None:
    """Train Γ with one choice changed at a time, and evaluate it on the same episodes.

    Every variant learns from the training episodes in ASSESSMENT. Rows are written as they finish:
    a stopped ablation continues when called again. Feedback of `adaptation` in ASSESSMENT is used
    to compare the definitions of n_f.
    """
    from drake_safety.evaluation.figure_style import save
    from drake_safety.simulation.dataset import load_episodes
    from drake_safety.simulation.scenario import load_scenario
    from studies.ablation import list_variants
    from studies.ablation_figure import ablation_figure
    from studies.ablation_study import (
        AblationFile,
        ablation_verdict,
        rows_to_csv,
        run_ablation,
    )

    loaded = load_scenario(scenario)
    gamma = load_assessment(assessment, MODES[0])
    base = gamma.parameters
    training = load_episodes(episodes_folder(assessment))
    seeds = EVALUATION.seeds(seed)
    check_fresh(gamma, loaded, (seeds["evaluation"], seeds["thresholds"]))
    num_training = len(training)
    if quick:
        num_training = min(num_training, _QUICK_EPISODES)
        base = replace(base, ensemble_size=1, epochs=min(base.epochs, _QUICK_EPOCHS))
    loop = loaded.make_loop()
    variants, left_out = list_variants(
        base,
        num_training,
        state_names=training.info.state_names,
        rate_names=loop.rate_names,
        quick=quick,
    )
    name = "ablation_quick" if quick else "ablation"
    entries = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": training.info.scenario_hash,
        "seed": seed,
        "training_seed": training.info.seed,
        "training_episodes": num_training,
        "versions": versions(),
    }
    file = AblationFile.open(assessment / f"{name}.json", entries)
    with open_stages() as stages:
        sets = _sets(
            loaded,
            assessment,
            num_training,
            episodes or (_QUICK_TEST if quick else 1000),
            calibration_episodes or (_QUICK_CALIBRATION if quick else 300),
            seeds,
            workers,
            stages,
        )
        rows, failed = run_ablation(
            variants,
            base,
            sets,
            file,
            version=versions()["drake_safety"],
            num_workers=workers,
            progress=partial(stages, "variants"),
        )
        counting = _counting(loaded, assessment)
    if counting:
        file.entries["n_f"] = {
            f"{variation}.{mode}.{who}": {
                key: estimate.to_json() for key, estimate in estimates.items()
            }
            for (variation, mode), found in counting.items()
            for who, estimates in found.items()
        }
    else:
        left_out["n_f"] = "there are no pairs with fresh episodes: `python -m studies adaptation`"
    left_out |= failed
    file.entries["left_out"] = left_out
    file.write()
    table = file.path.with_suffix(".csv")
    table.write_text(rows_to_csv(rows), encoding="utf-8")
    pictures = save(ablation_figure(rows), file.path)
    console.print(_table(rows, base))
    console.print(ablation_verdict(rows), highlight=False, soft_wrap=True)
    for (variation, mode), found in counting.items():
        console.print(_counting_table(found, variation, mode))
    for what, why in left_out.items():
        console.print(f"left out, {what}: {why}", highlight=False, soft_wrap=True)
    for path in (file.path, table, *pictures):
        print_path("ablation", path)


def _sets(
    scenario: Scenario,
    folder: Path,
    num_training: int,
    num_test: int,
    num_calibration: int,
    seeds: dict[str, int],
    workers: int | None,
    stages: StageProgress,
) -> AblationSets:
    """The training episodes and fresh ones, which are simulated and kept as needed."""
    from drake_safety.simulation.rollouts import run_episodes
    from studies.ablation import AblationSets, EpisodeSet

    judging = scenario.task_class().judging_options

    def fresh(what: str, count: int, own_seed: int) -> EpisodeSet:
        path = fresh_episodes_folder(folder, scenario.simulation_hash(), own_seed, judging)
        run_episodes(
            scenario,
            count,
            seed=own_seed,
            num_workers=workers,
            path=path,
            progress=partial(stages, what),
            **judging,
        )
        return EpisodeSet(path=path, count=count)

    return AblationSets(
        training=EpisodeSet(path=episodes_folder(folder), count=num_training),
        test=fresh("fresh nominal episodes", num_test, seeds["evaluation"]),
        calibration=fresh("calibration episodes", num_calibration, seeds["thresholds"]),
    )


def _counting(
    scenario: Scenario, folder: Path
) -> dict[tuple[str, str], dict[str, dict[str, Estimate]]]:
    """Definitions of n_f, for each plant with pairs and fresh episodes of `adapt`."""
    from drake_safety.learning.feedback import feedback_sets
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.dataset import load_episodes
    from studies.ablation_adaptation import counting_estimates
    from studies.adaptation_study import TestSet

    found = {}
    for variation in scenario.variations:
        hash_ = scenario.simulation_hash(variation)[:12]
        for pairs in sorted((folder / "feedback").glob(f"{hash_}-*")):
            own_seed = int(pairs.name.rpartition("-")[2])
            # `adapt` keeps its fresh episodes beside the pairs.
            judging = ADAPTATION.seeds(own_seed)["evaluation of the adaptation"]
            fresh = pairs.with_name(f"{hash_}-{judging}") / variation
            if not ((pairs / "nominal").is_dir() and fresh.is_dir()):
                continue
            nominal, actual = (load_episodes(pairs / name) for name in ("nominal", variation))
            # If `adapt` was stopped, some twins are missing.
            twins = {episode.index for episode in nominal}
            paired = Episodes(actual.info, [one for one in actual if one.index in twins])
            feedback = feedback_sets(paired, nominal)
            for mode in MODES:
                prior = load_assessment(folder, mode)
                test = TestSet.of(load_episodes(fresh), prior.parameters.shortest)
                found[variation, mode] = counting_estimates(prior, feedback, test)
    return found


def _table(rows: Sequence[AblationRow], base: AssessmentParameters) -> Table:
    n = rows[0].estimates["k0.auc"].n
    table = new_table(
        "variant", *_COLUMNS.values(), title=f"Evaluated on the same {n} fresh episodes"
    )
    # Names are not folded, however narrow the other columns become.
    table.columns[0].no_wrap = True
    for i, row in enumerate(rows):
        is_last = i + 1 == len(rows) or rows[i + 1].group != row.group
        estimates = (interval(row.estimates[key]) for key in _COLUMNS)
        table.add_row(row.name, *estimates, end_section=is_last)
    table.caption = (
        f"baseline: δ {base.score_weight:g}, H {base.horizon}, perplexity {base.perplexity:g}, "
        f"{base.resolution} × {base.resolution} cells, k_min {base.min_count}, mode '{base.mode}'"
    )
    return table


def _counting_table(found: dict[str, dict[str, Estimate]], variation: str, mode: str) -> Table:
    columns = [key for key in _COLUMNS if not key.startswith(("k0.", "calibrated"))]
    table = new_table(
        "n_f",
        *(_COLUMNS[key] for key in columns),
        title=f"{mode}, the paper's adaptation to '{variation}'",
    )
    for who, estimates in found.items():
        table.add_row(who, *(interval(estimates[key]) for key in columns))
    return table
