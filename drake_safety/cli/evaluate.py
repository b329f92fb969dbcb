"""``drake-safety evaluate``: evaluates Γ on fresh episodes, on throws, and under shifts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import (
    ClusterOption,
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
    command_line,
    console,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import (
    MODES,
    assessment_file,
    check_fresh,
    check_writable,
    fresh_episodes_folder,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.learning.seeds import EVALUATION, SHIFTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from drake_safety.cli.console import Stages
    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.evaluation.scorers import Scorer
    from drake_safety.evaluation.shift_study import Motion
    from drake_safety.evaluation.throw_study import TriggerRule
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes, Segments
    from drake_safety.simulation.scenario import Scenario
    from drake_safety.simulation.throws import ThrowLog

SHIFTS_FILE = "shifts.json"
_DEFAULT_THROWS = 600
_MOST_JUDGED = 1000  # Nominal motions under `--shifts`; all of them count for false alarms.


@dataclass(kw_only=True)
class Evaluation:
    """An evaluation under way: what is judged, on what, where the results go, and what was found.

    Attributes:
        assessments: Γ by mode.
        seed: First seed of the fresh simulations.
        test_set: Fresh episodes.
        calibration_set: Other fresh episodes, for thresholds.
        estimates: By dotted key.
        pictures: Files of the figures.
    """

    scenario: Scenario
    assessments: Mapping[str, SafetyAssessment]
    run_folder: Path
    folder: Path
    seed: int
    workers: int | None
    stages: Stages
    test_set: Episodes
    calibration_set: Episodes
    estimates: dict[str, Estimate] = field(default_factory=dict)
    pictures: list[Path] = field(default_factory=list)

    @property
    def scorers(self) -> list[Scorer]:
        """The probability of either mode."""
        from drake_safety.evaluation.scorers import assessment_scorer

        return [assessment_scorer(m, one) for m, one in self.assessments.items()]

    @property
    def plan_thresholds(self) -> dict[str, float]:
        """Stored thresholds of plans by mode, of the unsafe score."""
        stored = {mode: one.calibrations_.get("plan") for mode, one in self.assessments.items()}
        return {mode: 1.0 - one.threshold for mode, one in stored.items() if one is not None}

    def add(self, estimates: Mapping[str, Estimate], **figures: Figure) -> None:
        """Adds results, and figures by name, which are written."""
        from drake_safety.evaluation.figure_style import save

        self.estimates |= estimates
        for name, figure in figures.items():
            self.pictures += save(figure, self.folder / name)


def evaluate(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other nominal episodes, for thresholds of the recalls.", min=20)
    ] = 300,
    throws: Annotated[
        int | None,
        typer.Option(
            help="Fresh throws at the actual plant; 600 by default for tasks with recovery.",
            min=0,
        ),
    ] = None,
    shifts: Annotated[
        int,
        typer.Option(
            help="Motions of each changed plant and faulty sensor: evaluates Γ's \"don't know\" "
            "and the monitor instead of all else.",
            min=0,
        ),
    ] = 0,
    seed: Annotated[
        int | None,
        typer.Option(
            help=f"First of the seeds of fresh simulations; by default {EVALUATION.first}, "
            f"{SHIFTS.first} with --shifts."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and pictures; ASSESSMENT's by default.")
    ] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Evaluate Γ, and the paper's form, on fresh episodes, throws and, with --shifts, other plants.

    It gives AUC, recalls and reliability, in every row and in the first of an episode, and falls
    with and without recovery. Episodes are kept in ASSESSMENT: a stopped evaluation continues.
    """
    from drake_safety.simulation.capabilities import HasBall, HasGoals, require
    from drake_safety.simulation.scenario import load_scenario

    loaded = load_scenario(scenario)
    check_writable(assessment, out or assessment)
    if shifts:
        evaluate_shifts(loaded, assessment, shifts, episodes, seed, out or assessment, workers)
        return
    loop = loaded.make_loop()
    if throws is None:
        is_thrown_at = isinstance(loop, HasBall) and not isinstance(loop, HasGoals)
        throws = _DEFAULT_THROWS if is_thrown_at else 0
    if throws:
        require(loop, HasBall, "evaluate: pass --throws 0")
    with begun(
        loaded, assessment, episodes, calibration_episodes, seed, out or assessment, workers
    ) as evaluation:
        add_verdicts(evaluation, evaluation.scorers)
        add_reliability(evaluation)
        if throws:
            add_throws(evaluation, throws)
    write(evaluation, command_line())


