"""Rates of rare failures, by importance sampling around the failures that a search finds."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Diagram

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.outcomes import UNSAFE, OutcomeReader
from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.seeds import RATE
from drake_safety.learning.segments import DIVERGED, Episode
from drake_safety.simulation.normal_space import NormalGenerator, NormalPoint, moved
from drake_safety.simulation.recording import prepare_recording
from drake_safety.simulation.rollouts import episodes_info, run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import CloudPickled, MadeOnce, Progress, map_items

if TYPE_CHECKING:
    from sklearn.mixture import GaussianMixture

_SHARE = 0.1  # Share of a level's samples that reach the next level.
_FIRST_STEP, _SMALLEST_STEP, _ACCEPTED = 0.45, 0.05, 0.44  # Sizes of moves; share to accept.
_MOST_LEVELS = 8
_PLAIN = 0.15  # Share of samples that do not depend on the search, in case that it missed a mode.
_MOST_PLACES, _MATTERS = 16, 0.1  # Draws that matter, and the least weight of one.
_ROUNDS = 4  # Rounds of importance sampling; each fits the failures of the round before.
_MIXED = 4  # Moves of failures, twice: before and while they are fitted.
_MODES = 6  # Most components of the mixture.
_BLUR = 0.15  # Variance of a mean of failures that share ancestors, by which means shrink.
_NARROW, _PRIOR = 0.35, 10.0  # Variance of a narrow range, and samples that a prior of 1 is worth.
_APART = 1.5  # Distance of two failures of different kinds.


@dataclass(frozen=True, kw_only=True)
class Sample:
    """An episode by its draws; its weight is by importance sampling, or of a kind its share."""

    seed: int  # Seed of the draws beyond ``z``.
    z: list[float]
    is_discrete: list[bool]
    margins: list[float]  # Smallest of each constraint.
    has_failed: bool
    time_s: float
    cause: str
    facts: dict[str, float] = field(default_factory=dict)  # Disturbances, command and state.
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RareFailures:
    """A failure rate, and failures that make it, the most likely kind first."""

    rate: Estimate
    search_rate: float  # Rate by the subset simulation alone.
    simulations: int
    plain_rollouts: float  # Random episodes whose share of failures has the same variance.
    failures: list[Sample]
    random: list[Sample]  # Random episodes, for comparison.


Simulate = Callable[[Sequence[np.ndarray | None], np.random.Generator], list[Sample]]
"""Simulates points of the normal space; None is a random point."""


class _Simulator:
    """Simulates samples in workers, and keeps finished samples in a file."""

    def __init__(
        self,
        call: Callable[..., tuple[str, Sample]],
        make: MadeOnce[Any],
        file: Path | None,
        **options: Any,
    ):
        self._call, self._make, self._file, self._options = call, make, file, options
        self._number, self._kept = 0, {}
        if file is not None and file.is_file():
            self._kept = dict(json.loads(file.read_text(encoding="utf-8")))

    def __call__(
        self, points: Sequence[np.ndarray | None], rng: np.random.Generator
    ) -> list[Sample]:
        """Simulates points of the normal space; None is a random point."""
        seeds = rng.integers(2**62, size=len(points)).tolist()
        first, self._number = self._number, self._number + len(points)
        items = [
            (f"{first + i}-{seed}", seed, point)
            for i, (point, seed) in enumerate(zip(points, seeds, strict=True))
        ]
        missing = [item for item in items if item[0] not in self._kept]
        if missing:
            done = self._number - len(missing)
            results = map_items(
                self._call, missing, make=self._make, num_done=done, **self._options
            )
            try:
                with closing(results):
                    for key, sample in results:
                        self._kept[key] = asdict(sample)
            finally:
                if self._file is not None:
                    write_file(self._file, json.dumps([*self._kept.items()]))
        return [Sample(**self._kept[key]) for key, *_ in items]


def estimate_rare_failure(
    loop: Scenario | Callable[..., Diagram],
    *,
    variation: str = "nominal",
    metric: str = UNSAFE,
    samples: int = 256,
    seed: int = RATE.first,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    **recorded: Any,
) -> RareFailures:
    """Estimates a failure rate down to 1e-6 and less, and finds the failures that make it.

    The random numbers of an episode are a point of a space of standard normal numbers. A subset
    simulation (Au and Beck 2001) searches failures there: at each level, the tenth of the samples
    closest to a failure starts the next Markov chains. Then as many samples from normal
    distributions around the failures, weighted by likelihood, give the rate and its 95 % interval.
    The rate is unbiased for any distributions, but only random samples show a kind of failures that
    the search missed.

    Args:
        loop: A scenario, or a function that builds any diagram, with ``reset``, ``duration_s``,
            ``step_s`` and perhaps other arguments of `record_episodes`.
        metric: ``unsafe``, ``fall`` or a constraint.
        samples: Number of samples of a level.
        path: Folder in which finished episodes are kept; the same call continues.
    """
    make: MadeOnce[Any]
    run: Callable[..., Episode]
    is_task = isinstance(loop, Scenario)
    if isinstance(loop, Scenario):
        make = worker_loop(loop, variation, **loop.options_for("pairs", variation))
        info, run = episodes_info(make(), seed), run_episode
    else:
        info, make, recorded_run = prepare_recording(loop, **recorded)
        run = CloudPickled(recorded_run)
    names = info.constraint_names
    name = getattr(make(), "fall_name", "") if metric == "fall" else metric
    if name not in (UNSAFE, *names):
        known = [UNSAFE, "fall", *names]
        raise ValueError(f"metric of a rare failure: expected one of {known}; got '{metric}'")
    if is_task:
        run = partial(run_episode, **OutcomeReader(make(), metric).simulated)
    require_extra("train", "a search for rare failures")
    column = None if name == UNSAFE else names.index(name)
    initial = [f"initial {one}" for one in info.state_names]
    facts = initial, [f"desired {one}" for one in info.output_names]
    call = partial(_simulated, run, is_task, column, facts)
    key = hashlib.sha256(repr((info.scenario_hash, metric, samples, seed)).encode()).hexdigest()[
        :12
    ]
    file = None if path is None else Path(path) / f"samples-{key}.json"
    simulate = _Simulator(call, make, file, num_workers=num_workers, progress=progress)
    return search_and_sample(simulate, samples, np.random.default_rng(seed))


def search_and_sample(simulate: Simulate, samples: int, rng: np.random.Generator) -> RareFailures:
    """Searches failures and samples around them, by any function that simulates points."""
    search = _search(simulate, samples, rng)
    num_failed = sum(one.has_failed for one in search.random)
    rate, failures = proportion(num_failed, samples), search.failures
    plain, drawn = float(samples), list[Sample]()
    if failures and num_failed < _SHARE * samples:
        proposal = Proposal.around(search)
        for _ in range(_ROUNDS):
            proposal = proposal.refined([one for one in drawn if one.has_failed])
            points = [proposal.draw(rng) for _ in range(samples // _ROUNDS)]
            weights = proposal.weights(simulated := simulate(points, rng))
            drawn += [replace(one, weight=w) for one, w in zip(simulated, weights, strict=True)]
        values = np.array([one.weight * one.has_failed for one in drawn])
        rate, plain = _rate(values, search.rate)
        failures = proposal.kinds([one for one in drawn if one.has_failed] or search.failures)
    return RareFailures(
        rate=rate,
        search_rate=search.rate,
        simulations=len(search.tried) + len(drawn),
        plain_rollouts=plain,
        failures=failures,
        random=search.random,
    )


def _simulated(
    run: Callable[..., Episode],
    is_task: bool,
    column: int | None,
    fact_names: tuple[list[str], list[str]],
    diagram: Any,
    item: tuple[str, int, np.ndarray | None],
) -> tuple[str, Sample]:
    """The episode of a point, or of a random one, with what there is to know of it."""
    key, seed, z = item
    point = NormalPoint(np.random.default_rng(seed), z)
    facts: dict[str, float] = {}
    options: dict[str, Any] = {"draws": NormalGenerator(point)}
    if is_task:
        options["at_start"] = lambda context: facts.update(_acting(diagram.disturbances(context)))
    episode = run(diagram, index=0, **options)
    margins = episode.margins.min(axis=0)
    has_failed = not episode.is_safe
    if column is not None:
        of_all = episode.cause == DIVERGED
        has_failed, margins = bool(margins[column] < 0.0) or of_all, margins[[column]]
    for names, values in zip(fact_names, (episode.true_state, episode.desired_output), strict=True):
        facts |= dict(zip(names, values[0].tolist(), strict=True))
    return key, Sample(
        seed=seed,
        z=point.z.tolist(),
        is_discrete=point.is_discrete.tolist(),
        margins=margins.tolist(),
        has_failed=has_failed,
        time_s=float(episode.time_s[-1]),
        cause=episode.cause,
        facts=facts,
    )


def _acting(disturbances: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Impulses and directions of a ball and a push."""
    impulses = {}
    if (ball := disturbances.get("ball")) is not None:
        impulses["ball"] = ball[0] * ball[-3:-1]
    if (push := disturbances.get("push")) is not None:
        impulses["push"] = push[5] * push[1:3]
    return {
        f"{name} {what}": float(value)
        for name, (x, y) in impulses.items()
        for what, value in (
            ("impulse [N·s]", math.hypot(x, y)),
            ("direction [°]", math.degrees(math.atan2(y, x))),
        )
    }


