"""``drake-safety adapt``: adapts Γ to an actual robot, and evaluates it before and after."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.metrics import Estimate, segment_estimates
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column
from drake_safety.evaluation.verdict_tables import verdict_table
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
    folder = out or folders.adapted_folder(learned.out, name)
    folders.check_writable(folder)
    judged: dict[str, Estimate] = {}
    with console.open_stages() as stages:
        plant = ActualPlant(loaded, variation, learned.out, workers, stages)
        if log_map is not None:
            pieces = log_pieces(loaded, logs, log_map, is_strict=strict)
            actual, starts = cut_log(pieces, loaded)
            pairs = pair_starts(loaded, actual, starts, seed=seed)
            step_s = priors[MODES[0]].detector_.step_s
            motions = motions_from_log(pieces, loaded, step_s=step_s)
        else:
            pairs, motions = plant.pairs(feedback, seed), plant.motion(seed)
        sets = pairs.feedback()
        adapted = {mode: prior.adapt(sets, motions=motions) for mode, prior in priors.items()}
        folder.mkdir(parents=True, exist_ok=True)
        for mode, one in adapted.items():
            one.save(folders.assessment_file(folder, mode))
        if evaluate:
            fresh = plant.fresh(evaluate, seeds["evaluation of the adaptation"])
            for mode in MODES:
                for when, one in (("before", priors[mode]), ("after", adapted[mode])):
                    segments = split(fresh, stride=1, discount=1.0, shortest=one.settings.shortest)
                    unsafe = 1.0 - one.predict_rows(segments, fresh.info.variation).probability
                    found = segment_estimates(segments, unsafe, threshold=1.0 - _THRESHOLD)
                    judged |= {f"{mode}.{when}.{key}": value for key, value in found.items()}
    gap = sum(pair.differs for pair in sets), len(sets)
    entries = {
        "scenario_hash": pairs.actual.info.scenario_hash,
        "nominal_hash": pairs.nominal.info.scenario_hash,
        "variation": name,
        "logs": [str(one) for one in logs],
        "seed": seed,
        "feedback_sets": gap[1],
        "differing_pairs": gap[0],
        "change": {mode: one.correction_.change.tolist() for mode, one in adapted.items()},
    }
    results = Results(judged, console.made_by(loaded.name) | entries)
    results.write(folder / "adaptation.json")
    _print_changes(loaded, adapted, gap, name)
    for mode in MODES if judged else ():
        title = f"{mode}, before and after feedback: '{variation}', recalls at {_THRESHOLD:g}"
        table = verdict_table(results, mode, corner="feedback", kind=(title, "", _COLUMNS))
        console.show(table.to_rich())
    for mode in adapted:
        console.say("assessment", folders.assessment_file(folder, mode))
    console.say("figures   ", folder / "adaptation.json")


class ActualPlant(NamedTuple):
    """Simulations of an actual plant, which the folder of a training keeps."""

    scenario: Scenario
    variation: str
    folder: Path
    workers: int | None
    stages: StageProgress

    def pairs(self, num_pairs: int, seed: int) -> EpisodePairs:
        """Actual episodes and their nominal twins."""
        kept = self._kept("actual episodes and their twins", seed)
        return run_pairs(self.scenario, num_pairs, seed=seed, **kept)

    def fresh(self, num_episodes: int, seed: int) -> Episodes:
        """Other episodes of the actual plant."""
        kept = self._kept("fresh actual episodes", seed, self.variation)
        return run_episodes(self.scenario, num_episodes, seed=seed, **kept)

    def motion(self, seed: int) -> Episodes:
        """Undisturbed motion of the actual plant, beside the pairs of a seed."""
        kept = self._kept("undisturbed actual motion", seed, "motion")
        drawn = MOTION.seeds()["motion of the actual robot"]
        return run_motions(self.scenario, _MOTION_S, seed=drawn, **kept)

    def _kept(self, what: str, seed: int, within: str = "") -> dict[str, Any]:
        hash_ = self.scenario.simulation_hash(self.variation)
        return self.scenario.options_for("pairs", self.variation) | {
            "variation": self.variation,
            "num_workers": self.workers,
            "path": self.folder / "feedback" / f"{hash_[:12]}-{seed}" / within,
            "progress": partial(self.stages, what),
            "extra": {"command": console.command_line()},
        }


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
        cuts = found.cuts[:_MOST_CUTS]
        if num_more := len(found.cuts) - len(cuts):
            cuts.append(f"... and {num_more} more; --strict refuses such a log")
        if cuts:
            console.say(
                f"log '{log}' is cut where values are missing and at gaps, or resampled: "
                f"{100 * found.kept_share:.1f} % of {found.duration_s:.1f} s are kept, in "
                f"{len(found.pieces)} pieces",
                *cuts,
                sep="\n",
                style="yellow",
            )
    return pieces


def _print_changes(
    scenario: Scenario, adapted: Mapping[str, SafetyAssessment], gap: tuple[int, int], name: str
) -> None:
    """Prints what has changed; or that pairs that all end alike change nothing, and what does."""
    (differing, num_pairs), rows, unchanged = gap, [], []
    for mode, one in adapted.items():
        assert one.adaptation_ is not None
        change = ["-"] * 3
        if one.adaptation_.method == "recalibration":
            change = [f"{value:+.2f}" for value in one.correction_.change]
            if not one.correction_.is_any:
                change = ["unchanged"] * 3
                unchanged.append(mode)
        rows.append((mode, one.adaptation_.method, *change))
    columns = ("mode", "method", "added to the offset", "safety slope", "margin slope")
    title = f"Adapted to '{name}': {differing} of {num_pairs} pairs end differently"
    console.show(console.new_table(*columns, rows=rows, title=title))
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