@contextmanager
def begun(
    scenario: Scenario,
    run_folder: Path,
    num_episodes: int,
    num_calibration: int,
    seed: int | None,
    folder: Path,
    workers: int | None,
) -> Iterator[Evaluation]:
    """An evaluation with its fresh episodes, the first results being its maps."""
    from drake_safety.evaluation.embedding_figure import embedding_figure

    assessments = {mode: load_assessment(run_folder, mode) for mode in MODES}
    seeds = EVALUATION.seeds(seed)
    for gamma in assessments.values():
        check_fresh(gamma, scenario, seeds.values())
    with open_stages() as stages:
        test_set, calibration_set = (
            run_fresh_episodes(
                scenario, run_folder, number, seeds[purpose], partial(stages, what), workers
            )
            for what, number, purpose in (
                ("fresh nominal episodes", num_episodes, "evaluation"),
                ("calibration episodes", num_calibration, "thresholds"),
            )
        )
        evaluation = Evaluation(
            scenario=scenario,
            assessments=assessments,
            run_folder=run_folder,
            folder=folder,
            seed=seeds["evaluation"],
            workers=workers,
            stages=stages,
            test_set=test_set,
            calibration_set=calibration_set,
        )
        maps = {f"embedding_{m}": embedding_figure(g, test_set) for m, g in assessments.items()}
        evaluation.add({}, **maps)
        yield evaluation


def add_verdicts(
    evaluation: Evaluation, scorers: Sequence[Scorer]
) -> tuple[dict[str, np.ndarray], Segments]:
    """Evaluates scorers on fresh plans with a goal, else on every segment and first rows.

    Returns:
        Unsafe scores by scorer, (N,), and the N judged segments.
    """
    from drake_safety.evaluation.episode_study import evaluate_episodes, evaluate_plans
    from drake_safety.evaluation.roc_figure import roc_figure
    from drake_safety.simulation.capabilities import HasGoals

    sets = evaluation.calibration_set, evaluation.test_set
    if isinstance(evaluation.scenario.make_loop(), HasGoals):
        found, scores, rows = evaluate_plans(scorers, *sets, evaluation.plan_thresholds)
    else:
        found, scores, rows = evaluate_episodes(scorers, *sets)
    evaluation.add(found, roc=roc_figure(scores, rows.is_unsafe))
    return scores, rows


def add_reliability(evaluation: Evaluation) -> None:
    """Evaluates the reliability of either mode, and its stored calibrations."""
    from drake_safety.evaluation.reliability import reliability, reliability_figure, verdict_shares
    from drake_safety.learning.calibration import PLAN, episode_scores
    from drake_safety.learning.segments import split

    segments = split(evaluation.test_set, stride=1, discount=1.0, shortest=1)
    found, curves = {}, {}
    for scorer in evaluation.scorers:
        mode, score = scorer.name, scorer.unsafe_score(segments)
        of_first, label = episode_scores(segments, score, PLAN)
        first = curves[f"{mode}, first row"] = reliability(of_first, label, np.arange(len(label)))
        rows = reliability(score, segments.is_unsafe, segments.episode)
        curves[f"{mode}, every row"] = rows
        found[f"calibration.{mode}.expected_calibration_error"] = first.error
        found[f"calibration.rows.{mode}.expected_calibration_error"] = rows.error
        for kind, one in evaluation.assessments[mode].calibrations_.items():
            shares = verdict_shares(one, *episode_scores(segments, score, kind))
            found |= {f"calibration.{kind}.{mode}.{what}": n for what, n in shares.items()}
    evaluation.add(found, reliability=reliability_figure(curves))


def add_throws(
    evaluation: Evaluation, num_throws: int, rules: Sequence[TriggerRule] = ()
) -> list[ThrowLog]:
    """Evaluates either mode, and other rules, as triggers of recovery; returns the throws."""
    from drake_safety.evaluation.throw_study import evaluate_throws, trigger_rules

    recovery = evaluation.scenario.parameters.recovery
    own = trigger_rules(*evaluation.assessments.values(), threshold=recovery.threshold)
    found, logs = evaluate_throws(
        evaluation.scenario,
        [*own, *rules],
        persistence_s=recovery.persistence_s,
        num_throws=num_throws,
        seed=EVALUATION.seeds(evaluation.seed)["disturbances"],
        num_workers=evaluation.workers,
        progress=evaluation.stages,
    )
    evaluation.add(found)
    return logs


def write(evaluation: Evaluation, command: str) -> None:
    """Writes ``evaluation.json`` and prints its tables."""
    from drake_safety.evaluation.results import Results
    from drake_safety.evaluation.verdict_tables import verdict_tables

    sharpened = evaluation.assessments[MODES[0]]
    trained = next(one for one in sharpened.used_ if one.purpose == "training")
    entries = {
        "command": command,
        "scenario": evaluation.scenario.name,
        "scenario_hash": sharpened.info_.scenario_hash,
        "seed": evaluation.seed,
        "training_seed": trained.seed,
        "training_episodes": trained.num_episodes,
        "calibration_episodes": len(evaluation.calibration_set),
        **_origin(evaluation.run_folder),
    }
    results = Results(evaluation.estimates, entries)
    file = evaluation.folder / "evaluation.json"
    results.write(file)
    for table in verdict_tables(results):
        console.print(table.to_rich())
    print_path("figures", file)
    for picture in evaluation.pictures:
        print_path("picture", picture)


