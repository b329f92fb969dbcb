"""``python -m studies rare``: rates of rare failures beside the shares of random episodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.stats import norm, t

from drake_safety.cli.console import WorkersOption
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.rare_failures import (
    RareFailures,
    Sample,
    estimate_rare_failure,
    search_and_sample,
)
from drake_safety.learning.seeds import RATE
from drake_safety.simulation.normal_space import NormalGenerator, NormalPoint
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.gate import failures
from studies.harness import Study, open_study

_ENOUGH = 20  # Failures of random episodes that make their share the true rate.


@dataclass(frozen=True, kw_only=True)
class System:
    """A scenario with changes, and how often its rate is estimated."""

    scenario: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    variation: str = "nominal"
    episodes: int  # Random episodes.
    repetitions: int


def pendulum(plan_rad: float, episodes: int, repetitions: int) -> System:
    """A pendulum that fails more often, the larger the angles of its plan are."""
    changes = {"start_angle_rad": 0.2, "start_rate_rad_s": 0.6667, "plan_angle_rad": plan_rad}
    changes = {f"parameters.{key}": value for key, value in changes.items()}
    return System(scenario="pendulum", changes=changes, episodes=episodes, repetitions=repetitions)


def laikago(speed_m_s: float, episodes: int, repetitions: int) -> System:
    """Laikago on its actual plant, with a ball of at most this speed in every episode."""
    changes = {"parameters.push.share": 1.0, "parameters.push.speed_m_s": [2.0, speed_m_s]}
    return System(
        scenario="laikago_balancing",
        changes=changes,
        variation="actual",
        episodes=episodes,
        repetitions=repetitions,
    )


SYSTEMS = {
    "pendulum, plans of 0.24 rad": pendulum(0.24, 4000, 20),
    "pendulum, plans of 0.19 rad": pendulum(0.19, 20000, 20),
    "pendulum, plans of 0.16 rad": pendulum(0.16, 0, 20),
    "Laikago, balls of 4.6 m/s": laikago(4.6, 1500, 3),
}


class KnownRate:
    """Samples of a margin that is a function of draws."""

    def __init__(self, margin: Callable[[np.random.Generator], float]):
        self.margin, self.number = margin, 0

    def __call__(
        self, points: Sequence[np.ndarray | None], rng: np.random.Generator
    ) -> list[Sample]:
        """The samples of the points."""
        self.number += len(points)
        seeds = rng.integers(2**62, size=len(points)).tolist()
        return [self._sample(z, seed) for z, seed in zip(points, seeds, strict=True)]

    def _sample(self, z: np.ndarray | None, seed: int) -> Sample:
        point = NormalPoint(np.random.default_rng(seed), z)
        margin = float(self.margin(NormalGenerator(point)))
        return Sample(
            seed=seed,
            z=point.z.tolist(),
            is_discrete=point.is_discrete.tolist(),
            margins=[margin],
            has_failed=margin < 0.0,
            time_s=1.0,
            cause="toy" if margin < 0.0 else "",
        )


def one_side(rate: float, rng: np.random.Generator) -> float:
    """A margin that is negative where the sum of ten draws is large."""
    return float(norm.isf(rate) - rng.normal(size=10).sum() / 10**0.5)


def two_sides(rate: float, rng: np.random.Generator) -> float:
    """A margin that is negative where one of sixty draws is large or small."""
    return float(norm.isf(rate / 2) - abs(rng.normal(size=60)[7]))


def four_sides(limit: float, rng: np.random.Generator) -> float:
    """A margin with four kinds of failures, two of them less likely."""
    x, y = rng.normal(size=20)[:2]
    return float(min(limit - abs(x + y) / 2**0.5, limit + 0.2 - abs(x - y) / 2**0.5))


KNOWN: dict[str, tuple[float, Callable[[np.random.Generator], float]]] = {
    "sum of ten draws": (1e-3, partial(one_side, 1e-3)),
    "sum of ten draws, rarer": (1e-4, partial(one_side, 1e-4)),
    "one of sixty draws": (1e-3, partial(two_sides, 1e-3)),
    "one of sixty draws, rarer": (1e-4, partial(two_sides, 1e-4)),
    "one of sixty draws, rarest": (1e-6, partial(two_sides, 1e-6)),
    "four kinds of failures": (
        1.0 - (1.0 - 2.0 * norm.sf(3.6)) * (1.0 - 2.0 * norm.sf(3.8)),
        partial(four_sides, 3.6),
    ),
}
"""Margins of draws, with the rates at which they are negative."""
_REPETITIONS = 20


def rare(
    systems: Annotated[
        list[str] | None,
        typer.Argument(help=f"Among {[*KNOWN, *SYSTEMS]}; all by default."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Episodes of a level.", min=40)] = 256,
    out: Annotated[Path, typer.Option(help="Folder of episodes and results.")] = Path("runs/rare"),
    workers: WorkersOption = None,
) -> None:
    """Estimate rates of rare failures by other seeds, and compare them with random episodes.

    The rows: failures of a million, known or of random episodes; the mean of the estimates;
    intervals that hold the rate; episodes of an estimate, and the ratio of random episodes to them.
    Where fewer than 20 random episodes fail, the mean of the estimates takes the share's place.
    Some systems are functions of random draws with a known rate, without a simulation.
    """
    with open_study("rare", "pendulum", out, seed=RATE.first, workers=workers, out=out) as study:
        if unknown := {*(systems or ())} - {*KNOWN, *SYSTEMS}:
            raise ValueError(f"rare: no system {sorted(unknown)}; there are {[*KNOWN, *SYSTEMS]}")
        for name in systems or [*KNOWN, *SYSTEMS]:
            if name in SYSTEMS:
                study.add(name, "rare", _rows(study, name, SYSTEMS[name], samples))
                continue
            rate, margin = KNOWN[name]
            rngs = map(np.random.default_rng, range(_REPETITIONS))
            found = [search_and_sample(KnownRate(margin), samples, rng) for rng in rngs]
            study.add(name, "rare", judged(found, rate))


def _rows(study: Study, name: str, system: System, samples: int) -> dict[str, Estimate]:
    scenario = load_scenario(system.scenario, system.changes)
    folder = study.folder / scenario.simulation_hash(system.variation)[:12]
    options: dict[str, Any] = {"variation": system.variation, "num_workers": study.workers}
    found = [
        estimate_rare_failure(
            scenario,
            samples=samples,
            seed=study.seed + 1 + i,
            path=folder,
            progress=partial(study.stages, f"{name}: estimate {i + 1} of {system.repetitions}"),
            **options,
        )
        for i in range(system.repetitions)
    ]
    failed = np.zeros(0, dtype=int)
    if system.episodes:
        failed = failures(
            run_episodes(
                scenario,
                system.episodes,
                seed=study.seed,
                path=folder / "random",
                progress=partial(study.stages, f"{name}: random episodes"),
                **scenario.options_for("pairs", system.variation),
                **options,
            )
        )
    return judged(found, failed)


def judged(found: list[RareFailures], random: np.ndarray | float) -> dict[str, Estimate]:
    """The rows of estimates, and of random episodes by whether they failed, (N,), or a rate."""
    rates, used = np.array([(one.rate.value, one.simulations) for one in found]).T
    number, truth = len(found), float(np.mean(random)) if np.size(random) else 0.0
    rows = {
        "mean": _millionth(_mean(rates)),
        "episodes": Estimate.exact(float(used.mean()), number),
    }
    if isinstance(random, float):
        rows["rate"] = _millionth(Estimate.exact(random, 0))
    elif random.size:
        rows["rate"] = _millionth(proportion(int(random.sum()), len(random)))
    if not isinstance(random, float) and random.sum() < _ENOUGH:
        truth = float(rates.mean())
    if number > 2:
        held = sum(one.rate.low <= truth <= one.rate.high for one in found)
        saved = truth * (1.0 - truth) / float(((rates - truth) ** 2).mean()) / used.mean()
        rows |= {"held": proportion(held, number), "saved": Estimate.exact(saved, number)}
    return rows


def _millionth(rate: Estimate) -> Estimate:
    """A rate as failures of a million."""
    return Estimate(1e6 * rate.value, 1e6 * rate.low, 1e6 * rate.high, rate.n)


def _mean(values: np.ndarray) -> Estimate:
    """The mean of values (n,), and its interval by Student's t."""
    mean = float(values.mean())
    room = 0.0
    if len(values) > 1:
        room = float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5)
    return Estimate(mean, mean - room, mean + room, len(values))
