"""``drake-safety adapt``: adapts Γ to an actual robot, and evaluates it before and after."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.metrics import Estimate, segment_estimates
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column, Table, rows_of
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import ADAPTATION, MOTION
from drake_safety.learning.segments import Episodes, split
from drake_safety.logs.episodes import cut_log, motions_from_log
from drake_safety.logs.robot_log import RobotLog, read_log, read_pieces
from drake_safety.models import load_robot
from drake_safety.simulation.feedback import EpisodePairs, pair_starts, run_pairs
from drake_safety.simulation.rollouts import run_episodes, run_motions
from drake_safety.simulation.scenario import Scenario, load_scenario

_COLUMNS = [Column(key, key) for key in ("brier", "auc", "unsafe_recall", "safe_recall")]
_UNCHANGED = "unchanged"
_MOST_CUTS = 3  # Printed of a log.
_MOTION_S = 240.0  # Undisturbed motion of a simulated actual plant, for the monitor.
_THRESHOLD = 0.5  # Safety probability below which a segment is classified unsafe.


def adapt(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    feedback: Annotated[
        int, Option(help="Actual episodes, each with a nominal twin.", min=1)
    ] = 160,
    variation: Annotated[str, Option(help="Variation of the actual plant.")] = "actual",
    evaluate: Annotated[int, Option(help="Fresh actual episodes to evaluate on.", min=0)] = 0,
    log: Annotated[
        list[Path] | None,
        Option(help="Log of a robot, in place of a variation; may be repeated.", exists=True),
    ] = None,
    log_map: Annotated[Path | None, Option("--map", help="Map of their columns (YAML).")] = None,
    out: Annotated[
        Path | None, Option(help="Folder to write; ASSESSMENT/adapted-VARIATION by default.")
    ] = None,
    strict: Annotated[
        bool, Option("--strict", help="Refuse a log with a missing value or a gap: do not cut it.")
    ] = False,
    seed: Annotated[
        int, Option(help="Seed of the feedback; that of the evaluation follows.")
    ] = ADAPTATION.first,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Adapt Γ to an actual robot, and evaluate it before and after.

    Writes ASSESSMENT/adapted-VARIATION, which other commands take in place of ASSESSMENT; with
    --log it is named after the first log. Episodes are kept in ASSESSMENT: a stopped adaptation
    continues when called again. For a shipped assessment, ASSESSMENT is runs/SCENARIO-shipped.
    """
    loaded = load_scenario(scenario)
    learned = folders.assessment_folder(loaded, assessment)
    priors = {mode: folders.load_assessment(learned.path, mode) for mode in MODES}
    seeds = ADAPTATION.seeds(seed)
    for prior in priors.values():
        folders.check_fresh(prior, loaded, list(seeds.values())[1:] if evaluate else ())
        prior.check_unused(seed, purpose="adaptation")
    logs = log or []
    if bool(logs) != (log_map is not None):
        raise ValueError("adapt: --log needs --map, and --map needs --log")
    if logs and evaluate:
        raise ValueError("adapt: a log has no fresh episodes for evaluation; leave out --evaluate")
    if len({one.resolve() for one in logs}) < len(logs):
        raise ValueError(f"adapt: logs must differ; got {', '.join(map(str, logs))}")
    name = logs[0].stem if logs else variation
    console.print_shipped(learned)
    folder = out or folders.adapted_folder(learned.out, name)
    judged: dict[str, Estimate] = {}
    folders.check_writable(folder)
    with console.open_stages() as stages:
        simulated = (learned.out, workers, stages)
        if log_map is not None:
            pieces = log_pieces(loaded, logs, log_map, is_strict=strict)
            actual, starts = cut_log(pieces, loaded)
            pairs = pair_starts(loaded, actual, starts, seed=seed)
            step_s = priors[MODES[0]].detector_.step_s
            motions = motions_from_log(pieces, loaded, step_s=step_s)
        else:
            pairs = paired_episodes(loaded, feedback, variation, seed, *simulated)
            kept = _kept(loaded, variation, seed, learned.out, workers)
            kept["seed"] = MOTION.seeds()["motion of the actual robot"]
            kept["path"] /= "motion"
            progress = partial(stages, "undisturbed actual motion")
            pairing = loaded.options_for("pairs", variation)
            motions = run_motions(loaded, _MOTION_S, progress=progress, **kept, **pairing)
        sets = pairs.feedback()
        adapted = {mode: prior.adapt(sets, motions=motions) for mode, prior in priors.items()}
        folder.mkdir(parents=True, exist_ok=True)
        for mode, one in adapted.items():
            one.save(folders.assessment_file(folder, mode))
        if evaluate:
            seed_of_fresh = seeds["evaluation of the adaptation"]
            fresh = fresh_actual_episodes(loaded, evaluate, variation, seed_of_fresh, *simulated)
            for mode in MODES:
                for who, one in (("before", priors[mode]), ("after", adapted[mode])):
                    found = _judge(one, fresh).items()
                    judged |= {f"{mode}.{who}.{key}": estimate for key, estimate in found}
    differing, num_pairs = sum(pair.differs for pair in sets), len(sets)
    entries = {
        "scenario_hash": pairs.actual.info.scenario_hash,
        "nominal_hash": pairs.nominal.info.scenario_hash,
        "variation": name,
        "logs": [str(one) for one in logs],
        "seed": seed,
        "feedback_sets": num_pairs,
        "differing_pairs": differing,
        "change": {mode: one.correction_.change.tolist() for mode, one in adapted.items()},
    }
    results = Results(judged, console.made_by(loaded.name) | entries)
    results.write(folder / "adaptation.json")
    _print_changes(loaded, adapted, differing, num_pairs, name)
    if judged:
        labels = {
            f"{mode}.{when}": f"{mode}, {when} feedback"
            for mode in MODES
            for when in ("before", "after")
        }
        rows = rows_of(results, labels, _COLUMNS)
        n = results[f"{MODES[0]}.before.auc"].n
        title = f"{n} fresh episodes of '{variation}', recalls at {_THRESHOLD:g}"
        console.show(Table(corner="", columns=_COLUMNS, rows=rows, title=title).to_rich())
    for mode in adapted:
        console.say("assessment", folders.assessment_file(folder, mode))
    console.say("figures   ", folder / "adaptation.json")


