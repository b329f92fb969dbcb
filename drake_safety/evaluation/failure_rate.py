"""The failure rate of a closed loop by fewer simulations, as Γ says where they tell most."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.outcomes import UNSAFE, Metric, Outcome, Outcomes, first_inputs
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import RATE
from drake_safety.learning.segments import Episode
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.rollouts import (
    collect_episodes,
    episodes_info,
    run_episode,
    worker_loop,
)
from drake_safety.simulation.scenario import Scenario

_NUM_STRATA = 10
_EVEN = 0.5  # Share of the simulations that do not depend on Γ, in case that it is wrong.
_NORMAL = 1.96  # Of a 95 % interval.


@dataclass(frozen=True)
class Stratum:
    """Starts for which Γ's probability of a failure is similar.

    Attributes:
        low, high: Ends of that probability.
        starts: Number of starts.
        rollouts, failures: Number of them that were simulated, and of failures.
    """

    low: float
    high: float
    starts: int
    rollouts: int
    failures: float


@dataclass(frozen=True, kw_only=True)
class FailureRate:
    """An estimated failure rate.

    Attributes:
        rate: With its 95 % interval, of n rollouts.
        plain_rollouts: Number of random episodes whose share of failures has the same variance.
        strata: By increasing probability of a failure.
        failures: The episodes that failed, by time.
    """

    rate: Estimate
    plain_rollouts: float
    strata: list[Stratum]
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
    if_stopped: Callable[[FailureRate], object] = lambda known: None,
) -> FailureRate:
    """Estimates how often a closed loop fails, from few simulations of many starts.

    Γ of each start, in its first undisturbed row, divides them into strata, and equally many starts
    of each are simulated. The share of failures, weighted by that of the starts, is unbiased
    however wrong Γ is: a poor Γ only makes the interval wide.

    Args:
        metric: What counts as a failure.
        num_starts: Number of starts of which Γ is asked.
        num_rollouts: Number of them that are simulated.
        path: Folder in which starts and episodes are kept and continued.
        progress: Called with the name of a stage, the number done and the number wanted.
        if_stopped: Called after Ctrl-C with what is known, if there is a folder.

    Raises:
        ValueError: There is no such metric, or there are fewer rollouts than ten strata, or fewer
            starts than rollouts.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    if not _NUM_STRATA <= num_rollouts <= num_starts:
        raise ValueError(
            f"estimate_failure_rate: num_rollouts must be in {_NUM_STRATA}..num_starts, "
            f"{num_starts}; got {num_rollouts}"
        )
    options = scenario.options_for("pairs", variation)
    make = worker_loop(scenario, variation, **options)
    outcomes = Outcomes(make(), metric, assessment)

    def collected(stage: str, indices: Sequence[int], **simulated: Any) -> Iterable[Episode]:
        info = episodes_info(make(), seed, options | simulated)
        folder = None if path is None else Path(path) / f"{info.scenario_hash[:12]}-{seed}"
        try:
            return collect_episodes(
                info,
                indices,
                make,
                partial(run_episode, seed=seed, **simulated),
                num_workers=num_workers,
                path=folder,
                progress=None if progress is None else partial(progress, stage),
            )
        except KeyboardInterrupt:
            kept = {} if folder is None else {one.index: one for one in load_episodes(folder)}
            # Of several workers an episode that fails is done sooner than an earlier one.
            finished = [kept[index] for index in itertools.takewhile(kept.__contains__, indices)]
            if not simulated.get("until_first_row") and len(finished) >= _NUM_STRATA:
                if_stopped(estimate(finished))
            raise

    def estimate(episodes: Iterable[Episode]) -> FailureRate:
        return _estimate(score, stratum, [outcomes.of(one) for one in episodes])

    starts = collected("starts", range(num_starts), until_first_row=True)
    score = 1.0 - assessment.predict(*first_inputs(starts)).probability
    stratum = strata_of(score, np.random.default_rng(seed))
    order = in_turns(stratum)[:num_rollouts]
    return estimate(collected("episodes", order, **outcomes.simulated))


