"""``drake-safety adapt``: adapts Γ to an actual robot, and evaluates it before and after."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from drake_safety.cli.console import (
    AssessmentOption,
    ClusterOption,
    ScenarioArgument,
    WorkersOption,
    command_line,
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
    assessment_file,
    assessment_folder,
    check_fresh,
    check_writable,
    feedback_folder,
    load_assessment,
)
from drake_safety.evaluation.metrics import Estimate, segment_estimates
from drake_safety.evaluation.results import Results
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import ADAPTATION, MOTION
from drake_safety.learning.segments import Episodes, split
from drake_safety.logs.episodes import cut_log, motions_from_log
from drake_safety.logs.robot_log import LogPieces, RobotLog, read_log, read_pieces
from drake_safety.models import load_robot
from drake_safety.simulation.feedback import EpisodePairs, pair_starts, run_pairs
from drake_safety.simulation.rollouts import run_episodes, run_motions
from drake_safety.simulation.scenario import Scenario, load_scenario

_JUDGED = {"before": "before feedback", "after": "after feedback"}
_COLUMNS = ("brier", "auc", "unsafe_recall", "safe_recall")
_MOST_CUTS = 3  # Printed of a log.
_MOTION_S = 240.0  # Undisturbed motion of a simulated actual plant, for the monitor.
_THRESHOLD = 0.5  # Safety probability below which a segment is classified unsafe.


def adapt(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    feedback: Annotated[
        int, typer.Option(help="Actual episodes, each beside its nominal twin.", min=1)
    ] = 160,
    variation: Annotated[str, typer.Option(help="Variation of the actual plant.")] = "actual",
    evaluate: Annotated[
        int, typer.Option(help="Fresh actual episodes for evaluation; 0 for none.", min=0)
    ] = 0,
    log: Annotated[
        list[Path] | None,
        typer.Option(
            help="Log of a real robot, in place of a simulated variation; may be repeated.",
            exists=True,
        ),
    ] = None,
    log_map: Annotated[
        Path | None, typer.Option("--map", help="Map of the columns of the logs, a YAML file.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; ASSESSMENT/adapted-VARIATION by default.")
    ] = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Refuse a log with a missing value or a gap, instead of cutting it there.",
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(help="Seed of the feedback; that of the evaluation follows.")
    ] = ADAPTATION.first,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Adapt Γ to an actual robot, and evaluate it before and after.

    Writes ASSESSMENT/adapted-VARIATION, which other commands take in place of ASSESSMENT; with
    --log it is named after the first log. Episodes are kept in ASSESSMENT: a stopped adaptation
    continues when called again. For a shipped assessment, ASSESSMENT is runs/SCENARIO-shipped.
    """
    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    priors = {mode: load_assessment(learned.path, mode) for mode in MODES}
    seeds = ADAPTATION.seeds(seed)
    for prior in priors.values():
        check_fresh(prior, loaded, list(seeds.values())[1:] if evaluate else ())
        prior.check_unused(seed, purpose="adaptation")
    logs = log or []
    if bool(logs) != (log_map is not None):
        raise ValueError("adapt: --log needs --map, and --map needs --log")
    if logs and evaluate:
        raise ValueError("adapt: a log has no fresh episodes for evaluation; leave out --evaluate")
    if len({one.resolve() for one in logs}) < len(logs):
        raise ValueError(f"adapt: logs must differ; got {', '.join(str(one) for one in logs)}")
    name = logs[0].stem if logs else variation
    print_shipped(learned)
    folder = out or adapted_folder(learned.out, name)
    judged: dict[str, Estimate] = {}
    check_writable(folder)
    with open_stages() as stages:
        if log_map is not None:
            pieces = log_pieces(loaded, logs, log_map, is_strict=strict)
            actual, starts = cut_log(pieces, loaded)
            pairs = pair_starts(loaded, actual, starts, seed=seed)
            step_s = priors[MODES[0]].detector_.step_s
            motions = motions_from_log(pieces, loaded, step_s=step_s)
        else:
            pairs = paired_episodes(loaded, feedback, variation, seed, learned.out, workers, stages)
            hash_ = loaded.simulation_hash(variation)
            motions = run_motions(
                loaded,
                _MOTION_S,
                variation=variation,
                seed=MOTION.seeds()["motion of the actual robot"],
                num_workers=workers,
                path=feedback_folder(learned.out, hash_, seed) / "motion",
                progress=partial(stages, "undisturbed actual motion"),
                **loaded.options_for("pairs", variation),
            )
        sets = pairs.feedback()
        adapted = {mode: prior.adapt(sets, motions=motions) for mode, prior in priors.items()}
        folder.mkdir(parents=True, exist_ok=True)
        for mode, one in adapted.items():
            one.save(assessment_file(folder, mode))
        if evaluate:
            fresh = fresh_actual_episodes(
                loaded,
                evaluate,
                variation,
                seeds["evaluation of the adaptation"],
                learned.out,
                workers,
                stages,
            )
            for mode in MODES:
                judged |= {
                    f"{mode}.{who}.{key}": estimate
                    for who, one in (("before", priors[mode]), ("after", adapted[mode]))
                    for key, estimate in _judge(one, fresh).items()
                }
    differing, num_pairs = pairs.gap
    entries = {
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
    }
    file = folder / "adaptation.json"
    Results(judged, entries).write(file)
    console.print(_adaptation_table(adapted, differing, num_pairs, name))
    if not differing:
        _print_unchanged(loaded, adapted, num_pairs)
    if judged:
        console.print(_judged_table(judged, variation))
    for mode in adapted:
        print_path("assessment", assessment_file(folder, mode))
    print_path("figures   ", file)


