"""What feedback is worth: an assessment before and after it, beside those it competes with."""

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
"""Feedback sets after which an assessment is judged."""
METRICS = ("brier", "auc", "unsafe_recall", "safe_recall")
THRESHOLD = 0.5
"""Safety probability below which a segment counts as judged unsafe."""

PUBLISHED: dict[str, Callable[[Assessments], np.ndarray]] = {
    "calibrated": lambda result: result.calibrated,
    "grid": lambda result: result.normalized,
}
"""What an assessment publishes, by name: by its heads, and by its grid."""


@dataclass(frozen=True, kw_only=True)
class TestSet:
    """Fresh actual episodes that all are judged by.

    Attributes:
        episodes: The episodes.
        segments: Every start row of theirs.
    """

    __test__ = False  # Not one of pytest's.

    episodes: Episodes
    segments: Segments

    @classmethod
    def of(cls, episodes: Episodes, shortest: int) -> TestSet:
        """Cuts episodes at every row.

        Args:
            episodes: The episodes.
            shortest: Steps that a safe episode's segment has at least.
        """
        return cls(
            episodes=episodes, segments=split(episodes, stride=1, discount=1.0, shortest=shortest)
        )


def scores(assessment: SafetyAssessment, test: TestSet) -> dict[str, dict[str, float]]:
    """How well an assessment judges the test set, by what it publishes and by metric.

    "k0.…" is of the episodes' first rows alone.

    Args:
        assessment: Who is judged.
        test: By what.
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
    """What was found of one gap.

    Attributes:
        estimates: By dotted key "WHO.PUBLISHED.METRIC", where WHO is "prior", "adapted.N" or a
            rival's name; of several orders it is the mean, and the interval their least and
            largest.
        sizes: The N.
        num_orders: In how many orders the feedback came.
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
    rivals: Mapping[str, SafetyAssessment] | None = None,
    progress: StageProgress | None = None,
) -> AdaptationStudy:
    """Judges an assessment before and after feedback, in several orders of it.

    Args:
        assessment: The prior.
        feedback: All feedback sets; of each order the first N are given.
        test: Fresh actual episodes.
        sizes: The N; those beyond what there is are left out.
        num_orders: How many orders.
        seed: Of the orders.
        method: How it adapts; see `SafetyAssessment.adapt`.
        rivals: Other assessments by the name they have in the figures.
        progress: Called with a stage, the number done and the number wanted.

    Raises:
        ValueError: There is less feedback than the smallest N.
    """
    sizes = [size for size in sizes if size <= len(feedback)]
    if not sizes:
        raise ValueError(f"adaptation study: there are only {len(feedback)} feedback sets")
    found: dict[str, list[dict[str, dict[str, float]]]] = {"prior": [scores(assessment, test)]}
    for name, rival in (rivals or {}).items():
        found[name] = [scores(rival, test)]
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
        # In how many orders the adapted one is better than the prior.
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


def trained_rivals(
    assessment: SafetyAssessment,
    episodes: Mapping[str, Episodes],
    *,
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> dict[str, SafetyAssessment]:
    """Assessments trained from scratch on actual episodes, with the prior's own parameters.

    Too few episodes for t-SNE give none.

    Args:
        assessment: The prior.
        episodes: What each learns from, by its name.
        num_workers: Processes.
        progress: Called with a stage, the number done and the number wanted.
    """
    rivals: dict[str, SafetyAssessment] = {}
    # The largest first: nobody waits for it at the end.
    wanted = sorted(episodes.items(), key=lambda item: -len(item[1]))
    arguments = [(name, assessment, one) for name, one in wanted]
    for done, (name, rival) in enumerate(parallel_map(_learned, arguments, num_workers)):
        if rival is not None:
            rivals[name] = rival
        if progress is not None:
            progress("learning from scratch", done + 1, len(arguments))
    return {name: rivals[name] for name in episodes if name in rivals}


def _learned(
    name: str, assessment: SafetyAssessment, episodes: Episodes
) -> tuple[str, SafetyAssessment | None]:
    parameters = copy.deepcopy(assessment.parameters)
    try:
        return name, SafetyAssessment(parameters).fit(episodes)
    except ValueError:
        return name, None