def strata_of(score: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The stratum of each start, (N,) from 0, at most ten, from Γ's failure probabilities, (N,).

    If equally many of each stratum are simulated, a start is with a probability in proportion to
    the standard deviation of its outcome, as Γ has it (Neyman's allocation); but for half of the
    simulations, which are spread evenly: a wrong Γ at most doubles the variance of plain sampling.
    """
    # Equal scores in random order, so that the order of the starts says nothing within a stratum.
    mixed = rng.permutation(len(score))
    order = mixed[np.argsort(score[mixed], kind="stable")]
    spread = np.sqrt(score * (1.0 - score))[order]
    weight = (1.0 - _EVEN) * spread / max(spread.mean(), 1e-12) + _EVEN
    found = np.empty(len(score), dtype=int)
    found[order] = _NUM_STRATA * (np.cumsum(weight) - 0.5 * weight) / weight.sum()
    return np.unique(found, return_inverse=True)[1]  # None is empty.


def in_turns(stratum: np.ndarray) -> list[int]:
    """Starts in the order in which they are simulated, one of each stratum (N,) after the other."""
    members = [np.flatnonzero(stratum == k).tolist() for k in range(stratum.max() + 1)]
    turns = itertools.chain(*itertools.zip_longest(*members))
    return [index for index in turns if index is not None]


def _estimate(score: np.ndarray, stratum: np.ndarray, outcomes: Sequence[Outcome]) -> FailureRate:
    """The estimate from the outcomes of some starts."""
    strata, means = [], []
    for k in range(stratum.max() + 1):
        inside, own = score[stratum == k], [one for one in outcomes if stratum[one.episode] == k]
        ends = float(inside.min()), float(inside.max())
        strata.append(Stratum(*ends, len(inside), len(own), sum(one.value for one in own)))
        means.append(float(inside.mean()))
    starts, rollouts, failures = (
        np.array([getattr(one, name) for one in strata])
        for name in ("starts", "rollouts", "failures")
    )
    rate = stratified_rate(starts, rollouts, failures)
    # With one more simulation that ends as Γ says, as a stratum without failures has no variance.
    likely = (failures + np.array(means)) / (rollouts + 1)
    share = starts / starts.sum()
    variance = share**2 @ (likely * (1.0 - likely) / rollouts)
    variance += share @ (likely - rate.value) ** 2 / starts.sum()
    return FailureRate(
        rate=rate,
        plain_rollouts=float(share @ likely * (1.0 - share @ likely) / variance),
        strata=strata,
        failures=sorted((one for one in outcomes if one.value), key=lambda one: one.time_s),
    )


def stratified_rate(starts: np.ndarray, rollouts: np.ndarray, failures: np.ndarray) -> Estimate:
    """The failure rate of all starts, from numbers of starts, rollouts and failures by stratum.

    The 95 % interval joins (Zou and Donner, Statistics in Medicine 2008) that of the failures in
    strata where these are rare, that of the others' successes (both by Fay and Feuer, Statistics in
    Medicine 1997), and the uncertainty of the strata's shares.
    """
    share = starts / starts.sum()
    value = float(share @ (failures / rollouts))
    is_rare = 2 * failures < rollouts
    weight, rare = share / rollouts, np.where(is_rare, failures, rollouts - failures)
    few, many = (
        _weighted_count(weight[one], rare[one], rollouts[one]) for one in (is_rare, ~is_rare)
    )
    shares = _NORMAL * math.sqrt(share @ (failures / rollouts - value) ** 2 / starts.sum())
    below = math.hypot(few.value - few.low, many.high - many.value, shares)
    above = math.hypot(few.high - few.value, many.value - many.low, shares)
    return Estimate(value, max(value - below, 0.0), min(value + above, 1.0), int(rollouts.sum()))


def _weighted_count(weight: np.ndarray, counts: np.ndarray, sizes: np.ndarray) -> Estimate:
    """A weighted sum of binomial counts, with a 95 % interval by the gamma distribution."""
    from scipy.stats import gamma

    value, variance = float(weight @ counts), float(weight**2 @ (counts * (1.0 - counts / sizes)))
    most = float(weight.max(initial=0.0))
    low = gamma.ppf(0.025, value**2 / variance, scale=variance / value) if variance else 0.0
    mean, spread = value + most, variance + most**2
    high = gamma.ppf(0.975, mean**2 / spread, scale=spread / mean) if mean else 0.0
    return Estimate(value, float(low), float(high), int(sizes.sum()))
