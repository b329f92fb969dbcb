"""``python -m studies promises``: promised miss rates, checked on split halves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import typer

from drake_safety.cli.console import (
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
    console,
    interval,
    new_table,
    open_stages,
)
from drake_safety.cli.training_folder import MODES, load_assessment, run_fresh_episodes
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.calibration import (
    KINDS,
    allowed_misses,
    episode_scores,
    episodes_needed,
    score_threshold,
)
from drake_safety.learning.seeds import CALIBRATION
from drake_safety.learning.segments import split
from drake_safety.simulation.scenario import load_scenario

MISS_RATES = (0.01, 0.05, 0.1)
"""Promised miss rates."""


@dataclass(frozen=True, kw_only=True)
class PromiseKept:
    """A promised miss rate and the rates observed over many splits of the same episodes.

    Attributes:
        miss_rate: Promised miss rate.
        num_needed: Number of unsafe episodes that the promise needs.
        num_calibration: Number of unsafe calibration episodes of each split.
        observed: Mean observed miss rate, with the binomial interval of the total number of unsafe
            episodes; NaN with too few of them.
        share_broken: Share of splits whose test half exceeds the promised miss rate.
        safe_recall: Mean safe recall, with its 5 % and 95 % quantiles over the splits.
    """

    miss_rate: float
    num_needed: int
    num_calibration: int
    observed: Estimate
    share_broken: float
    safe_recall: Estimate


def repeated_splits(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    *,
    miss_rates: Sequence[float] = MISS_RATES,
    confidence: float | None = None,
    num_splits: int = 200,
    seed: int = 0,
) -> list[PromiseKept]:
    """Splits episodes in halves, calibrates on one and counts misses in the other.

    The classes are split separately, so that all splits have the same number of unsafe episodes.

    Args:
        unsafe_score: Unsafe score of each episode, (N,); NaN counts as the most unsafe.
        is_unsafe: Whether each ended unsafely, (N,).
        miss_rates: Promised miss rates.
        confidence: Confidence of the promise; None for on average.
        num_splits: Number of splits.
        seed: Seed of the splits.
    """
    score = np.where(np.isnan(unsafe_score), math.inf, unsafe_score)
    unsafe, safe = np.flatnonzero(is_unsafe), np.flatnonzero(~is_unsafe)
    num_calibration = unsafe.size // 2
    kept = []
    for miss_rate in miss_rates:
        # All promises use the same splits.
        rng = np.random.default_rng(seed)
        is_possible = allowed_misses(num_calibration, miss_rate, confidence=confidence) >= 0
        missed, accepted = [], []
        for _ in range(num_splits if is_possible else 0):
            one, other = rng.permutation(unsafe), rng.permutation(safe)
            seen = np.concatenate([one[:num_calibration], other[: safe.size // 2]])
            threshold = score_threshold(
                score[seen], is_unsafe[seen], miss_rate, confidence=confidence
            )
            missed.append(np.mean(score[one[num_calibration:]] <= threshold))
            accepted.append(np.mean(score[other[safe.size // 2 :]] <= threshold))
        kept.append(
            PromiseKept(
                miss_rate=miss_rate,
                num_needed=episodes_needed(miss_rate, confidence=confidence),
                num_calibration=num_calibration,
                observed=_observed(missed, unsafe.size),
                share_broken=float(np.mean(np.array(missed) > miss_rate)) if missed else math.nan,
                safe_recall=_spread(accepted, safe.size),
            )
        )
    return kept


def _observed(missed: list[float], num_unsafe: int) -> Estimate:
    if not missed:
        return Estimate.exact(math.nan, 0)
    mean = float(np.mean(missed))
    # Splits of the same episodes are not independent: n is the number of episodes.
    binomial = proportion(round(mean * num_unsafe), num_unsafe)
    return Estimate(mean, min(binomial.low, mean), max(binomial.high, mean), num_unsafe)


def _spread(values: list[float], n: int) -> Estimate:
    if not values:
        return Estimate.exact(math.nan, 0)
    low, high = np.quantile(values, [0.05, 0.95])
    return Estimate(float(np.mean(values)), float(low), float(high), n)


def promises(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: Annotated[int, typer.Option(help="Fresh episodes.", min=4)] = 1000,
    splits: Annotated[int, typer.Option(help="Number of splits.", min=1)] = 200,
    confidence: Annotated[float | None, typer.Option(help="Confidence of the promise.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = CALIBRATION.first,
    workers: WorkersOption = None,
) -> None:
    """Check promised miss rates: calibrated on one half of the episodes, tested on the other."""
    loaded, gamma = load_scenario(scenario), load_assessment(assessment, MODES[0])
    with open_stages() as stages:
        progress = partial(stages, "calibration episodes")
        fresh = run_fresh_episodes(loaded, assessment, episodes, seed, progress, workers)
    segments = split(fresh, stride=1, discount=1.0, shortest=1)
    score = assessment_scorer(MODES[0], gamma).unsafe_score(segments)
    for kind in KINDS:
        table = new_table(
            "promised miss rate [%]",
            "observed [%]",
            "splits above it [%]",
            "safe recall [%]",
            title=f"{MODES[0]}, {kind}: {splits} splits",
        )
        for one in repeated_splits(
            *episode_scores(segments, score, kind),
            confidence=confidence,
            num_splits=splits,
            seed=seed,
        ):
            promised = f"{100 * one.miss_rate:g}"
            if one.observed.n == 0:
                missing = f"needs {one.num_needed} unsafe episodes in each half; there are "
                table.add_row(promised, f"{missing}{one.num_calibration}", "-", "-")
                continue
            table.add_row(
                promised,
                interval(one.observed, 100, 2),
                f"{100 * one.share_broken:.0f}",
                interval(one.safe_recall, 100, 1),
            )
        console.print(table)
