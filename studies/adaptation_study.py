"""Evaluation of an assessment before and after feedback, beside baselines."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from drake_safety.evaluation.metrics import Estimate, area_under_curve, proportion
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import Assessments, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.feedback import FeedbackSet
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.simulation.worker_processes import parallel_map

SIZES = (40, 80, 120, 160, 400)
"""Numbers of feedback sets after which an assessment is evaluated."""
THRESHOLD = 0.5
"""Γ below which a segment is classified unsafe."""

PUBLISHED: dict[str, Callable[[Assessments], np.ndarray]] = {
    "calibrated": lambda result: result.probability,
    "grid": lambda result: safe_share(result.belief),
}
"""By the key of stored results: the probability, and the safe share of the grid's belief."""


@dataclass(frozen=True, kw_only=True)
class TestSet:
    """Fresh actual episodes for evaluation.

    Attributes:
        episodes: The episodes.
        segments: Their segments from every row.
    """

    __test__ = False  # Not one of pytest's.

    episodes: Episodes
    segments: Segments

    @classmethod
    def of(cls, episodes: Episodes, shortest: int) -> TestSet:
        """Cuts episodes at every row.

        Args:
            episodes: The episodes.
            shortest: Minimum length of a segment of a safe episode [steps].
        """
        return cls(
            episodes=episodes, segments=split(episodes, stride=1, discount=1.0, shortest=shortest)
        )

    def unsafe_score(self, assessment: SafetyAssessment) -> np.ndarray:
        """1 - the safe share of each segment's belief, (N,)."""
        segments = self.segments
        features = segments.features if assessment.uses_features else None
        found = assessment.predict(segments.state, segments.desired_preview, features)
        return 1.0 - safe_share(found.belief)


def scores(assessment: SafetyAssessment, test: TestSet) -> dict[str, dict[str, float]]:
    """Metrics of an assessment on the test set, by form of Γ and metric.

    "k0.…" are those of first rows alone; "unknown" is the share of "don't know".

    Args:
        assessment: The assessment.
        test: The test set.
    """
    segments = test.segments
    is_plain = not assessment.parameters.is_sharpened and test.episodes.info.variation == "nominal"
    result = assessment.predict(
        segments.true_state if is_plain else segments.state,
        segments.desired_preview,
        segments.features if assessment.uses_features else None,
    )
    unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
    found = {}
    for name, published in PUBLISHED.items():
        unsafe = 1.0 - published(result)
        rows = {"": np.ones(len(segments), dtype=bool), "k0.": segments.is_first}
        found[name] = {
            f"{prefix}{metric}": value
            for prefix, chosen in rows.items()
            for metric, value in _metrics(unsafe[chosen], segments.is_unsafe[chosen]).items()
        }
        found[name]["unknown"] = float(unknown.mean())
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
    """Feedback and the test set on which it is judged, with seeds of their own.

    Attributes:
        feedback: Feedback sets.
        test: Fresh actual episodes.
    """

    feedback: Sequence[FeedbackSet]
    test: TestSet


