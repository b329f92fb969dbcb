"""``drake-safety evaluate``: evaluates Γ on fresh episodes, on throws, and under shifts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.diagrams.balancing.throw_study import (
    PAPER_THRESHOLD,
    TriggerRule,
    evaluate_throws,
)
from drake_safety.diagrams.balancing.throws import HasBall
from drake_safety.evaluation import shift_study
from drake_safety.evaluation.embedding_figure import embedding_figure
from drake_safety.evaluation.episode_study import (
    evaluate_causes,
    evaluate_episodes,
    evaluate_plans,
    first_segments,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.reliability import reliability, reliability_figure, verdict_shares
from drake_safety.evaluation.results import Key, Results
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.evaluation.shifts import plant_shifts
from drake_safety.evaluation.verdict_tables import verdict_tables
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.calibration import PLAN, episode_scores
from drake_safety.learning.seeds import EVALUATION, FRESH_MOTION, SHIFTS, SeedBlock, use_of
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.rollouts import MOTION_PIECE_S, run_motions
from drake_safety.simulation.scenario import Scenario, load_scenario

_AS_PUBLISHED = "paper_at_06"  # The mode with the paper's threshold.
_FAMILY_PLANTS = 20  # Fresh plants.
_ON_FAMILY = "episodes on the family's plants"


@dataclass
class Evaluation:
    """An evaluation under way: Γ by mode, where results go, and seeds by purpose."""

    scenario: Scenario
    assessments: Mapping[str, SafetyAssessment]
    run_folder: Path
    folder: Path
    seeds: Mapping[str, int]
    workers: int | None
    stages: StageProgress
    estimates: dict[Key, Estimate] = field(default_factory=dict)
    entries: dict[str, Any] = field(default_factory=dict)

    @property
    def scorers(self) -> list[Scorer]:
        """The probability of either mode."""
        return [assessment_scorer(mode, one) for mode, one in self.assessments.items()]

    def fresh(self, what: str, number: int, purpose: str, **options: Any) -> Episodes:
        """Fresh episodes, nominal unless options say otherwise, kept in the run's folder."""
        seed, progress = self.seeds[purpose], partial(self.stages, what)
        return folders.run_fresh_episodes(
            self.scenario, self.run_folder, number, seed, progress, self.workers, **options
        )

    def add(self, estimates: Mapping[Key, Estimate], **figures: Figure) -> None:
        """Adds results, and writes figures by name."""
        self.estimates |= estimates
        for name, figure in figures.items():
            for picture in save(figure, self.folder / name):
                console.say("picture", picture)


def evaluate(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    episodes: Annotated[int, Option(help="Fresh nominal episodes.", min=1)] = 1000,
    calibration_episodes: Annotated[
        int, Option(help="Others, for thresholds; as many on the family's plants.", min=20)
    ] = 300,
    throws: Annotated[
        int | None, Option(help="Throws at the actual plant; 600 for tasks with recovery.", min=0)
    ] = None,
    shifts: Annotated[
        int, Option(help="Evaluate changed plants and sensors instead, by so many episodes.", min=0)
    ] = 0,
    hours: Annotated[
        float, Option(help="Hours of undisturbed motion for false alarms, with --shifts.", min=0.0)
    ] = 0.2,
    seed: Annotated[
        int | None,
        Option(help=f"First seed; by default {EVALUATION.first}, with --shifts {SHIFTS.first}."),
    ] = None,
    out: Annotated[Path | None, Option(help="Folder of results; by default ASSESSMENT.")] = None,
    workers: console.WorkersOption = None,
    cluster: console.ClusterOption = None,
) -> None:
    """Evaluate Γ, and the paper's form, on fresh episodes, throws and, with --shifts, other plants.

    Episodes are kept in ASSESSMENT: a stopped evaluation continues.
    """
    loaded = load_scenario(scenario)
    learned = folders.assessment_folder(loaded, assessment)
    folder = out or learned.out
    folders.check_writable(learned.out, folder)
    loop, block = loaded.make_loop(), SHIFTS if shifts else EVALUATION
    if throws is None:
        is_thrown_at = isinstance(loop, HasBall) and not isinstance(loop, HasGoals)
        throws = 600 if is_thrown_at else 0
    elif throws:
        require(loop, HasBall, "evaluate: pass --throws 0")
    with evaluating(loaded, learned, folder, block, seed, workers) as evaluation:
        if shifts:
            _add_shifts(evaluation, shifts, episodes, hours)
            return
        evaluation.entries["calibration_episodes"] = calibration_episodes
        test = evaluation.fresh("fresh nominal episodes", episodes, "evaluation")
        other = evaluation.fresh("calibration episodes", calibration_episodes, "thresholds")
        add_verdicts(evaluation, evaluation.scorers, other, test)
        add_reliability(evaluation, test)
        add_family(evaluation, calibration_episodes)
        if throws:
            add_throws(evaluation, throws)


