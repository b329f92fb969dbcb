"""``python -m studies adaptation``: adaptation by feedback, beside training from scratch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
import typer

from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    WorkersOption,
)
from drake_safety.cli.training_folder import (
    MODES,
    assessment_folder,
    episodes_folder,
    feedback_options,
)
from drake_safety.evaluation.metrics import Estimate, area_under_curve, proportion
from drake_safety.evaluation.results import Key
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import Prediction, SafetyAssessment
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.feedback import EpisodePair
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import ADAPTATION
from drake_safety.learning.segments import Episode, Episodes, Segments, split
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.feedback import run_pairs
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.worker_processes import map_items
from studies.baselines import DirectClassifier
from studies.harness import ReleaseOption, open_study

SIZES = (40, 80, 120, 160, 400)
"""Numbers of pairs of episodes after which an assessment is evaluated."""
THRESHOLD = 0.5
"""Γ below which a segment is classified unsafe."""
PUBLISHED: dict[str, Callable[[Prediction], np.ndarray]] = {
    "calibrated": lambda result: result.probability,
    "grid": lambda result: safe_share(result.belief),
}
"""By the key of results: the probability, and the safe share of the grid's belief."""
_SCRATCH_SIZES = (40, 160, 400)
_BOOSTED_SIZES = (40, 160)
_POOL_STRIDE = 10  # Between the first seeds of two pools.


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
    scratch: Annotated[
        bool,
        typer.Option("--scratch", help="Also train from scratch, and boosting, on the feedback."),
    ] = False,
    seed: Annotated[
        int, typer.Option(help="First of the seeds of fresh simulations.")
    ] = ADAPTATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Evaluate Γ before and after feedback of a simulated plant, on independent pools.

    Episodes are shared with `drake-safety adapt`; study.json and its plot are written to
    ASSESSMENT/adapted-VARIATION.
    """
    learned = assessment_folder(load_scenario(scenario), assessment)
    folder = learned.out / f"adapted-{variation}"
    with open_study(
        "study",
        scenario,
        learned.path,
        seed=seed,
        release=release,
        workers=workers,
        out=folder,
        plotted=lambda key: (
            key[0] in ("sharpened.calibrated", "paper.grid")
            and key[2] in ("brier", "auc", "unsafe_recall")
        ),
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
        sizes = [size for size in _SCRATCH_SIZES if scratch and size <= feedback]
        learned_from = {f"scratch {size}": drawn[0].actual[:size] for size in sizes}
        for mode, prior in priors.items():
            baselines = train_baselines(prior, learned_from, num_workers=workers, progress=stages)
            judged = [
                Pool(feedback=one, test=TestSet.of(episodes, prior.settings.shortest))
                for one, episodes in zip(sets, fresh, strict=True)
            ]
            study.rows |= pool_estimates(prior, judged, baselines=baselines, progress=stages)
            if mode == MODES[0] and scratch:
                nominal = load_episodes(episodes_folder(learned.path))
                study.rows |= boosting_estimates(nominal, judged, stages)
        study.entries |= {
            "variation": variation,
            "pools": pools,
            "feedback_sets": [len(one) for one in sets],
            "differing_pairs": [sum(pair.differs for pair in one) for one in sets],
        }


@dataclass(frozen=True)
class TestSet:
    """Fresh actual episodes for evaluation, and their segments from every row."""

    __test__ = False  # Not one of pytest's.

    episodes: Episodes
    segments: Segments

    @classmethod
    def of(cls, episodes: Episodes, shortest: int) -> TestSet:
        """Cuts episodes at every row."""
        return cls(episodes, split(episodes, stride=1, discount=1.0, shortest=shortest))


def scores(assessment: SafetyAssessment, test: TestSet) -> dict[str, dict[str, float]]:
    """Metrics of an assessment on the test set, by form of Γ and metric.

    "FORM.k0" uses first rows alone; "unknown" is the share of "don't know".
    """
    segments = test.segments
    result = assessment.predict_rows(segments, test.episodes.info.variation)
    unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
    found = {}
    for name, published in PUBLISHED.items():
        unsafe, label = 1.0 - published(result), segments.is_unsafe
        found[name] = _metrics(unsafe, label) | {"unknown": float(unknown.mean())}
        found[f"{name}.k0"] = _metrics(unsafe[segments.is_first], label[segments.is_first])
    return found


def _metrics(unsafe: np.ndarray, label: np.ndarray) -> dict[str, float]:
    def share(is_right: np.ndarray, rows: np.ndarray) -> float:
        return float(is_right[rows].mean()) if rows.any() else math.nan

    return {
        "brier": float(np.mean((unsafe - label) ** 2)),
        "auc": area_under_curve(unsafe, label),
        "unsafe_recall": share(unsafe > 1.0 - THRESHOLD, label),
        "safe_recall": share(unsafe <= 1.0 - THRESHOLD, ~label),
    }


@dataclass(frozen=True, kw_only=True)
class Pool:
    """Feedback and the test set on which it is judged, with seeds of their own."""

    feedback: Sequence[EpisodePair]
    test: TestSet


def pool_estimates(
    assessment: SafetyAssessment,
    pools: Sequence[Pool],
    *,
    sizes: Sequence[int] = SIZES,
    baselines: Mapping[str, SafetyAssessment] | None = None,
    progress: StageProgress | None = None,
) -> dict[Key, Estimate]:
    """Evaluates an assessment before and after feedback, on independent pools.

    Orders of one pool would vary less than other feedback of the same robot does.

    Returns:
        By "FORM.ASSESSMENT.METRIC", where ASSESSMENT is "prior", "adapted N" or the name of a
        baseline, the mean over pools, with minimum and maximum as interval. "gap" is the share of
        pairs that differ, `pools_won` that of pools in which the Brier score is better than the
        prior's.
    """
    least = min(len(pool.feedback) for pool in pools)
    sizes = [size for size in sizes if size <= least]
    if not sizes:
        raise ValueError(f"adaptation study: there are only {least} pairs of episodes")
    found: dict[str, list[dict[str, dict[str, float]]]] = {}
    stage = f"{assessment.parameters.mode}: pools of feedback"
    for i, pool in enumerate(pools):
        for name, one in {"prior": assessment, **(baselines or {})}.items():
            found.setdefault(name, []).append(scores(one, pool.test))
        for k, size in enumerate(sizes):
            adapted = assessment.adapt(pool.feedback[:size])
            found.setdefault(f"adapted {size}", []).append(scores(adapted, pool.test))
            if progress is not None:
                progress(stage, i * len(sizes) + k + 1, len(pools) * len(sizes))
    num_test = sum(len(pool.test.episodes) for pool in pools)
    everything = [one for pool in pools for one in pool.feedback]
    gap = proportion(sum(one.differs for one in everything), len(everything))
    mode = assessment.parameters.mode
    estimates: dict[Key, Estimate] = {(mode, "", "gap"): gap}
    for form in found["prior"][0]:
        for who, of_pools in found.items():
            for metric in of_pools[0][form]:
                values = [one[form][metric] for one in of_pools]
                estimates[f"{mode}.{form}", who, metric] = Estimate(
                    float(np.mean(values)), min(values), max(values), num_test
                )
        brier = {who: np.array([p[form]["brier"] for p in ps]) for who, ps in found.items()}
        before = brier["prior"]
        for who in (f"adapted {size}" for size in sizes):
            won = proportion(int(np.sum(brier[who] < before)), len(pools))
            estimates[f"{mode}.{form}", who, "pools_won"] = won
    return estimates


def boosting_estimates(
    nominal: Episodes,
    pools: Sequence[Pool],
    progress: StageProgress,
    sizes: Sequence[int] = _BOOSTED_SIZES,
) -> dict[Key, Estimate]:
    """Gradient boosting before feedback, on the feedback alone, and on it and the training.

    Returns:
        By "WHO.METRIC", where WHO is "prior", "alone N" or "refitted N", the mean over pools, with
        minimum and maximum as interval.
    """
    sizes = [size for size in sizes if size <= min(len(pool.feedback) for pool in pools)]
    prior = DirectClassifier("gradient_boosting").fit(nominal)
    found: dict[str, list[dict[str, float]]] = {}
    for i, pool in enumerate(pools):
        progress("gradient boosting on feedback", i, len(pools))
        judged = {"prior": prior}
        for size in sizes:
            actual = [pair.actual for pair in pool.feedback[:size]]
            for who, before in {"alone": [], "refitted": list(nominal)}.items():
                together = Episodes(nominal.info, _renumbered([*before, *actual]))
                judged[f"{who} {size}"] = DirectClassifier("gradient_boosting").fit(together)
        segments = pool.test.segments
        for who, one in judged.items():
            rows = segments.state, segments.desired_preview, segments.features
            unsafe = one.predict_unsafe(*rows)
            found.setdefault(who, []).append(_metrics(unsafe, segments.is_unsafe))
    num_test = sum(len(pool.test.episodes) for pool in pools)
    return {
        ("boosting", who, metric): Estimate(
            float(np.mean(values)), float(min(values)), float(max(values)), num_test
        )
        for who, of_pools in found.items()
        for metric in of_pools[0]
        if (values := [one[metric] for one in of_pools])
    }


def _renumbered(episodes: Sequence[Episode]) -> list[Episode]:
    return [replace(episode, index=i) for i, episode in enumerate(episodes)]


def train_baselines(
    assessment: SafetyAssessment,
    episodes: Mapping[str, Episodes],
    *,
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> dict[str, SafetyAssessment]:
    """Trains assessments from scratch on actual episodes, with the parameters of the prior.

    Those with too few episodes for t-SNE are left out.
    """
    # The largest first, so that no worker is left with it at the end.
    wanted = sorted(episodes.items(), key=lambda item: -len(item[1]))
    learned = dict(
        map_items(
            partial(_learned, assessment.parameters),
            wanted,
            num_workers=num_workers,
            batch_size=1,
            progress=None if progress is None else partial(progress, "learning from scratch"),
        )
    )
    return {name: one for name in episodes if (one := learned[name]) is not None}


def _learned(
    parameters: AssessmentParameters, item: tuple[str, Episodes]
) -> tuple[str, SafetyAssessment | None]:
    name, episodes = item
    try:
        return name, SafetyAssessment(parameters).fit(episodes)
    except ValueError:
        return name, None
