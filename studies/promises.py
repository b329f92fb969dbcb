"""``python -m studies promises``: promised miss rates, checked on split halves."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption, console
from drake_safety.cli.training_folder import MODES
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
from studies.harness import EpisodesOption, ReleaseOption, open_study

MISS_RATES = (0.01, 0.05, 0.1)
"""Promised miss rates."""


def promises(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: EpisodesOption = 1000,
    splits: Annotated[int, typer.Option(help="Number of splits.", min=1)] = 200,
    confidence: Annotated[float | None, typer.Option(help="Confidence of the promise.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = CALIBRATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Check promised miss rates: calibrated on one half of the episodes, tested on the other.

    Writes ASSESSMENT/promises.json.
    """
    with open_study(
        "promises", scenario, assessment, seed=seed, release=release, workers=workers
    ) as study:
        scorer = assessment_scorer(MODES[0], study.load(MODES[0], []))
        segments = split(study.fresh(episodes), stride=1, discount=1.0, shortest=1)
        score = scorer.unsafe_score(segments)
        seed = study.seed
        options: dict[str, Any] = {"confidence": confidence, "num_splits": splits, "seed": seed}
        study.entries |= {"splits": splits, "confidence": confidence}
        for kind in KINDS:
            of_episodes = episode_scores(segments, score, kind)
            for miss_rate in MISS_RATES:
                found = repeated_splits(*of_episodes, miss_rate, **options)
                study.add(f"promises.{kind}.miss_rate {miss_rate:g}", found)
                if not found:
                    needed = episodes_needed(miss_rate, confidence=confidence)
                    console.print(
                        f"{kind}, {miss_rate:g}: needs {needed} unsafe episodes in each half; "
                        f"there are {int(of_episodes[1].sum()) // 2}"
                    )


def repeated_splits(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    miss_rate: float,
    *,
    confidence: float | None = None,
    num_splits: int = 200,
    seed: int = 0,
) -> dict[str, Estimate]:
    """Splits episodes in halves, calibrates on one and counts misses in the other.

    The classes are split separately, so that all splits have the same number of unsafe episodes.

    Args:
        unsafe_score: Unsafe score of each episode, (N,); NaN counts as the most unsafe.
        is_unsafe: Whether each ended unsafely, (N,).
        miss_rate: Promised miss rate.
        confidence: Confidence of the promise; None for on average.
        num_splits: Number of splits.
        seed: Seed of the splits, the same for all promises.

    Returns:
        "missed", the mean miss rate with the binomial interval of the number of unsafe episodes;
        "broken", the share of splits above the promise; "safe_recall", its mean with its 5 % and
        95 % quantiles. Nothing if the promise needs more unsafe episodes.
    """
    score = np.where(np.isnan(unsafe_score), math.inf, unsafe_score)
    unsafe, safe = np.flatnonzero(is_unsafe), np.flatnonzero(~is_unsafe)
    half = unsafe.size // 2
    if allowed_misses(half, miss_rate, confidence=confidence) < 0:
        return {}
    rng = np.random.default_rng(seed)
    missed, accepted = np.empty(num_splits), np.empty(num_splits)
    for i in range(num_splits):
        one, other = rng.permutation(unsafe), rng.permutation(safe)
        seen = np.concatenate([one[:half], other[: safe.size // 2]])
        threshold = score_threshold(score[seen], is_unsafe[seen], miss_rate, confidence=confidence)
        missed[i] = np.mean(score[one[half:]] <= threshold)
        accepted[i] = np.mean(score[other[safe.size // 2 :]] <= threshold)
    # Splits of the same episodes are not independent: n is the number of episodes.
    mean = float(missed.mean())
    binomial = proportion(round(mean * unsafe.size), unsafe.size)
    low, high = np.quantile(accepted, [0.05, 0.95])
    return {
        "missed": Estimate(mean, min(binomial.low, mean), max(binomial.high, mean), unsafe.size),
        "broken": Estimate.exact(float(np.mean(missed > miss_rate)), num_splits),
        "safe_recall": Estimate(float(accepted.mean()), float(low), float(high), safe.size),
    }