class _Search(NamedTuple):
    """A subset simulation: its random samples, all with their levels, failures, and their rate."""

    random: list[Sample]
    tried: list[tuple[Sample, float]]
    failures: list[Sample]  # Distributed as all failures are, about.
    rate: float


def _search(simulate: Simulate, number: int, rng: np.random.Generator) -> _Search:
    """Searches failures, level by level."""
    samples = random = simulate([None] * number, rng)
    spread = np.maximum(np.array([one.margins for one in random]).std(axis=0), 1e-12)

    def level(sample: Sample) -> float:
        lowest = float((np.array(sample.margins) / spread).min())
        return min(lowest, 0.0) if sample.has_failed else max(lowest, 0.0)

    tried, rate, step = [(one, level(one)) for one in random], 1.0, _FIRST_STEP

    def walk(chains: list[Sample], below: float) -> list[Sample]:
        """Moves chains that stay below a level, and adapts the step to the share that moved."""
        nonlocal step
        points = [moved(np.array(x.z), np.array(x.is_discrete), step, rng) for x in chains]
        proposed = simulate(points, rng)
        tried.extend((one, level(one)) for one in proposed)
        is_kept = [level(one) < below for one in proposed]
        step *= math.exp(float(np.mean(is_kept)) - _ACCEPTED)
        step = float(np.clip(step, _SMALLEST_STEP, 1.0))
        pairs = zip(proposed, chains, is_kept, strict=True)
        return [new if kept else old for new, old, kept in pairs]

    num_chains = max(2, round(_SHARE * number))
    for _ in range(_MOST_LEVELS):
        if sum(one.has_failed for one in samples) >= num_chains:
            break
        samples = sorted(samples, key=level)
        # That of the best sample that goes: then the product of the shares has no bias (Bréhier et
        # al. 2016).
        threshold = level(samples[num_chains])
        chains = [one for one in samples[:num_chains] if level(one) < threshold]
        if not chains:
            break  # All alike: nothing leads to a failure.
        rate *= len(chains) / number
        samples = []
        while len(samples) < number:
            chains = walk(chains, threshold)
            samples += chains
        samples = samples[:number]
    failures = [one for one in samples if one.has_failed]
    rate *= len(failures) / number
    if failures and samples is not random:
        chains = [failures[i] for i in rng.choice(len(failures), num_chains)]
        failures = []
        for _ in range(2 * _MIXED):
            chains = walk(chains, math.nextafter(0.0, 1.0))
            failures += chains
        failures = failures[len(failures) // 2 :]
    return _Search(random, tried, failures, rate)


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A mixture of normal distributions of the draws that matter, (k,), and of random samples."""

    places: np.ndarray  # Indices of these draws.
    share: np.ndarray  # Weights of the components.
    mean: np.ndarray
    variance: np.ndarray

    @classmethod
    def around(cls, search: _Search) -> Proposal:
        """Fits the failures of a search in the draws on which the levels depend."""
        from sklearn.linear_model import LassoCV

        length = max(len(one.z) for one in search.failures)
        z = np.array([_padded(one, length) for one, _ in search.tried])
        levels = np.array([level for _, level in search.tried])
        terms = np.hstack([z, z**2 - 1.0])
        weights = np.abs(LassoCV(cv=5).fit(terms, levels).coef_).reshape(2, -1).max(axis=0)
        places = np.sort(np.argsort(-weights, kind="stable")[:_MOST_PLACES])
        places = places[weights[places] > _MATTERS * weights.max()]
        points = np.array([_padded(one, length)[places] for one in search.failures])
        if not len(places):
            return cls(places=places, share=np.ones(0), mean=points, variance=points)
        fit = _mixture(points)
        return cls(
            places=places,
            share=fit.weights_,
            mean=fit.means_**3 / (fit.means_**2 + _BLUR),
            variance=_widened(fit.covariances_, len(points) * fit.weights_[:, None]),
        )

    def refined(self, failures: Sequence[Sample]) -> Proposal:
        """Moves half of it to weighted failures, each of the component that is nearest to it."""
        if not (len(failures) and len(self.places)):
            return self
        length = self.places[-1] + 1
        z = np.array([_padded(one, length)[self.places] for one in failures])
        weight = np.array([one.weight for one in failures])
        logs = -0.5 * ((z[:, None] - self.mean) ** 2 / self.variance + np.log(self.variance)).sum(2)
        owner = (logs + np.log(self.share)).argmax(axis=1)
        share, mean, variance = [], [], []
        for k in np.unique(owner):
            own, w = z[owner == k], weight[owner == k]
            size = w.sum() ** 2 / (w**2).sum()
            m = np.average(own, axis=0, weights=w)
            v = np.average((own - m) ** 2, axis=0, weights=w)
            share.append(0.5 * w.sum() / weight.sum())
            mean.append((size * m + _PRIOR * self.mean[k]) / (size + _PRIOR))
            variance.append(_widened(v, size))
        return replace(
            self,
            share=np.append(0.5 * self.share, share),
            mean=np.vstack([self.mean, mean]),
            variance=np.vstack([self.variance, variance]),
        )

    def draw(self, rng: np.random.Generator) -> np.ndarray | None:
        """Draws a point; None is a random point."""
        if rng.random() < _PLAIN or not len(self.places):
            return None
        z = rng.standard_normal(self.places[-1] + 1)
        k = rng.choice(len(self.share), p=self.share)
        z[self.places] = rng.normal(self.mean[k], np.sqrt(self.variance[k]))
        return z

    def weights(self, samples: Sequence[Sample]) -> list[float]:
        """Likelihood of each sample among random samples, relative to this proposal."""
        weights = []
        for sample in samples:
            # A draw that no episode reads says nothing.
            k = int(np.searchsorted(self.places, len(sample.z)))
            x, mean, variance = np.array(sample.z)[self.places[:k]], self.mean, self.variance
            ratio = 1.0
            if len(self.share):
                mean, variance = mean[:, :k], variance[:, :k]
                logs = x**2 - (x - mean) ** 2 / variance - np.log(variance)
                ratio = float(self.share @ np.exp(0.5 * logs.sum(axis=1)))
            weights.append(1.0 / (_PLAIN + (1.0 - _PLAIN) * ratio))
        return weights

    def kinds(self, failures: Sequence[Sample]) -> list[Sample]:
        """Failures of different kinds, the most frequent first; the weight is a share of all."""
        length = self.places.max(initial=-1) + 1
        points = np.array([_padded(one, length)[self.places] for one in failures])
        order = np.argsort((points**2).sum(axis=1), kind="stable").tolist()  # The likeliest first.
        chosen: list[int] = []
        for i in order:
            if all(np.linalg.norm(points[i] - points[k]) > _APART for k in chosen):
                chosen.append(i)
        nearest = np.linalg.norm(points[:, None] - points[chosen], axis=2).argmin(axis=1)
        mass = np.bincount(nearest, [one.weight for one in failures], minlength=len(chosen))
        kinds = [
            replace(failures[i], weight=float(m / mass.sum()))
            for i, m in zip(chosen, mass, strict=True)
        ]
        return sorted(kinds, key=lambda one: -one.weight)


def _padded(sample: Sample, length: int) -> np.ndarray:
    z = np.zeros(length)
    z[: len(sample.z)] = sample.z[:length]
    return z


def _mixture(z: np.ndarray) -> GaussianMixture:
    from sklearn.mixture import GaussianMixture

    most = int(np.clip(len(z) // (2 * z.shape[1]), 1, _MODES))
    fits = [
        GaussianMixture(count, covariance_type="diag", random_state=0).fit(z)
        for count in range(1, most + 1)
    ]
    return min(fits, key=lambda fit: fit.bic(z))


def _rate(values: np.ndarray, search_rate: float) -> tuple[Estimate, float]:
    """The mean of weighted failures (N,), and as many random episodes as have its variance.

    The interval is that of Student's t of the logarithm, by Kish's effective number of failures. It
    reaches to the search's rate, because the search also counts modes that the proposal lacks.
    """
    from scipy.stats import t

    mean = float(values.mean())
    if not mean > 0.0:
        return Estimate(search_rate, 0.0, 1.0, len(values)), math.nan
    error = float(values.std(ddof=1)) / math.sqrt(len(values))
    effective = values.sum() ** 2 / (values**2).sum()
    room = math.exp(t.ppf(0.975, max(effective - 1.0, 1.0)) * error / mean)
    high = min(max(mean * room, search_rate), 1.0)
    plain = mean * (1.0 - mean) / error**2
    return Estimate(mean, min(mean / room, search_rate), high, len(values)), plain


def _widened(variance: np.ndarray, size: Any) -> np.ndarray:
    """Variances of a proposal, from the variances of so many samples.

    A variance below 1 makes some weights large, and pays only where failures are in a narrow range.
    """
    shrunk = (size * variance + _PRIOR) / (size + _PRIOR)
    return np.where(shrunk < _NARROW, shrunk, np.maximum(shrunk, 1.0))
