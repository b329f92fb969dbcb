"""``python -m studies adaptation``: adaptation by feedback, beside boosting."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
import typer

from drake_safety.cli.console import AssessmentOption, ScenarioArgument, WorkersOption
from drake_safety.cli.training_folder import (
    MODES,
    assessment_folder,
    episodes_folder,
    feedback_options,
)
from drake_safety.evaluation.metrics import Estimate, area_under_curve
from drake_safety.evaluation.results import Key
from drake_safety.files.progress import StageProgress, ignore
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.feedback import EpisodePair
from drake_safety.learning.seeds import ADAPTATION
from drake_safety.learning.segments import Episodes, split
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.feedback import run_pairs
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.baselines import DirectClassifier
from studies.harness import ReleaseOption, open_study

SIZES = (40, 80, 120, 160, 400)
"""Numbers of pairs of episodes after which an assessment is evaluated."""
_BOOSTED_SIZES = (40, 160)
_POOL_STRIDE = 10  # Between the first seeds of two pools.
Pool = tuple[Sequence[EpisodePair], Episodes]  # Feedback, and the test set that judges it.


def adaptation(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    feedback: Annotated[
        int, typer.Option(help="Actual episodes, each beside its nominal twin.", min=1)
    ] = 160,
    variation: Annotated[str, typer.Option(help="Variation of the actual plant.")] = "actual",
    evaluate: Annotated[
        int, typer.Option(help="Fresh actual episodes for evaluation.", min=1)
    ] = 600,
    pools: Annotated[
        int, typer.Option(help="Independent pools of feedback and test episodes.", min=1)
    ] = 3,
    boosting: Annotated[
        bool, typer.Option("--boosting", help="Also train boosting on the feedback.")
    ] = False,
    seed: Annotated[
        int, typer.Option(help="First of the seeds of fresh simulations.")
    ] = ADAPTATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Evaluate Γ before and after feedback of a simulated plant, on independent pools.

    Episodes are shared with `drake-safety adapt`; study.json is written to
    ASSESSMENT/adapted-VARIATION.
    """
    learned = assessment_folder(load_scenario(scenario), assessment)
    folder = learned.out / f"adapted-{variation}"
    with open_study(
        "study", scenario, learned.path, seed=seed, release=release, workers=workers, out=folder
    ) as study:
        loaded, stages = study.scenario, study.stages
        seeds = [ADAPTATION.seeds(study.seed + _POOL_STRIDE * i) for i in range(pools)]
        spent = [one for block in seeds for one in block.values()]
        priors = {mode: study.load(mode, spent) for mode in MODES}
        drawn, fresh = [], []
        for block in seeds:
            drawn_seed = block["adaptation"]
            kept = feedback_options(loaded, learned.out, variation, drawn_seed, workers)
            report = partial(stages, "actual episodes and their twins")
            drawn.append(run_pairs(loaded, feedback, seed=drawn_seed, progress=report, **kept))
            fresh_seed = block["evaluation of the adaptation"]
            kept = feedback_options(loaded, learned.out, variation, fresh_seed, workers)
            kept |= {"path": kept["path"] / variation}
            report = partial(stages, "fresh actual episodes")
            fresh.append(run_episodes(loaded, evaluate, seed=fresh_seed, progress=report, **kept))
        sets = [pairs.feedback() for pairs in drawn]
        judged = list(zip(sets, fresh, strict=True))
        for mode, prior in priors.items():
            study.rows |= pool_estimates(prior, judged, progress=stages)
            if mode == MODES[0] and boosting:
                nominal = load_episodes(episodes_folder(learned.path))
                study.rows |= boosting_estimates(nominal, judged, prior.settings.shortest, stages)
        study.entries |= {
            "variation": variation,
            "pools": pools,
            "feedback_sets": [len(one) for one in sets],
            "differing_pairs": [sum(pair.differs for pair in one) for one in sets],
        }


