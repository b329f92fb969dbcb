"""``python -m studies gate``: how often verdicts of `gate` are wrong, and how soon they are known.

Real pairs of episodes are drawn again, a thousand times, so that errors can be counted. The
candidates are the same robot with weaker motors.
"""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.stats import norm

from drake_safety.assessments import assessed_scenarios, load_assessment
from drake_safety.cli.console import ScenarioArgument, WorkersOption
from drake_safety.cli.gate import changed_plant
from drake_safety.evaluation.failure_rate import in_turns, strata_of, stratified_rate
from drake_safety.evaluation.metrics import Estimate, median, proportion
from drake_safety.evaluation.paired_test import betting_log_e
from drake_safety.learning.seeds import GATE
from drake_safety.learning.segments import Episodes
from drake_safety.robots.shift import JointShift, Shift
from drake_safety.simulation.rollouts import run_episodes
from studies.harness import Study, open_study

_ALPHA, _POWER = 0.05, 0.9
_OUTCOMES = np.array([-1.0, 0.0, 1.0])
_STARTS, _ROLLOUTS = 5000, 200  # For an estimated failure rate.
_LOOKS = np.arange(16, 5001, 16)


def gate(
    scenario: ScenarioArgument,
    baseline: Annotated[
        str, typer.Option(metavar="KEY=VALUE", help="Changes of the scenario, as of `gate`.")
    ] = "variation=actual",
    efforts: Annotated[
        str, typer.Option(help="Factors on the largest torques; '' for only a rate.")
    ] = ("0.6,0.5,0.4"),
    episodes: Annotated[int, typer.Option(help="Real episodes of each plant.", min=50)] = 1500,
    replays: Annotated[int, typer.Option(help="Sets of pairs drawn from them.", min=100)] = 1000,
    out: Annotated[Path, typer.Option(help="Folder of episodes and results.")] = Path("runs/gate"),
    workers: WorkersOption = None,
) -> None:
    """Count wrong verdicts of `gate`, and the pairs until a verdict, on real episodes drawn again.

    The rows: share of failures; false "worse" of two equal loops, whose sides a coin swaps; ends of
    intervals that excluded the true difference, at any look; pairs until "worse", beside episodes
    of each loop for a batch test with power 0.9, and for a sequential test without pairs.
    """
    with open_study("gate", scenario, out, seed=GATE.first, workers=workers, out=out) as study:
        shipped = study.scenario.name
        study.scenario, variation = changed_plant(scenario, baseline)
        real = simulated(study, variation, 1.0, episodes)
        for effort in map(float, filter(None, efforts.split(","))):
            candidate = failures(simulated(study, variation, effort, episodes))
            found = rows(failures(real), candidate, replays)
            study.rows |= {(f"effort {effort:g}", *key): one for key, one in found.items()}
        if shipped in assessed_scenarios():
            gamma = load_assessment(shipped)
            inputs = zip(*(one.first_inputs for one in real), strict=True)
            score = 1.0 - gamma.predict(*map(np.array, inputs)).probability
            found = rate_rows(score, failures(real), replays)
            study.rows |= {("rate", *key): one for key, one in found.items()}


def simulated(study: Study, variation: str, effort: float, number: int) -> Episodes:
    """Episodes of a robot with weaker motors."""
    shift = Shift(joints={".*": JointShift(effort_scale=effort)})
    plant = replace(study.scenario.variation(variation), shift=shift if effort < 1 else None)
    name = f"effort {effort:g}"
    shifted = study.scenario.with_variation(name, plant)
    options = study.scenario.options_for("pairs", variation)
    return run_episodes(
        shifted,
        number,
        variation=name,
        seed=study.seed,
        num_workers=study.workers,
        path=study.folder / "gate" / f"{shifted.simulation_hash(name)[:12]}-{study.seed}",
        progress=partial(study.stages, f"episodes, {name}"),
        **options,
    )


def failures(episodes: Episodes) -> np.ndarray:
    """Which episodes leave the safe set, (N,) of 0 and 1."""
    return np.array([not one.is_safe for one in episodes], dtype=int)


