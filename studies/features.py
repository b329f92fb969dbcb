"""``python -m studies features``: Γ without some of its features, beside Γ with all of them."""

from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import AssessmentOption, ScenarioArgument, WorkersOption
from drake_safety.cli.training_folder import (
    assessment_folder,
    episodes_folder,
    family_folder,
    run_fresh_episodes,
)
from drake_safety.evaluation.metrics import segment_estimates
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.inputs import kept_features
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes, split
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.harness import ReleaseOption, Study, open_study

_THRESHOLD = 0.5


def features(
    scenario: ScenarioArgument,
    without: Annotated[
        list[str], typer.Option(help="Features left out: patterns, separated by commas.")
    ],
    assessment: AssessmentOption = None,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 600,
    seed: Annotated[int, typer.Option(help="First of the seeds.")] = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Train Γ anew without features, on the episodes of a run, and judge it on fresh episodes.

    features.json is written to the run's folder.
    """
    folder = assessment_folder(load_scenario(scenario), assessment).path
    options: dict[str, Any] = {"seed": seed, "release": release, "workers": workers}
    with open_study("features", scenario, folder, **options) as study:
        seed = EVALUATION.seeds(study.seed)["evaluation"]
        gamma, report = study.load("sharpened", [seed]), partial(study.stages, "fresh episodes")
        fresh = run_fresh_episodes(study.scenario, folder, episodes, seed, report, workers)
        _judge(study, "all", gamma, fresh)
        nominal = load_episodes(episodes_folder(folder))
        family = load_episodes(family_folder(folder)) if gamma.knows_family else None
        for patterns in without:
            fewer = partial(fewer_features, patterns=patterns.split(","))
            learned = SafetyAssessment(study.scenario.assessment).fit(
                fewer(nominal),
                study.stages,
                family=family and fewer(family),
                detector=gamma.detector_,
            )
            _judge(study, f"without {patterns}", learned, fewer(fresh))


def fewer_features(episodes: Episodes, patterns: list[str]) -> Episodes:
    """The episodes as a scenario with these `without_features` records them."""
    names = episodes.info.feature_names
    kept = kept_features(names, patterns)
    info = replace(episodes.info, feature_names=[names[i] for i in kept], monitored_features=[])
    return Episodes(info, [replace(one, features=one.features[:, kept]) for one in episodes])


def _judge(study: Study, method: str, gamma: SafetyAssessment, episodes: Episodes) -> None:
    segments = split(episodes, stride=1, discount=1.0, shortest=1)
    score = assessment_scorer("sharpened", gamma).unsafe_score(segments)
    for name, rows in (("rows", np.arange(len(score))), ("first", segments.is_first.nonzero()[0])):
        chosen = segments.take(rows)
        study.add(name, method, segment_estimates(chosen, score[rows], threshold=_THRESHOLD))
    study.entries[method] = len(gamma.feature_names)