@contextmanager
def evaluating(
    scenario: Scenario,
    learned: folders.AssessmentFolder,
    folder: Path,
    block: SeedBlock,
    seed: int | None,
    workers: int | None,
    program: str = "drake-safety",
) -> Iterator[Evaluation]:
    """Yields an evaluation of a run; after the `with` statement its results are written."""
    assessments = folders.load_assessments(learned.path)
    files = {mode: folders.assessment_file(learned.path, mode) for mode in assessments}
    hashes = {mode: file_hash(file) for mode, file in files.items()}
    seeds = block.seeds(seed)
    for gamma in assessments.values():
        folders.check_fresh(gamma, scenario, seeds.values())
    with console.open_stages() as stages:
        evaluation = Evaluation(scenario, assessments, learned.out, folder, seeds, workers, stages)
        yield evaluation
    sharpened, paper = assessments[MODES[0]], assessments.get(MODES[1])
    trained = [one for one in sharpened.used_ if one.purpose.startswith("training")]
    made = console.made_by(scenario.name, program) | {
        "scenario_hash": sharpened.info_.scenario_hash,
        "seed": next(iter(seeds.values())),
        "seed_use": use_of(next(iter(seeds.values()))),
        "training_seed": trained[0].seed,
        "training_episodes": trained[0].num_episodes,
        "family_episodes": sum(one.num_episodes for one in trained[1:]),
        "paper_episodes": paper.used_[0].num_episodes if paper else 0,
        "assessment_sha256": hashes,
    }
    results = Results(evaluation.estimates, made | evaluation.entries)
    file = folder / ("shifts.json" if block is SHIFTS else "evaluation.json")
    results.write(file)
    for table in [*verdict_tables(results), *shift_study.shifts_tables(results)]:
        console.show(table.to_rich())
    console.say(sharpened.detector_.describe())
    console.say("figures", file)


def add_verdicts(
    evaluation: Evaluation, scorers: Sequence[Scorer], calibration: Episodes, test: Episodes
) -> None:
    """Evaluates scorers on fresh plans with a goal, else on every segment and first rows."""
    if isinstance(evaluation.scenario.make_loop(), HasGoals):
        stored = {m: g.calibrations_.get(PLAN) for m, g in evaluation.assessments.items()}
        thresholds = {mode: 1.0 - one.threshold for mode, one in stored.items() if one}
        thresholds[_AS_PUBLISHED] = 1.0 - PAPER_THRESHOLD
        paper = [replace(one, name=_AS_PUBLISHED) for one in scorers if one.name == MODES[1]]
        scorers = [*scorers, *paper]
        estimates = evaluate_plans(scorers, calibration, test, thresholds)
        if (gamma := evaluation.assessments.get(MODES[0])) and (plan := stored[MODES[0]]):
            predicted = gamma.predict_rows(first_segments(test))
            limits = {"margin_unit": gamma.parameters.margin_unit, "threshold": plan.threshold}
            estimates |= evaluate_causes(predicted, test, **limits)
    else:
        estimates = evaluate_episodes(scorers, calibration, test)
    maps = {f"embedding_{m}": embedding_figure(g, test) for m, g in evaluation.assessments.items()}
    evaluation.add(estimates, **maps)


def add_reliability(evaluation: Evaluation, test: Episodes) -> None:
    """Evaluates the reliability of either mode, and its stored calibrations."""
    segments = split(test, stride=1, discount=1.0, shortest=1)
    estimates, curves = dict[Key, Estimate](), {}
    for scorer in evaluation.scorers:
        mode, score = scorer.name, scorer.unsafe_score(segments)
        of_first, label = episode_scores(segments, score, PLAN)
        curves[f"{mode}, first row"] = reliability(of_first, label, np.arange(len(label)))
        curves[f"{mode}, every row"] = reliability(score, segments.is_unsafe, segments.episode)
        estimates |= _promises(evaluation.assessments[mode], mode, segments, score, family=False)
    evaluation.add(estimates, reliability=reliability_figure(curves))


def add_family(evaluation: Evaluation, num_episodes: int) -> None:
    """Evaluates promises over a family, if Γ has learned one, a fresh plant for each episode."""
    known = {mode: one for mode, one in evaluation.assessments.items() if one.knows_family}
    if not known:
        return
    options: dict[str, Any] = {"variation": FAMILY, "plants": num_episodes}
    drawn = evaluation.fresh(_ON_FAMILY, num_episodes, "evaluation", **options)
    segments = split(drawn, stride=1, discount=1.0, shortest=1)
    for mode, gamma in known.items():
        score = assessment_scorer(mode, gamma).unsafe_score(segments)
        evaluation.add(_promises(gamma, mode, segments, score, family=True))