@dataclass(kw_only=True)
class AdaptationStudy:
    """Results of the study of one plant.

    Attributes:
        estimates: By dotted key "ASSESSMENT.FORM.METRIC", where ASSESSMENT is "prior", "adapted.N"
            or the name of a baseline; the mean over pools, with minimum and maximum as interval.
        sizes: The N.
        num_pools: Number of pools.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)
    num_pools: int = 1


def study(
    assessment: SafetyAssessment,
    pools: Sequence[Pool],
    *,
    sizes: Sequence[int] = SIZES,
    method: str | None = None,
    baselines: Mapping[str, SafetyAssessment] | None = None,
    progress: StageProgress | None = None,
) -> AdaptationStudy:
    """Evaluates an assessment before and after feedback, on independent pools.

    Orders of one pool would vary less than other feedback of the same robot does.

    Args:
        assessment: The assessment before feedback.
        pools: Feedback, of which the first N sets are used, each with a test set.
        sizes: The N; those above the number of sets are left out.
        method: Method of adaptation, see `SafetyAssessment.adapt`.
        baselines: Other assessments by name.
        progress: Called with a stage, the number done and the number wanted.

    Raises:
        ValueError: There is less feedback than the smallest N.
    """
    least = min(len(pool.feedback) for pool in pools)
    sizes = [size for size in sizes if size <= least]
    if not sizes:
        raise ValueError(f"adaptation study: there are only {least} feedback sets")
    found: dict[str, list[dict[str, dict[str, float]]]] = {}
    stage = f"{assessment.parameters.mode}: pools of feedback"
    for i, pool in enumerate(pools):
        found.setdefault("prior", []).append(scores(assessment, pool.test))
        for name, baseline in (baselines or {}).items():
            found.setdefault(name, []).append(scores(baseline, pool.test))
        for k, size in enumerate(sizes):
            adapted = assessment.adapt(pool.feedback[:size], method=method)
            found.setdefault(f"adapted.{size}", []).append(scores(adapted, pool.test))
            if progress is not None:
                progress(stage, i * len(sizes) + k + 1, len(pools) * len(sizes))
    estimates = {}
    num_test = sum(len(pool.test.episodes) for pool in pools)
    for who, of_pools in found.items():
        for published in PUBLISHED:
            for metric in of_pools[0][published]:
                values = [one[published][metric] for one in of_pools]
                estimates[f"{who}.{published}.{metric}"] = Estimate(
                    float(np.mean(values)), min(values), max(values), num_test
                )
    everything = [one for pool in pools for one in pool.feedback]
    estimates["gap"] = proportion(sum(one.differs for one in everything), len(everything))
    for size in sizes:
        for published in PUBLISHED:
            before, after, oracle = (
                np.array([one[published]["brier"] for one in found.get(who, [])])
                for who in ("prior", f"adapted.{size}", "oracle")
            )
            key = f"adapted.{size}.{published}"
            # Number of pools in which the adapted assessment is better than the prior.
            won = int(np.sum(after < before))
            estimates[f"{key}.pools_won"] = proportion(won, len(pools))
            if len(oracle):
                gap = np.mean(before) - np.mean(oracle)
                share = float(np.mean(before - after) / gap) if gap > 0.0 else math.nan
                estimates[f"{key}.gap_closed"] = Estimate.exact(share, num_test)
    return AdaptationStudy(estimates=estimates, sizes=list(sizes), num_pools=len(pools))


def train_baselines(
    assessment: SafetyAssessment,
    episodes: Mapping[str, Episodes],
    *,
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> dict[str, SafetyAssessment]:
    """Trains assessments from scratch on actual episodes, with the parameters of the prior.

    Those with too few episodes for t-SNE are left out.

    Args:
        assessment: The assessment before feedback.
        episodes: Training episodes by name.
        num_workers: Number of worker processes.
        progress: Called with a stage, the number done and the number wanted.
    """
    baselines: dict[str, SafetyAssessment] = {}
    # The largest first, so that no worker is left with it at the end.
    wanted = sorted(episodes.items(), key=lambda item: -len(item[1]))
    arguments = [(name, assessment, one) for name, one in wanted]
    for done, (name, baseline) in enumerate(parallel_map(_learned, arguments, num_workers)):
        if baseline is not None:
            baselines[name] = baseline
        if progress is not None:
            progress("learning from scratch", done + 1, len(arguments))
    return {name: baselines[name] for name in episodes if name in baselines}


def _learned(
    name: str, assessment: SafetyAssessment, episodes: Episodes
) -> tuple[str, SafetyAssessment | None]:
    parameters = copy.deepcopy(assessment.parameters)
    try:
        return name, SafetyAssessment(parameters).fit(episodes)
    except ValueError:
        return name, None
