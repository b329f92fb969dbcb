"""``python -m studies evaluate``: `drake-safety evaluate` beside baselines, with what docs show.

Its ``evaluation.json`` has what `drake-safety evaluate` writes and, besides, baseline classifiers
and alarms on throws.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_safety.cli.console import (
    ClusterOption,
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
)
from drake_safety.cli.evaluate import (
    Evaluation,
    add_family,
    add_reliability,
    add_throws,
    add_verdicts,
    evaluating,
)
from drake_safety.cli.training_folder import (
    AssessmentFolder,
    check_writable,
    training_episodes,
)
from drake_safety.diagrams.balancing.throws import HasBall, run_throws
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.seeds import EVALUATION, RELEASE
from drake_safety.simulation.capabilities import (
    CanFall,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import load_scenario
from studies.alarms import (
    evaluate_alarms,
    scorer_alarm,
    threshold_alarms,
)
from studies.baselines import classifier_differences, classifier_scorers
from studies.harness import ReleaseOption
from studies.throws import classifier_rules

_CLASSIFIER_SEEDS = (0, 1, 2)
_PROGRAM = "python -m studies"


def evaluate(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    throws: Annotated[int, typer.Option(help="Fresh throws at the actual plant.", min=0)] = 0,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other episodes, for thresholds.", min=20)
    ] = 300,
    calibration_throws: Annotated[
        int, typer.Option(help="Other throws, for thresholds of the classifiers.", min=1)
    ] = 200,
    seed: Annotated[int | None, typer.Option(help="First of the seeds.")] = None,
    release: ReleaseOption = False,
    out: Annotated[Path | None, typer.Option(help="Folder; ASSESSMENT's by default.")] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Evaluate Γ beside baselines, trained on the same episodes, for README and docs."""
    loaded, folder = load_scenario(scenario), out or assessment
    check_writable(assessment, folder)
    learned = AssessmentFolder(assessment, assessment)
    first = (EVALUATION.first if seed is None else seed) + RELEASE * release
    loop = loaded.make_loop()
    if throws:
        require(loop, HasBall)
    with evaluating(loaded, learned, folder, EVALUATION, first, workers, _PROGRAM) as evaluation:
        evaluation.entries["calibration_episodes"] = calibration_episodes
        test = evaluation.fresh("fresh nominal episodes", episodes, "evaluation")
        other = evaluation.fresh("calibration episodes", calibration_episodes, "thresholds")
        gamma = evaluation.assessments["sharpened"]
        training = training_episodes(assessment, gamma)
        shortest = gamma.parameters.shortest_segment or None
        trained = classifier_scorers(
            training, evaluation.stages, shortest=shortest, seeds=_CLASSIFIER_SEEDS
        )
        of_first_seed = trained[:: len(_CLASSIFIER_SEEDS)]
        classifiers = [replace(one, name=one.name.rpartition("_")[0]) for one in of_first_seed]
        add_verdicts(evaluation, [*evaluation.scorers, *classifiers], other, test)
        evaluation.add(classifier_differences(evaluation.scorers[0], trained, test))
        add_reliability(evaluation, test)
        add_family(evaluation, calibration_episodes)
        if throws:
            _add_throws(evaluation, loop, classifiers, throws, calibration_throws)


def _add_throws(
    evaluation: Evaluation,
    loop: ClosedLoop,
    classifiers: Sequence[Scorer],
    num_throws: int,
    num_calibration: int,
) -> None:
    calibration = run_throws(
        evaluation.scenario,
        list(range(num_calibration)),
        seed=evaluation.seeds["disturbance thresholds"],
        num_workers=evaluation.workers,
        progress=partial(evaluation.stages, "calibration throws"),
    )
    persistence_s = evaluation.scenario.parameters.recovery.persistence_s
    rules = classifier_rules(classifiers, calibration, persistence_s)
    logs = add_throws(evaluation, num_throws, rules)
    evaluation.add(_alarm_estimates(evaluation, loop, classifiers, calibration, logs))


def _alarm_estimates(
    evaluation: Evaluation,
    loop: Any,
    classifiers: Sequence[Scorer],
    calibration: Sequence[Motion],
    test: Sequence[Motion],
) -> dict[Key, Estimate]:
    if all(motion.has_left for motion in calibration):
        return {}  # Thresholds need motions that stay safe.
    watched = loop.watched_features if isinstance(loop, CanFall) else {}
    alarms = [
        *(scorer_alarm(scorer) for scorer in evaluation.scorers),
        *(scorer_alarm(scorer) for scorer in classifiers),
        *threshold_alarms(loop.state_names, loop.feature_names, watched),
    ]
    return evaluate_alarms(alarms, calibration, test)
