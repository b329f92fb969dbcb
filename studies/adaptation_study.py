"""Evaluation of an assessment before and after feedback, beside baselines."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from drake_safety.evaluation.metrics import Estimate, area_under_curve, proportion
from drake_safety.evaluation.scorers import StageProgress
from drake_safety.learning.assessment import Assessments, SafetyAssessment
from drake_safety.learning.feedback import FeedbackSet
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.simulation.rollouts import parallel_map

SIZES = (40, 80, 120, 160, 400)
"""Numbers of feedback sets after which an assessment is evaluated."""
THRESHOLD = 0.5
"""Safety probability below which a segment is classified unsafe."""

PUBLISHED: dict[str, Callable[[Assessments], np.ndarray]] = {
    "calibrated": lambda result: result.calibrated,
    "grid": lambda result: result.normalized,
}
"""Forms of Γ by name: calibrated, and of the grid."""


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
        """1 - Γ of each segment by the grid of an assessment, (N,)."""
        segments = self.segments
        features = segments.features if assessment.uses_features else None
        return (
            1.0 - assessment.predict(segments.state, segments.desired_preview, features).normalized
        )


def scores(assessment: SafetyAssessment, test: TestSet) -> dict[str, dict[str, float]]:
    """Metrics of an assessment on the test set, by form of Γ and metric.

    "k0.…" are those of first rows alone.

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
    found = {}
    for name, published in PUBLISHED.items():
        unsafe = 1.0 - published(result)
        rows = {"": np.ones(len(segments), dtype=bool), "k0.": segments.is_first}
        found[name] = {
            f"{prefix}{metric}": value
            for prefix, chosen in rows.items()
            for metric, value in _metrics(unsafe[chosen], segments.is_unsafe[chosen]).items()
        }
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


@dataclass(kw_only=True)
class AdaptationStudy:
    """Results of the study of one plant.

    Attributes:
        estimates: By dotted key "ASSESSMENT.FORM.METRIC", where ASSESSMENT is "prior", "adapted.N"
            or the name of a baseline; over orders it is the mean, with minimum and maximum as
            interval.
        sizes: The N.
        num_orders: Number of orders of the feedback.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)
    num_orders: int = 1


def study(
    assessment: SafetyAssessment,
    feedback: Sequence[FeedbackSet],
    test: TestSet,
    *,
    sizes: Sequence[int] = SIZES,
    num_orders: int = 5,
    seed: int = 0,
    method: str | None = None,
    baselines: Mapping[str, SafetyAssessment] | None = None,
    progress: StageProgress | None = None,
) -> AdaptationStudy:
    """Evaluates an assessment before and after feedback, in several orders of it.

    Args:
        assessment: The assessment before feedback.
        feedback: All feedback sets, of which each order uses the first N.
        test: Fresh actual episodes.
        sizes: The N; those above the number of sets are left out.
        num_orders: Number of orders.
        seed: Seed of the orders.
        method: Method of adaptation, see `SafetyAssessment.adapt`.
        baselines: Other assessments by name.
        progress: Called with a stage, the number done and the number wanted.

    Raises:
        ValueError: There is less feedback than the smallest N.
    """
    sizes = [size for size in sizes if size <= len(feedback)]
    if not sizes:
        raise ValueError(f"adaptation study: there are only {len(feedback)} feedback sets")
    found: dict[str, list[dict[str, dict[str, float]]]] = {"prior": [scores(assessment, test)]}
    for name, baseline in (baselines or {}).items():
        found[name] = [scores(baseline, test)]
    total = num_orders * len(sizes)
    for order in range(num_orders):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(order,)))
        drawn = [feedback[i] for i in rng.permutation(len(feedback))]
        for i, size in enumerate(sizes):
            adapted = assessment.adapt(drawn[:size], method=method)
            found.setdefault(f"adapted.{size}", []).append(scores(adapted, test))
            if progress is not None:
                stage = f"{assessment.parameters.mode}: orders of feedback"
                progress(stage, order * len(sizes) + i + 1, total)
    estimates = {}
    num_test = len(test.episodes)
    for who, orders in found.items():
        for published in PUBLISHED:
            for metric in orders[0][published]:
                values = [one[published][metric] for one in orders]
                estimates[f"{who}.{published}.{metric}"] = Estimate(
                    float(np.mean(values)), min(values), max(values), num_test
                )
    differing = sum(one.differs for one in feedback)
    estimates["gap"] = proportion(differing, len(feedback))
    for size in sizes:
        # Number of orders in which the adapted assessment is better than the prior.
        prior = found["prior"][0]
        for published in PUBLISHED:
            won = sum(
                one[published]["brier"] < prior[published]["brier"]
                for one in found[f"adapted.{size}"]
            )
            estimates[f"adapted.{size}.{published}.orders_won"] = proportion(won, num_orders)
            if "oracle" in found:
                gap = prior[published]["brier"] - found["oracle"][0][published]["brier"]
                closed = prior[published]["brier"] - np.mean(
                    [one[published]["brier"] for one in found[f"adapted.{size}"]]
                )
                share = float(closed / gap) if gap > 0.0 else math.nan
                estimates[f"adapted.{size}.{published}.gap_closed"] = Estimate.exact(
                    share, num_test
                )
    return AdaptationStudy(estimates=estimates, sizes=list(sizes), num_orders=num_orders)


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