def paired_episodes(
    scenario: Scenario,
    num_pairs: int,
    variation: str,
    seed: int,
    folder: Path,
    workers: int | None,
    stages: StageProgress,
) -> EpisodePairs:
    """Simulates pairs of actual episodes and nominal twins, and keeps them in the folder.

    Args:
        scenario: The scenario.
        num_pairs: Number of pairs.
        variation: Variation of the actual plant.
        seed: Seed of the episodes.
        folder: Folder of the training.
        workers: Number of worker processes; None for one a core.
        stages: Progress bars.
    """
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


def fresh_actual_episodes(
    scenario: Scenario,
    num_episodes: int,
    variation: str,
    seed: int,
    folder: Path,
    workers: int | None,
    stages: StageProgress,
    what: str = "fresh actual episodes",
) -> Episodes:
    """Simulates other episodes of the actual plant, and keeps them in the folder.

    Args:
        scenario: The scenario.
        num_episodes: Number of episodes.
        variation: Variation of the plant.
        seed: Seed of the episodes.
        folder: Folder of the training.
        workers: Number of worker processes; None for one a core.
        stages: Progress bars.
        what: Name of the stage.
    """
    return run_episodes(
        scenario,
        num_episodes,
        variation=variation,
        seed=seed,
        num_workers=workers,
        path=feedback_folder(folder, scenario.simulation_hash(variation), seed) / variation,
        progress=partial(stages, what),
        extra={"command": command_line()},
        **scenario.options_for("pairs", variation),
    )


def log_pieces(
    scenario: Scenario, logs: list[Path], log_map: Path, *, is_strict: bool = False
) -> list[RobotLog]:
    """The pieces of logs without gaps; where they are cut is printed."""
    robot = load_robot(scenario.robot)
    pieces: list[RobotLog] = []
    for log in logs:
        if is_strict:
            pieces.append(read_log(log, log_map, robot))
            continue
        found = read_pieces(log, log_map, robot)
        pieces += found.pieces
        if found.cuts:
            _print_cuts(log, found)
    return pieces


def _print_unchanged(
    scenario: Scenario, adapted: dict[str, SafetyAssessment], num_pairs: int
) -> None:
    """Says which modes have learned nothing from pairs that all end alike, and what it takes."""
    unchanged = [mode for mode, one in adapted.items() if _is_unchanged(one)]
    if not unchanged:
        return
    num_needed = scenario.assessment.adaptation.update_interval
    duration_s = num_needed * scenario.episode_duration_s
    pairs = "the only pair ends" if num_pairs == 1 else f"all {num_pairs} pairs end"
    console.print(
        f"nothing changed ({', '.join(unchanged)}): {pairs} as on the nominal plant, and it learns "
        f"from those that do not. A first update takes about {num_needed} pairs, as of "
        f"{duration_s:g} s of logs, some of which end otherwise",
        style="yellow",
        highlight=False,
        soft_wrap=True,
    )


def _is_unchanged(adapted: SafetyAssessment) -> bool:
    found = adapted.adaptation_
    is_corrected = found is not None and found.method == "recalibration"
    return is_corrected and not adapted.correction_.is_any


def _print_cuts(log: Path, found: LogPieces) -> None:
    lines = [
        f"log '{log}' is cut where values are missing and at gaps: {100 * found.kept_share:.1f} % "
        f"of {found.duration_s:.1f} s are kept, in {len(found.pieces)} pieces",
        *found.cuts[:_MOST_CUTS],
    ]
    if len(found.cuts) > _MOST_CUTS:
        lines.append(f"... and {len(found.cuts) - _MOST_CUTS} more; --strict refuses such a log")
    for line in lines:
        console.print(line, style="yellow", highlight=False, soft_wrap=True)


def _judge(assessment: SafetyAssessment, fresh: Episodes) -> dict[str, Estimate]:
    """Estimates of the probability on every segment of fresh episodes."""
    segments = split(fresh, stride=1, discount=1.0, shortest=assessment.settings.shortest)
    result = assessment.predict_rows(segments, fresh.info.variation)
    return segment_estimates(segments, 1.0 - result.probability, threshold=1.0 - _THRESHOLD)


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
            if _is_unchanged(one):
                change = ["unchanged"] * len(change)
            table.add_row(mode, found.method, *change)
    return table


def _judged_table(judged: dict[str, Estimate], variation: str) -> Table:
    n = judged[f"{MODES[0]}.before.auc"].n
    table = new_table(
        "", *_COLUMNS, title=f"{n} fresh episodes of '{variation}', recalls at {_THRESHOLD:g}"
    )
    for mode in MODES:
        for who, label in _JUDGED.items():
            estimates = (judged[f"{mode}.{who}.{key}"] for key in _COLUMNS)
            table.add_row(f"{mode}, {label}", *map(interval, estimates))
    return table