def rows(
    baseline: np.ndarray, candidate: np.ndarray, num_replays: int
) -> dict[tuple[str, str], Estimate]:
    """The rows of one candidate, from outcomes of pairs, (N,) of 0 and 1."""
    rng, size = np.random.default_rng(0), (num_replays, _LOOKS[-1])
    index, other = rng.integers(len(baseline), size=(2, *size))
    apart = candidate - baseline
    swapped = apart[index] * rng.choice([-1, 1], size)
    either = first_looks(swapped, 0.0)
    found = {
        ("baseline", "failures"): proportion(int(baseline.sum()), len(baseline)),
        ("candidate", "failures"): proportion(int(candidate.sum()), len(candidate)),
        ("only one", "failures"): proportion(int(np.abs(apart).sum()), len(apart)),
        ("equal loops", "false_worse"): _share_known(either),
    }
    for end, sign in {"low": 1, "high": -1}.items():
        known = first_looks(sign * apart[index], float(sign * apart.mean()))
        found[f"{end} end", "misses"] = _share_known(known)
    alone = candidate[other] - baseline[index]
    for name, differences in {"paired": apart[index], "unpaired": alone}.items():
        known = first_looks(differences, 0.0)
        found[name, "pairs_until_worse"] = median(known)
        found[name, "power"] = _share_known(known)
    number = batch_size(float(baseline.mean()), float(candidate.mean()))
    found["batch", "pairs_until_worse"] = Estimate.exact(number, len(baseline))
    return found


def rate_rows(
    score: np.ndarray, failed: np.ndarray, num_replays: int
) -> dict[tuple[str, str], Estimate]:
    """Rows of failure rates that are estimated with Γ's scores of real starts, (N,)."""
    rng, truth, found = np.random.default_rng(0), float(failed.mean()), []
    for _ in range(num_replays):
        drawn = rng.integers(len(score), size=_STARTS)
        stratum = strata_of(score[drawn], rng)
        index = in_turns(stratum)[:_ROLLOUTS]
        counts = np.bincount(stratum[index], weights=failed[drawn[index]])
        numbers = np.bincount(stratum), np.bincount(stratum[index])
        found.append(stratified_rate(*numbers, counts)[0])
    values = np.array([one.value for one in found])
    misses = sum(not one.low <= truth <= one.high for one in found)
    error = values.std() / math.sqrt(num_replays)
    ratio = truth * (1.0 - truth) / _ROLLOUTS / values.var()
    return {
        ("real episodes", "failures"): proportion(int(failed.sum()), len(failed)),
        ("gamma", "failures"): Estimate(
            values.mean(), values.mean() - 2 * error, values.mean() + 2 * error, num_replays
        ),
        ("gamma", "misses"): proportion(misses, num_replays),
        ("gamma", "variance_ratio"): Estimate.exact(ratio, num_replays),
    }


def first_looks(differences: np.ndarray, mean: float) -> np.ndarray:
    """Pairs at which it is known that a mean is above, (R,), of differences (R, N)."""
    seen = [np.cumsum(differences == one, axis=1, dtype=np.int32) for one in _OUTCOMES]
    counts = np.stack([one[:, _LOOKS - 1] for one in seen], axis=-1)
    is_known = betting_log_e(_OUTCOMES, counts, mean) >= -math.log(_ALPHA)
    return np.where(is_known.any(axis=1), _LOOKS[is_known.argmax(axis=1)], math.inf)


def batch_size(baseline: float, candidate: float) -> float:
    """Episodes of each loop for a one-sided test of two failure rates with a power of 0.9."""
    if candidate <= baseline:
        return math.inf
    both = 0.5 * (baseline + candidate)
    spread = (
        math.sqrt(2.0 * both * (1.0 - both)),
        math.sqrt(baseline * (1.0 - baseline) + candidate * (1.0 - candidate)),
    )
    reach = norm.ppf(1.0 - _ALPHA) * spread[0] + norm.ppf(_POWER) * spread[1]
    return float(math.ceil((reach / (candidate - baseline)) ** 2))


def _share_known(first: np.ndarray) -> Estimate:
    return proportion(int(np.isfinite(first).sum()), len(first))