def scores(assessment: SafetyAssessment, test: Episodes) -> dict[str, float]:
    """Metrics of an assessment on every row of fresh actual episodes."""
    segments = split(test, stride=1, discount=1.0, shortest=assessment.settings.shortest)
    result = assessment.predict_rows(segments, test.info.variation)
    is_paper = assessment.settings.is_paper
    safe = safe_share(result.belief) if is_paper else result.probability
    return _metrics(1.0 - safe, segments.is_unsafe)


def _metrics(unsafe: np.ndarray, label: np.ndarray) -> dict[str, float]:
    def share(is_right: np.ndarray, rows: np.ndarray) -> float:
        return float(is_right[rows].mean()) if rows.any() else math.nan

    return {
        "brier": float(np.mean((unsafe - label) ** 2)),
        "auc": area_under_curve(unsafe, label)(np.ones(len(label))),
        "unsafe_recall": share(unsafe > 0.5, label),
        "safe_recall": share(unsafe <= 0.5, ~label),
    }


def pool_estimates(
    assessment: SafetyAssessment,
    pools: Sequence[Pool],
    *,
    sizes: Sequence[int] = SIZES,
    progress: StageProgress = ignore,
) -> dict[Key, Estimate]:
    """Evaluates an assessment before and after feedback, on independent pools.

    Orders of one pool would vary less than other feedback of the same robot does.

    Returns:
        By "FORM.ASSESSMENT.METRIC", where ASSESSMENT is "prior" or "adapted N", the mean over
        pools, with minimum and maximum as interval. FORM is the probability of the sharpened mode,
        and the safe share of the grid's belief in the paper's.
    """
    least = min(len(feedback) for feedback, _ in pools)
    sizes = [size for size in sizes if size <= least]
    if not sizes:
        raise ValueError(f"adaptation study: there are only {least} pairs of episodes")
    found: dict[str, list[dict[str, float]]] = {}
    mode = assessment.parameters.mode
    for i, (feedback, test) in enumerate(pools):
        found.setdefault("prior", []).append(scores(assessment, test))
        for k, size in enumerate(sizes):
            adapted = assessment.adapt(feedback[:size])
            found.setdefault(f"adapted {size}", []).append(scores(adapted, test))
            done = i * len(sizes) + k + 1
            progress(f"{mode}: pools of feedback", done, len(pools) * len(sizes))
    form = "grid" if assessment.settings.is_paper else "calibrated"
    return _over_pools(f"{mode}.{form}", found, pools)


def _over_pools(
    set_: str, found: Mapping[str, list[dict[str, float]]], pools: Sequence[Pool]
) -> dict[Key, Estimate]:
    num_test = sum(len(test) for _, test in pools)
    return {
        (set_, who, metric): Estimate(float(np.mean(values)), min(values), max(values), num_test)
        for who, of_pools in found.items()
        for metric in of_pools[0]
        if (values := [one[metric] for one in of_pools])
    }


def boosting_estimates(
    nominal: Episodes, pools: Sequence[Pool], shortest: int, progress: StageProgress
) -> dict[Key, Estimate]:
    """Gradient boosting before feedback ("prior"), and on it and the training ("refitted N")."""
    least = min(len(feedback) for feedback, _ in pools)
    sizes = [size for size in _BOOSTED_SIZES if size <= least]
    prior = DirectClassifier("gradient_boosting").fit(nominal)
    found: dict[str, list[dict[str, float]]] = {}
    for i, (feedback, test) in enumerate(pools):
        progress("gradient boosting on feedback", i, len(pools))
        judged = {"prior": prior}
        for size in sizes:
            every = [*nominal, *(pair.actual for pair in feedback[:size])]
            together = [replace(episode, index=k) for k, episode in enumerate(every)]
            classifier = DirectClassifier("gradient_boosting")
            judged[f"refitted {size}"] = classifier.fit(Episodes(nominal.info, together))
        segments = split(test, stride=1, discount=1.0, shortest=shortest)
        for who, one in judged.items():
            rows = segments.state, segments.desired_preview, segments.features
            unsafe = one.predict_unsafe(*rows)
            found.setdefault(who, []).append(_metrics(unsafe, segments.is_unsafe))
    return _over_pools("boosting", found, pools)