def _promises(
    gamma: SafetyAssessment, mode: str, segments: Segments, score: np.ndarray, *, family: bool
) -> dict[Key, Estimate]:
    """Shares of the verdicts by thresholds whose promise is over the family, or the others."""
    return {
        (f"calibration.{one.key}", mode, what): share
        for one in gamma.calibrations_.values()
        if bool(one.plants) == family
        for what, share in verdict_shares(one, *episode_scores(segments, score, one.kind)).items()
    }


def add_throws(
    evaluation: Evaluation, num_throws: int, rules: Sequence[TriggerRule] = ()
) -> list[Motion]:
    """Evaluates either mode, and other rules, as triggers of recovery; returns the throws."""
    recovery = evaluation.scenario.parameters.recovery
    thresholds = dict(zip(MODES, (recovery.threshold, PAPER_THRESHOLD), strict=True))
    own = [TriggerRule(scorer=one, threshold=thresholds[one.name]) for one in evaluation.scorers]
    estimates, logs = evaluate_throws(
        evaluation.scenario,
        [*own, *rules],
        persistence_s=recovery.persistence_s,
        num_throws=num_throws,
        seed=evaluation.seeds["disturbances"],
        num_workers=evaluation.workers,
        progress=evaluation.stages,
    )
    evaluation.add(estimates)
    return logs


def _add_shifts(evaluation: Evaluation, num_episodes: int, num_nominal: int, hours: float) -> None:
    """Evaluates both modes on changed plants and faulty sensors, and on nominal motions."""
    scenario, seed, stages = evaluation.scenario, evaluation.seeds["shifts"], evaluation.stages
    workers, gamma = evaluation.workers, evaluation.assessments[MODES[0]]
    names = {"gamma" if mode == MODES[0] else mode: g for mode, g in evaluation.assessments.items()}
    shifts = plant_shifts(scenario, scenario.make_loop())
    nominal = evaluation.fresh("nominal motions", num_nominal, "shifts")
    judged = {"nominal": shift_study.shift_estimates(names, nominal[:1000])}
    kinds: dict[str, str] = {"nominal": "nominal"}
    if scenario.family is not None:
        number = _FAMILY_PLANTS * max(num_episodes // 4, 1)
        on_family: dict[str, Any] = {"variation": FAMILY, "plants": _FAMILY_PLANTS}
        drawn = evaluation.fresh(_ON_FAMILY, number, "shifts", **on_family)
        judged[FAMILY] = shift_study.shift_estimates(names, drawn)
        kinds[FAMILY] = "family"
    for i, (name, shift) in enumerate(shifts.items()):
        stages("shifted motions", i, len(shifts))
        shifted = scenario.with_variation(name, shift.variation)
        options = {**scenario.options_for("evaluation"), **shift.options}
        episodes = folders.run_fresh_episodes(
            shifted, evaluation.run_folder, num_episodes, seed, None, workers, name, **options
        )
        few = max(num_episodes // 4, 2)
        with_: dict[str, Any] = {"options": options, "num_workers": workers}
        motions = shift_study.run_monitored(shifted, name, few, seed, gamma.detector_, **with_)
        watched = shift_study.monitor_estimates(shift_study.monitored(motions, gamma))
        judged[name] = shift_study.shift_estimates(names, episodes)
        judged[name] |= {("monitor", metric): one for metric, one in watched.items()}
    stages("shifted motions", len(shifts), len(shifts))
    fresh_seed = FRESH_MOTION.first_beside(seed)
    lasting: dict[str, dict[str, Any]] = {"nominal": {}}
    if scenario.family is not None:
        plants = math.ceil(3600.0 * hours / MOTION_PIECE_S)
        lasting[FAMILY] = {"variation": FAMILY, "plants": plants}
    for name, of_plants in lasting.items():
        if hours:
            usual = run_motions(
                scenario,
                3600.0 * hours,
                seed=fresh_seed,
                num_workers=workers,
                path=folders.fresh_episodes_folder(
                    evaluation.run_folder, "motion", fresh_seed, of_plants
                ),
                progress=partial(stages, f"undisturbed motion, {name}"),
                **of_plants,
            )
            alarms = shift_study.false_alarms(usual, gamma.detector_)
            judged[name]["monitor", "false_alarms_per_hour"] = alarms
    for name, each in judged.items():
        evaluation.add({(f"shifts.{name}", *key): one for key, one in each.items()})
    evaluation.entries["kinds"] = kinds | {name: shift.kind for name, shift in shifts.items()}
