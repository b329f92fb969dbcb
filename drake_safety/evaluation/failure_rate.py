"""The failure rate of a closed loop by fewer simulations, as Γ says where they tell most."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.outcomes import UNSAFE, Metric, Outcome, OutcomeReader
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import RATE
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.rollouts import (
    collect_episodes,
    episodes_info,
    run_episode,
    worker_loop,
)
from drake_safety.simulation.scenario import Scenario

_NUM_STRATA = 10
_EVEN = 0.5  # Share of the simulations that do not depend on Γ, in case that it is wrong.


@dataclass(frozen=True, kw_only=True)
class FailureRate:
    """An estimated failure rate with its 95 % interval, and the episodes that failed, by time."""

    rate: Estimate
    plain_rollouts: float  # Random episodes whose share of failures has the same variance.
    failures: list[Outcome]


def estimate_failure_rate(
    scenario: Scenario,
    assessment: SafetyAssessment,
    *,
    variation: str = "nominal",
    metric: Metric = UNSAFE,
    num_starts: int = 10_000,
    num_rollouts: int = 500,
    seed: int = RATE.first,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: StageProgress | None = None,
) -> FailureRate:
    """Estimates how often a closed loop fails, from few simulations of many starts.

    Γ of each start, in its first undisturbed row, divides them into strata, and equally many starts
    of each are simulated. The share of failures, weighted by that of the starts, is unbiased
    however wrong Γ is.

    Args:
        metric: As of `compare_loops`.
        num_starts, num_rollouts: Starts of which Γ is asked; and that are simulated.
        path: Folder in which starts and episodes are kept.
    """
    if not _NUM_STRATA <= num_rollouts <= num_starts:
        raise ValueError(f"num_rollouts must be in {_NUM_STRATA}..{num_starts}; got {num_rollouts}")
    options = scenario.options_for("pairs", variation)
    make = worker_loop(scenario, variation, **options)
    reader = OutcomeReader(make(), metric, assessment)

    def collected(stage: str, indices: Sequence[int], **simulated: Any) -> Episodes:
        info = episodes_info(make(), seed, options | simulated)
        run = partial(run_episode, seed=seed, **simulated)
        folder = None if path is None else Path(path) / f"{info.scenario_hash[:12]}-{seed}"
        shown = None if progress is None else partial(progress, stage)
        return collect_episodes(
            info, indices, make, run, num_workers=num_workers, path=folder, progress=shown
        )

    starts = collected("starts", range(num_starts), until_first_row=True)
    inputs = zip(*(one.first_inputs for one in starts), strict=True)
    score = 1.0 - assessment.predict(*map(np.array, inputs)).probability
    stratum = strata_of(score, np.random.default_rng(seed))
    order = in_turns(stratum)[:num_rollouts]
    simulated = collected("episodes", order, **reader.simulated)
    outcomes = [reader.read(one) for one in simulated]
    chosen = stratum[[one.index for one in simulated]]
    failures = np.bincount(chosen, [one.value for one in outcomes])
    rate, plain_rollouts = stratified_rate(np.bincount(stratum), np.bincount(chosen), failures)
    failed = sorted((one for one in outcomes if one.value), key=lambda one: one.time_s)
    return FailureRate(rate=rate, plain_rollouts=plain_rollouts, failures=failed)


def strata_of(score: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The stratum of each start, (N,) from 0, at most ten, from Γ's failure probabilities, (N,).

    Half of the simulations are in proportion to the standard deviation of the outcome, as Γ has it
    (Neyman's allocation), and half evenly: a wrong Γ at most doubles the variance.
    """
    # Equal scores in random order, so that the order of the starts says nothing within a stratum.
    mixed = rng.permutation(len(score))
    order = mixed[np.argsort(score[mixed], kind="stable")]
    spread = np.sqrt(score * (1.0 - score))[order]
    weight = (1.0 - _EVEN) * spread / max(spread.mean(), 1e-12) + _EVEN
    stratum = np.empty(len(score), dtype=int)
    stratum[order] = _NUM_STRATA * (np.cumsum(weight) - 0.5 * weight) / weight.sum()
    return np.unique(stratum, return_inverse=True)[1]  # None is empty.


def in_turns(stratum: np.ndarray) -> list[int]:
    """Starts in the order of simulation, one of each stratum (N,) after the other."""
    order = np.argsort(stratum, kind="stable")
    turn = np.arange(len(order)) - np.searchsorted(stratum[order], stratum[order])
    return [*map(int, order[np.argsort(turn, kind="stable")])]


def stratified_rate(
    starts: np.ndarray, rollouts: np.ndarray, failures: np.ndarray
) -> tuple[Estimate, float]:
    """The failure rate of all starts, from numbers of starts, rollouts and failures by stratum.

    The effective number of random episodes, also returned, has the same variance; its exact 95 %
    interval is that of the estimate (Korn and Graubard, Survey Methodology 1998).
    """
    from scipy.stats import beta

    share = starts / starts.sum()
    value = float(share @ (failures / rollouts))
    # Half a failure and half a success more, as a stratum without one of them has no variance.
    likely = (failures + 0.5) / (rollouts + 1)
    mean = share @ likely
    variance = share**2 @ (likely * (1.0 - likely) / rollouts)
    variance += share @ (likely - mean) ** 2 / starts.sum()  # Variance of the strata's shares.
    number = float(mean * (1.0 - mean) / variance)
    failed, passed = number * value, number * (1.0 - value)
    low = beta.ppf(0.025, failed, passed + 1.0) if failed else 0.0
    high = beta.ppf(0.975, failed + 1.0, passed) if passed else 1.0
    return Estimate(value, float(low), float(high), int(rollouts.sum())), number
