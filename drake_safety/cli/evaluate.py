"""``drake-safety evaluate``: evaluates Γ on fresh episodes and throws, beside baselines."""

from __future__ import annotations

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
from drake_safety.cli.evaluate_monitoring import evaluate_monitoring, evaluate_pushes
from drake_safety.cli.evaluate_plans import (
    PlanOptions,
    check_options,
    evaluate_plans,
)
from drake_safety.cli.evaluate_shifts import evaluate_shifts_command
from drake_safety.cli.findings import Findings, Judged
from drake_safety.cli.training_folder import (
    MODES,
    assessment_file,
    check_fresh,
    check_writable,
    episodes_folder,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.learning.seeds import EVALUATION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.evaluation.throw_study import ThrowStudy
    from drake_safety.learning.segments import Episodes

_DEFAULT_THROWS = 600


def evaluate(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    throws: Annotated[
        int | None,
        typer.Option(
            help="Fresh throws at the actual plant; 600 by default for tasks with recovery.",
            min=0,
        ),
    ] = None,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other nominal episodes, for thresholds of the recalls.", min=20)
    ] = 300,
    calibration_throws: Annotated[
        int, typer.Option(help="Other throws, for thresholds of the baseline classifiers.", min=1)
    ] = 200,
    other_hand: Annotated[
        int | None,
        typer.Option(
            help="Targets: number mirrored to the other hand; at most 400 by default.", min=0
        ),
    ] = None,
    plane_x: Annotated[
        float | None,
        typer.Option(help="Targets: x of the reachable region's plane [m]; the task's by default."),
    ] = None,
    plane_step: Annotated[
        float,
        typer.Option(
            help="Targets: spacing of those simulated on it [m]; 0 to leave it out.", min=0
        ),
    ] = 0.1,
    pushes: Annotated[
        int,
        typer.Option(
            help="Targets: pushed motions of the actual robot, to evaluate alarms; as many more "
            "for thresholds.",
            min=0,
        ),
    ] = 0,
    shifts: Annotated[
        int,
        typer.Option(
            help="Motions of each shift of plant, sensors and plans: evaluates Γ's \"don't know\" "
            "and the monitor instead of all else.",
            min=0,
        ),
    ] = 0,
    baselines: Annotated[
        bool,
        typer.Option(
            "--baselines/--no-baselines",
            help="Baseline classifiers, trained on the same episodes; they take half of the time.",
        ),
    ] = True,
    seed: Annotated[
        int, typer.Option(help="First of the seeds of fresh simulations.")
    ] = EVALUATION.first,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and pictures; ASSESSMENT's by default.")
    ] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Evaluate Γ on fresh episodes and throws.

    For plans with a goal, verdicts on fresh targets at k = 0 are evaluated, beside inverse
    kinematics. Episodes are kept in ASSESSMENT: a stopped evaluation continues. With throws, or
    --pushes, Γ is evaluated as an alarm too, beside margins and tracking errors. With --shifts,
    only motions under conditions that training does not have are evaluated.
    """
    from drake_safety.evaluation.embedding_figure import embedding_figure
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.results import Results
    from drake_safety.evaluation.scorers import classifier_scorers
    from drake_safety.evaluation.verdict_tables import verdict_tables
    from drake_safety.learning.assessment_file import file_hash
    from drake_safety.simulation.capabilities import (
        CanBePushed,
        HasBall,
        HasGoals,
        require,
    )
    from drake_safety.simulation.dataset import load_episodes
    from drake_safety.simulation.scenario import load_scenario

    loaded = load_scenario(scenario)
    check_writable(assessment, out or assessment)
    if shifts:
        evaluate_shifts_command(
            loaded,
            assessment,
            shifts,
            episodes,
            baselines=baselines,
            seed=None if seed == EVALUATION.first else seed,
            folder=out or assessment,
            workers=workers,
        )
        return
    loop = loaded.make_loop()
    has_goals, has_recovery = isinstance(loop, HasGoals), isinstance(loop, HasBall)
    if throws is None:
        throws = _DEFAULT_THROWS if has_recovery and not has_goals else 0
    if throws:
        require(loop, HasBall, "evaluate: pass --throws 0")
    if pushes:
        require(loop, HasGoals, "evaluate: leave out --pushes; alarms are evaluated on throws")
        require(loop, CanBePushed, "evaluate: leave out --pushes")
        loaded.variation("actual")
    options = PlanOptions(
        other_hand=other_hand,
        plane_x=plane_x,
        plane_step=plane_step,
    )
    folder = out or assessment
    sharpened, paper = (load_assessment(assessment, mode) for mode in MODES)
    # Without baselines, the training episodes need not be there.
    train_set = load_episodes(episodes_folder(assessment)) if baselines else None
    trained = next(one for one in sharpened.used_ if one.purpose == "training")
    seeds = EVALUATION.seeds(seed)
    for gamma in (sharpened, paper):
        check_fresh(gamma, loaded, seeds.values())
    check_options(loop, options)
    with open_stages() as stages:

        def run_set(what: str, num_episodes: int, purpose: str, **loop_options: Any) -> Episodes:
            progress = partial(stages, what)
            return run_fresh_episodes(
                loaded,
                assessment,
                num_episodes,
                seeds[purpose],
                progress,
                workers,
                **loop_options,
            )

        test_set = run_set("fresh nominal episodes", episodes, "evaluation")
        calibration_set = run_set("calibration episodes", calibration_episodes, "thresholds")
        shortest = sharpened.parameters.shortest_segment or None
        judged = Judged(
            scenario=loaded,
            sharpened=sharpened,
            paper=paper,
            classifiers=classifier_scorers(train_set, stages, shortest=shortest)
            if train_set is not None
            else [],
            run_folder=assessment,
            calibration_set=calibration_set,
            test_set=test_set,
            folder=folder,
            workers=workers,
            stages=stages,
        )
        findings = Findings(
            pictures=[
                *save(embedding_figure(sharpened, test_set), folder / "embedding_sharpened"),
                *save(embedding_figure(paper, test_set), folder / "embedding_paper"),
            ]
        )
        if has_goals:
            findings.add(evaluate_plans(judged, options, partial(run_set, purpose="evaluation")))
        else:
            findings.add(_evaluate_segments(judged))
        findings.add(_evaluate_calibration(judged))
        if throws:
            findings.add(_evaluate_throws(judged, throws, calibration_throws, seeds))
        if pushes:
            findings.add(
                evaluate_pushes(
                    judged,
                    pushes,
                    pushes,
                    threshold=findings.estimates["plans.sharpened.threshold"].value,
                    seed=seeds["disturbances"],
                    calibration_seed=seeds["disturbance thresholds"],
                )
            )
    entries = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": sharpened.info_.scenario_hash,
        "seed": seed,
        "training_seed": trained.seed,
        "training_episodes": trained.num_episodes,
        "assessment_sha256": {mode: file_hash(assessment_file(assessment, mode)) for mode in MODES},
        "versions": versions(),
        **findings.entries,
    }
    results = Results(findings.estimates, entries)
    file = folder / "evaluation.json"
    results.write(file)
    for table in verdict_tables(results):
        console.print(table.to_rich())
    print_path("figures", file)
    for picture in findings.pictures:
        print_path("picture", picture)


def _evaluate_segments(judged: Judged) -> Findings:
    """Evaluates all scorers on fresh episodes, on every segment and at k = 0."""
    from drake_safety.evaluation.episode_study import evaluate_episodes
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.roc_figure import roc_figure
    from drake_safety.evaluation.scorers import assessment_scorer

    scorers = [
        assessment_scorer("sharpened", judged.sharpened),
        assessment_scorer("paper", judged.paper),
        *judged.classifiers,
    ]
    estimates, scores, labels = evaluate_episodes(scorers, judged.calibration_set, judged.test_set)
    curves = {name: (score, labels) for name, score in scores.items()}
    return Findings(
        estimates=estimates,
        pictures=save(roc_figure(curves), judged.folder / "roc"),
    )


def _evaluate_throws(
    judged: Judged, num_throws: int, num_calibration: int, seeds: dict[str, int]
) -> Findings:
    """Evaluates all rules as triggers of recovery, and alarms on the same throws."""
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.throw_study import evaluate_throws, trigger_rules
    from drake_safety.simulation.watched_motion import WatchedMotion

    recovery = judged.scenario.parameters.recovery
    rules = trigger_rules(
        judged.sharpened,
        judged.paper,
        judged.classifiers,
        threshold=recovery.threshold,
    )
    study = evaluate_throws(
        judged.scenario,
        rules,
        persistence_s=recovery.persistence_s,
        num_throws=num_throws,
        num_calibration=num_calibration,
        seed=seeds["disturbances"],
        calibration_seed=seeds["disturbance thresholds"],
        num_workers=judged.workers,
        progress=judged.stages,
    )
    estimates = dict(study.estimates)
    estimates["throws.falls_with_recovery"] = estimates["throws.sharpened.falls_with_recovery"]
    findings = Findings(
        estimates=estimates,
        pictures=save(_throws_picture(study), judged.folder / "throws"),
    )
    findings.add(
        evaluate_monitoring(
            judged,
            [WatchedMotion.of_throw(log) for log in study.calibration_logs],
            [WatchedMotion.of_throw(log) for log in study.logs],
        )
    )
    return findings


def _throws_picture(study: ThrowStudy) -> Figure:
    from drake_safety.evaluation.throws_figure import throws_figure

    balls = [log.throw for log in study.logs]
    return throws_figure(
        np.array([ball.speed_m_s for ball in balls]),
        np.array([ball.direction_rad for ball in balls]),
        {
            "without recovery": study.outcomes(),
            "with recovery, triggered by Γ": study.outcomes("sharpened"),
        },
        mass_kg=np.array([ball.mass_kg for ball in balls]),
    )


def _evaluate_calibration(judged: Judged) -> Findings:
    """Reliability of both modes at k = 0, and rates of stored calibrations."""
    from drake_safety.evaluation.calibration_study import reliability, verdict_shares
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.metrics import Bootstrap
    from drake_safety.evaluation.reliability_figure import reliability_figure
    from drake_safety.evaluation.scorers import assessment_scorer
    from drake_safety.learning.calibration import PLAN, episode_scores
    from drake_safety.learning.segments import split

    segments = split(judged.test_set, stride=1, discount=1.0, shortest=1)
    estimates: dict[str, Estimate] = {}
    curves = {}
    for mode, gamma in {"sharpened": judged.sharpened, "paper": judged.paper}.items():
        score = assessment_scorer(mode, gamma).unsafe_score(segments)
        expected, is_unsafe = episode_scores(segments, score, PLAN)
        curves[mode] = reliability(expected, is_unsafe)

        def error(
            weight: np.ndarray, p: np.ndarray = expected, label: np.ndarray = is_unsafe
        ) -> float:
            drawn = np.repeat(np.arange(len(p)), weight.astype(int))
            return reliability(p[drawn], label[drawn]).calibration_error

        estimates[f"calibration.{mode}.expected_calibration_error"] = Bootstrap(
            num_resamples=100
        ).over_episodes(error, np.arange(len(expected)))
        for kind, one in gamma.calibrations_.items():
            shares = verdict_shares(one, *episode_scores(segments, score, kind))
            estimates |= {
                f"calibration.{kind}.{mode}.{key}": value for key, value in shares.items()
            }
    return Findings(
        estimates=estimates,
        pictures=save(reliability_figure(curves), judged.folder / "reliability"),
    )
