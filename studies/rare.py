"""``python -m studies rare``: rates of rare failures beside the shares of random episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.stats import t

from drake_safety.cli.console import WorkersOption
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.rare_failures import RareFailures, estimate_rare_failure
from drake_safety.learning.seeds import RATE
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
    episodes: int  # Random ones.
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
    "Laikago, balls of 3.5 m/s": laikago(3.5, 0, 3),
}


def rare(
    systems: Annotated[
        list[str] | None, typer.Argument(help=f"Of {list(SYSTEMS)}; all by default.")
    ] = None,
    samples: Annotated[int, typer.Option(help="Episodes of a level.", min=40)] = 256,
    out: Annotated[Path, typer.Option(help="Folder of episodes and results.")] = Path("runs/rare"),
    workers: WorkersOption = None,
) -> None:
    """Estimate rates of rare failures by other seeds, and compare them with random episodes.

    The rows: the share of random episodes that fail, the mean of the estimates by it, intervals
    that hold it, episodes of an estimate, and random episodes with its variance by episode used.
    Where fewer than 20 random episodes fail, the mean of the estimates takes the share's place.
    """
    with open_study("rare", "pendulum", out, seed=RATE.first, workers=workers, out=out) as study:
        for name in systems or SYSTEMS:
            study.add(name, "rare", _rows(study, name, SYSTEMS[name], samples))


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


def judged(found: list[RareFailures], failed: np.ndarray) -> dict[str, Estimate]:
    """The rows of estimates, and of random episodes by whether they failed, (N,)."""
    rates, used = (
        np.array([(one.rate.value, one.simulations) for one in found]).T
        if found
        else np.zeros((2, 0))
    )
    mean, number = float(rates.mean()), len(found)
    truth = float(failed.mean()) if failed.sum() >= _ENOUGH else mean
    held = sum(one.rate.low <= truth <= one.rate.high for one in found)
    rows = {"mean_rate": _mean(rates), "episodes": Estimate.exact(float(used.mean()), number)}
    if failed.size:
        rows["random_rate"] = proportion(int(failed.sum()), len(failed))
    if number > 2:
        saved = truth * (1.0 - truth) / float(((rates - truth) ** 2).mean()) / used.mean()
        rows |= {"held": proportion(held, number), "saved": Estimate.exact(saved, number)}
    return rows


def _mean(values: np.ndarray) -> Estimate:
    """The mean of values (n,), and its interval by Student's t."""
    mean = float(values.mean())
    room = 0.0
    if len(values) > 1:
        room = float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5)
    return Estimate(mean, mean - room, mean + room, len(values))