def _kept(
    scenario: Scenario, variation: str, seed: int, folder: Path, workers: int | None
) -> dict[str, Any]:
    """Options of simulations of an actual plant that the folder of a training keeps."""
    path = folder / "feedback" / f"{scenario.simulation_hash(variation)[:12]}-{seed}"
    return {
        "variation": variation,
        "seed": seed,
        "num_workers": workers,
        "path": path,
        "extra": {"command": console.command_line()},
    }


def paired_episodes(
    scenario: Scenario,
    num_pairs: int,
    variation: str,
    seed: int,
    folder: Path,
    workers: int | None,
    stages: StageProgress,
) -> EpisodePairs:
    """Simulates pairs of actual episodes and nominal twins, kept in the folder of the training."""
    kept = _kept(scenario, variation, seed, folder, workers)
    progress = partial(stages, "actual episodes and their twins")
    return run_pairs(scenario, num_pairs, progress=progress, **kept)


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
    """Simulates other episodes of the actual plant, kept in the folder of the training."""
    kept = _kept(scenario, variation, seed, folder, workers)
    kept["path"] /= variation
    pairing = scenario.options_for("pairs", variation)
    return run_episodes(scenario, num_episodes, progress=partial(stages, what), **kept, **pairing)


def log_pieces(
    scenario: Scenario, logs: list[Path], log_map: Path, *, is_strict: bool = False
) -> list[RobotLog]:
    """The pieces of logs without gaps; where they are cut is printed."""
    robot = load_robot(scenario.robot)
    if is_strict:
        return [read_log(log, log_map, robot) for log in logs]
    pieces: list[RobotLog] = []
    for log in logs:
        found = read_pieces(log, log_map, robot)
        pieces += found.pieces
        if not found.cuts:
            continue
        console.say(
            f"log '{log}' is cut where values are missing and at gaps: "
            f"{100 * found.kept_share:.1f} % of {found.duration_s:.1f} s are kept, in "
            f"{len(found.pieces)} pieces",
            *found.cuts[:_MOST_CUTS],
            sep="\n",
            style="yellow",
        )
        if num_more := len(found.cuts[_MOST_CUTS:]):
            console.say(f"... and {num_more} more; --strict refuses such a log", style="yellow")
    return pieces


def _print_changes(
    scenario: Scenario,
    adapted: Mapping[str, SafetyAssessment],
    differing: int,
    num_pairs: int,
    variation: str,
) -> None:
    """Prints what has changed; or that pairs that all end alike change nothing, and what does."""
    changes, methods = {}, {}
    for mode, one in adapted.items():
        changes[mode] = ["-"] * 3
        assert one.adaptation_ is not None
        methods[mode] = one.adaptation_.method
        if methods[mode] == "recalibration":
            change = one.correction_.change
            is_any = one.correction_.is_any
            changes[mode] = [f"{value:+.2f}" if is_any else _UNCHANGED for value in change]
    columns = ("mode", "method", "added to the offset", "safety slope", "margin slope")
    rows = [(mode, methods[mode], *change) for mode, change in changes.items()]
    title = f"Adapted to '{variation}': {differing} of {num_pairs} pairs end differently"
    console.show(console.new_table(*columns, rows=rows, title=title))
    unchanged = [mode for mode, change in changes.items() if _UNCHANGED in change]
    if differing or not unchanged:
        return
    num_needed = scenario.assessment.adaptation.update_interval
    duration_s = num_needed * scenario.episode_duration_s
    pairs = "the only pair ends" if num_pairs == 1 else f"all {num_pairs} pairs end"
    console.say(
        f"nothing changed ({', '.join(unchanged)}): {pairs} as on the nominal plant, and it learns "
        f"from those that do not. A first update takes about {num_needed} pairs, as of "
        f"{duration_s:g} s of logs, some of which end otherwise",
        style="yellow",
    )


def _judge(assessment: SafetyAssessment, fresh: Episodes) -> dict[str, Estimate]:
    """Estimates of the probability on every segment of fresh episodes."""
    segments = split(fresh, stride=1, discount=1.0, shortest=assessment.settings.shortest)
    result = assessment.predict_rows(segments, fresh.info.variation)
    return segment_estimates(segments, 1.0 - result.probability, threshold=1.0 - _THRESHOLD)