def _origin(run_folder: Path) -> dict[str, Any]:
    from drake_safety.learning.assessment_file import file_hash

    hashes = {mode: file_hash(assessment_file(run_folder, mode)) for mode in MODES}
    return {"assessment_sha256": hashes, "versions": versions()}


def evaluate_shifts(
    scenario: Scenario,
    run_folder: Path,
    num_motions: int,
    num_nominal: int,
    seed: int | None,
    folder: Path,
    workers: int | None,
) -> None:
    """Evaluates Γ on changed plants and faulty sensors, and writes ``shifts.json``.

    Args:
        scenario: The scenario.
        run_folder: Folder written by `train`.
        num_motions: Motions of each shift.
        num_nominal: Nominal motions, for false alarms.
        seed: Seed of the motions; None for the default.
        folder: Folder of the results.
        workers: Number of worker processes; None for one a core.
    """
    from drake_safety.evaluation.shift_study import (
        JudgedShift,
        assessment_judge,
        false_alarms,
        monitor_estimates,
        shift_estimates,
    )

    gamma, paper = (load_assessment(run_folder, mode) for mode in MODES)
    (own_seed,) = SHIFTS.seeds(seed).values()
    for one in (gamma, paper):
        check_fresh(one, scenario, [own_seed])
    judges = {"gamma": assessment_judge(gamma), "paper": assessment_judge(paper)}
    found: dict[str, Estimate] = {}
    with open_stages() as stages:
        nominal, sets = shifted_motions(
            scenario, run_folder, num_motions, num_nominal, own_seed, workers, stages
        )
        for i, (name, (kind, motions)) in enumerate(sets.items()):
            stages("shifts", i, len(sets))
            judged = JudgedShift.judged_by(judges, motions, gamma)
            of = shift_estimates(judged)
            if kind != "nominal":
                of |= monitor_estimates(judged)
            found |= {f"shifts.{name}.{key}": one for key, one in of.items()}
        stages("shifts", len(sets), len(sets))
    found["shifts.nominal.monitor.false_alarms_per_hour"] = false_alarms(nominal, gamma)
    kinds = {name: kind for name, (kind, _) in sets.items()}
    write_shifts(scenario, run_folder, folder, own_seed, command_line(), kinds, found)


def shifted_motions(
    scenario: Scenario,
    run_folder: Path,
    num_motions: int,
    num_nominal: int,
    seed: int,
    workers: int | None,
    stages: Stages,
) -> tuple[list[Motion], dict[str, tuple[str, list[Motion]]]]:
    """Simulates the nominal plant and each changed one.

    Returns:
        All nominal motions, and by shift its kind, "nominal", "plant" or "sensor", and its motions.
    """
    from drake_safety.evaluation.shift_study import motions_of
    from drake_safety.evaluation.shifts import plant_shifts, shifted_scenario
    from drake_safety.simulation.capabilities import judging_options
    from drake_safety.simulation.rollouts import run_episodes

    nominal = motions_of(
        run_fresh_episodes(
            scenario, run_folder, num_nominal, seed, partial(stages, "nominal motions"), workers
        )
    )
    sets = {"nominal": ("nominal", nominal[:_MOST_JUDGED])}
    shifts = plant_shifts(scenario, scenario.make_loop())
    for i, (name, shift) in enumerate(shifts.items()):
        stages("shifted motions", i, len(shifts))
        shifted = shifted_scenario(scenario, name, shift)
        options = {**judging_options(scenario.task_class()), **shift.options}
        path = fresh_episodes_folder(run_folder, shifted.simulation_hash(name), seed, options)
        episodes = run_episodes(
            shifted,
            num_motions,
            variation=name,
            seed=seed,
            num_workers=workers,
            path=path,
            **options,
        )
        sets[name] = (shift.kind, motions_of(episodes))
    stages("shifted motions", len(shifts), len(shifts))
    return nominal, sets


def write_shifts(
    scenario: Scenario,
    run_folder: Path,
    folder: Path,
    seed: int,
    command: str,
    kinds: Mapping[str, str],
    estimates: Mapping[str, Estimate],
) -> None:
    """Writes ``shifts.json``, prints its table and draws it; `kinds` are by shift."""
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.results import Results
    from drake_safety.evaluation.shift_study import shifts_figure, shifts_table

    entries = {"command": command, "scenario": scenario.name, "seed": seed, "kinds": kinds}
    results = Results(estimates, {**entries, **_origin(run_folder)})
    pictures = save(shifts_figure(results), folder / "shifts")
    results.write(folder / SHIFTS_FILE)
    console.print(shifts_table(results).to_rich())
    print_path("figures", folder / SHIFTS_FILE)
    for picture in pictures:
        print_path("picture", picture)
