"""``drake-safety adapt``: adapts Γ to an actual robot, and says what that was worth."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from drake_safety.cli.arguments import AssessmentOption, ScenarioArgument, WorkersOption
from drake_safety.cli.console import (
    Stages,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
    print_shipped,
)
from drake_safety.cli.provenance import command_line, versions
from drake_safety.cli.training_folder import (
    MODES,
    adapted_folder,
    assessment_file,
    assessment_folder,
    check_fresh,
    feedback_folder,
    load_assessment,
)
from drake_safety.learning.seeds import ADAPTATION

if TYPE_CHECKING:
    from drake_safety.evaluation.adaptation_study import AdaptationStudy
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.feedback import EpisodePairs
    from drake_safety.simulation.scenario import Scenario

_SCRATCH_SIZES = (40, 160, 400)


def adapt(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    feedback: Annotated[
        int, typer.Option(help="Actual episodes, each beside its nominal twin.", min=1)
    ] = 160,
    variation: Annotated[str, typer.Option(help="Which plant is the actual one.")] = "actual",
    evaluate: Annotated[
        int,
        typer.Option(help="Fresh actual episodes to judge by; 0 leaves judging out.", min=0),
    ] = 0,
    orders: Annotated[int, typer.Option(help="Judging: orders of the feedback.", min=1)] = 5,
    oracle: Annotated[
        int,
        typer.Option(help="Judging: other actual episodes to train a rival on.", min=0),
    ] = 0,
    scratch: Annotated[
        bool,
        typer.Option("--scratch", help="Judging: also train from scratch on the feedback itself."),
    ] = False,
    log: Annotated[
        list[Path] | None,
        typer.Option(
            help="Log of a real robot, in place of a simulated variation; may be repeated.",
            exists=True,
        ),
    ] = None,
    log_map: Annotated[
        Path | None, typer.Option("--map", help="What is where in the logs, a YAML file.")
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the feedback; those of judging follow it.")
    ] = ADAPTATION.first,
    workers: WorkersOption = None,
) -> None:
    """Adapt Γ to what an actual robot does, and judge it before and after.

    Writes ASSESSMENT/adapted-VARIATION, which other commands take in place of ASSESSMENT; with
    --log it is named after the first log. Episodes are kept in ASSESSMENT: an adaptation that was
    stopped goes on when it is called again. For an assessment that came with the package,
    ASSESSMENT is runs/SCENARIO-shipped.
    """
    from drake_safety.evaluation.adaptation_figure import adaptation_figure
    from drake_safety.evaluation.figure_style import save
    from drake_safety.simulation.scenario import load_scenario

    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    priors = {mode: load_assessment(learned.path, mode) for mode in MODES}
    seeds = ADAPTATION.seeds(seed)
    for prior in priors.values():
        check_fresh(prior, loaded, list(seeds.values())[1:] if evaluate else ())
        prior.check_unused(seed, purpose="adaptation")
    logs = log or []
    if bool(logs) != (log_map is not None):
        raise ValueError("adapt: --log and --map go together: a log is read by its map")
    if logs and evaluate:
        raise ValueError("adapt: there is nothing fresh in a log to judge by; leave out --evaluate")
    if len({one.resolve() for one in logs}) < len(logs):
        raise ValueError(f"adapt: each log counts once; got {', '.join(str(one) for one in logs)}")
    name = logs[0].stem if logs else variation
    print_shipped(learned)
    folder = adapted_folder(learned.out, name)
    with open_stages() as stages:
        if log_map is not None:
            pairs = _logged_pairs(loaded, logs, log_map, seed)
        else:
            pairs = _run_pairs(loaded, feedback, variation, seed, learned.out, workers, stages)
        sets = pairs.feedback()
        adapted = {}
        for mode, prior in priors.items():
            adapted[mode] = prior.adapt(sets)
        folder.mkdir(parents=True, exist_ok=True)
        files = []
        for mode, one in adapted.items():
            one.save(assessment_file(folder, mode))
            files.append(assessment_file(folder, mode))
        pictures = []
        interval_sets = priors[MODES[0]].parameters.adaptation.update_interval
        if len(sets) >= interval_sets:
            for mode, prior in priors.items():
                pictures += save(adaptation_figure(prior, sets), folder / f"adaptation_{mode}")
        studies: dict[str, AdaptationStudy] = {}
        if evaluate:
            judge = _Judge(loaded, variation, seeds, learned.out, workers, stages)
            studies = judge.studies(priors, pairs, evaluate, orders, oracle, scratch)
            from drake_safety.evaluation.adaptation_figure import study_figure

            for published in ("calibrated", "grid"):
                pictures += save(
                    study_figure(studies, published=published), folder / f"study_{published}"
                )
    differing, num_pairs = pairs.gap
    report = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": pairs.actual.info.scenario_hash,
        "nominal_hash": pairs.nominal.info.scenario_hash,
        "variation": name,
        "logs": [str(one) for one in logs],
        "seed": seed,
        "feedback_sets": num_pairs,
        "differing_pairs": differing,
        "change": {mode: one.correction_.change.tolist() for mode, one in adapted.items()},
        "versions": versions(),
        **{
            f"{mode}.{key}": figure.to_json()
            for mode, found in studies.items()
            for key, figure in found.figures.items()
        },
    }
    file = folder / "adaptation.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    console.print(_adaptation_table(adapted, differing, num_pairs, name))
    for mode, found in studies.items():
        for published in ("calibrated", "grid") if mode == "sharpened" else ("grid",):
            console.print(_study_table(found, mode, published, variation))
        if "losses.x.brier" in found.figures:
            console.print(_losses_table(found, mode))
    for path in files:
        print_path("assessment", path)
    print_path("figures   ", file)
    for picture in pictures:
        print_path("picture   ", picture)


def _run_pairs(
    scenario: Scenario,
    num_pairs: int,
    variation: str,
    seed: int,
    folder: Path,
    workers: int | None,
    stages: Stages,
) -> EpisodePairs:
    from drake_safety.simulation.feedback import run_pairs

    return run_pairs(
        scenario,
        num_pairs,
        variation=variation,
        seed=seed,
        num_workers=workers,
        path=feedback_folder(folder, scenario.simulation_hash(variation), seed),
        progress=partial(stages, "actual episodes and their twins"),
        extra={"command": command_line()},
    )


def _logged_pairs(scenario: Scenario, logs: list[Path], log_map: Path, seed: int) -> EpisodePairs:
    from drake_safety.logs.episodes import cut_log
    from drake_safety.logs.robot_log import read_log
    from drake_safety.models import load_robot
    from drake_safety.simulation.feedback import pair_starts

    robot = load_robot(scenario.robot)
    actual, starts = cut_log([read_log(log, log_map, robot) for log in logs], scenario)
    return pair_starts(scenario, actual, starts, seed=seed)


class _Judge:
    """Simulates what the study needs, and conducts it."""

    def __init__(
        self,
        scenario: Scenario,
        variation: str,
        seeds: dict[str, int],
        folder: Path,
        workers: int | None,
        stages: Stages,
    ):
        self._scenario, self._variation, self._seeds = scenario, variation, seeds
        self._folder, self._workers, self._stages = folder, workers, stages

    def _run(self, what: str, num_episodes: int, purpose: str) -> Episodes:
        from drake_safety.simulation.capabilities import pairing_options
        from drake_safety.simulation.rollouts import run_episodes

        seed = self._seeds[purpose]
        scenario_hash = self._scenario.simulation_hash(self._variation)
        episodes = run_episodes(
            self._scenario,
            num_episodes,
            variation=self._variation,
            seed=seed,
            num_workers=self._workers,
            path=feedback_folder(self._folder, scenario_hash, seed) / self._variation,
            progress=partial(self._stages, what),
            extra={"command": command_line()},
            **pairing_options(self._scenario, self._variation),
        )
        return episodes

    def studies(
        self,
        priors: dict[str, SafetyAssessment],
        pairs: EpisodePairs,
        num_test: int,
        num_orders: int,
        num_oracle: int,
        has_scratch: bool,
    ) -> dict[str, AdaptationStudy]:
        """One study a mode."""
        from drake_safety.evaluation.adaptation_losses import losses
        from drake_safety.evaluation.adaptation_study import TestSet, study, trained_rivals

        fresh = self._run("fresh actual episodes", num_test, "evaluation of the adaptation")
        learned_from = {}
        if num_oracle:
            learned_from["oracle"] = self._run("episodes of the oracle", num_oracle, "oracle")
        if has_scratch:
            learned_from |= {
                f"scratch.{n}": pairs.actual[:n] for n in _SCRATCH_SIZES if n <= len(pairs.actual)
            }
        found = {}
        for mode, prior in priors.items():
            rivals: dict[str, Any] = {}
            if learned_from:
                rivals = trained_rivals(
                    prior, learned_from, num_workers=self._workers, progress=self._stages
                )
            test = TestSet.of(fresh, prior.parameters.shortest)
            found[mode] = study(
                prior,
                pairs.feedback(),
                test,
                num_orders=num_orders,
                seed=self._seeds["adaptation"],
                rivals=rivals,
                progress=self._stages,
            )
            if mode == "paper" and "oracle" in learned_from:
                found[mode].figures |= losses(prior, pairs.feedback(), learned_from["oracle"], test)
        return found


def _adaptation_table(
    adapted: dict[str, SafetyAssessment], differing: int, num_pairs: int, variation: str
) -> Table:
    table = new_table(
        "mode",
        "method",
        "added to the offset",
        "safety slope",
        "margin slope",
        title=f"Adapted to '{variation}': {differing} of {num_pairs} pairs end differently",
    )
    for mode, one in adapted.items():
        found = one.adaptation_
        if found is not None:
            is_changed = found.method == "recalibration"
            change = [f"{value:+.2f}" if is_changed else "-" for value in one.correction_.change]
            table.add_row(mode, found.method, *change)
    return table


def _losses_table(found: AdaptationStudy, mode: str) -> Table:
    from drake_safety.evaluation.adaptation_losses import STEPS

    brier = {name: found.figures[f"losses.{name}.brier"].value for name in STEPS}
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
    columns = ("brier", "auc", "unsafe_recall", "safe_recall")
    figures = found.figures
    table = new_table(
        "",
        *columns,
        "better in",
        "gap closed",
        title=f"{mode}, {published}: fresh episodes of '{variation}', {found.num_orders} orders of "
        "feedback (mean, least and largest)",
    )
    names = {"prior": "before feedback"}
    names |= {f"adapted.{n}": f"after {n} sets" for n in found.sizes}
    names |= {f"scratch.{n}": f"from scratch on {n}" for n in _SCRATCH_SIZES}
    names["oracle"] = "oracle"
    for who, label in names.items():
        key = f"{who}.{published}"
        if f"{key}.brier" not in figures:
            continue
        won, closed = figures.get(f"{key}.orders_won"), figures.get(f"{key}.gap_closed")
        table.add_row(
            label,
            *(interval(figures[f"{key}.{column}"]) for column in columns),
            f"{round(won.value * won.n)} of {won.n}" if won is not None else "",
            f"{100 * closed.value:.0f} %"
            if closed is not None and math.isfinite(closed.value)
            else "",
        )
    return table
