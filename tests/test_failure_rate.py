"""Failure rates from few episodes: unbiased however wrong Γ is, and the command."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from command_line import call
from drake_safety import load_scenario, run_episodes
from drake_safety.evaluation import failure_rate
from drake_safety.evaluation.failure_rate import (
    estimate_failure_rate,
    in_turns,
    strata_of,
    stratified_rate,
)
from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from toy_tasks import train_shuttle

NUM_STARTS, NUM_ROLLOUTS, NUM_REPLAYS = 4000, 400, 200
RANDOM = "random"


def rare(z):
    return np.where(z > 0.98, 0.5, 0.0005)


def common(z):
    return 1.0 / (1.0 + np.exp(-60.0 * (z - 0.5)))


def replay(rng, probability, score_of):
    """The estimate of one set of starts, each of which fails with its probability."""
    p = probability(rng.random(NUM_STARTS))
    score = rng.random(NUM_STARTS) if score_of == RANDOM else score_of(p)
    stratum = strata_of(score, rng)
    index = in_turns(stratum)[:NUM_ROLLOUTS]
    failed = rng.random(NUM_ROLLOUTS) < p[index]
    counted = partial(np.bincount, minlength=10)
    failures = counted(stratum[index], weights=failed)
    return stratified_rate(counted(stratum), counted(stratum[index]), failures)[0]


@pytest.mark.parametrize(
    ("probability", "score_of", "least_ratio"),
    [
        (rare, lambda p: p, 3.0),
        (rare, lambda p: 1.0 - p, 1.0),
        (rare, RANDOM, 0.4),
        (common, lambda p: p, 5.0),
        (lambda z: np.full_like(z, 0.2), lambda p: 0.0 * p, 0.4),
    ],
)
def test_it_is_unbiased_however_wrong_gamma_is_and_its_interval_holds(
    probability, score_of, least_ratio
):
    rng = np.random.default_rng(7)
    truth = probability((np.arange(100_000) + 0.5) / 100_000).mean()
    found = [replay(rng, probability, score_of) for _ in range(NUM_REPLAYS)]
    values = np.array([one.value for one in found])
    assert abs(values.mean() - truth) < 4.0 * values.std() / np.sqrt(NUM_REPLAYS)
    # At least 95 %, but for chance in 200 replays.
    assert sum(one.low <= truth <= one.high for one in found) >= 0.92 * NUM_REPLAYS
    assert truth * (1 - truth) / NUM_ROLLOUTS / values.var() > least_ratio


def test_a_start_is_simulated_as_often_as_its_outcome_is_uncertain():
    score = np.repeat([0.0, 0.5], 5000)
    stratum = strata_of(score, np.random.default_rng(0))
    assert np.bincount(stratum).min() > 0
    index = in_turns(stratum)[:400]
    # Half of the simulations are spread evenly, the other half are where Γ is not certain.
    assert np.mean(score[index] == 0.5) == pytest.approx(0.75, abs=0.06)
    # A single start of which Γ is not certain is simulated, and leaves no stratum empty.
    score = np.append(np.zeros(999), 0.5)
    stratum = strata_of(score, np.random.default_rng(0))
    assert 999 in in_turns(stratum)[:10]
    assert np.bincount(stratum).min() > 0
    # Where Γ tells nothing apart all are spread evenly.
    assert np.bincount(strata_of(np.zeros(1000), np.random.default_rng(0))).tolist() == [100] * 10


def test_without_strata_it_is_a_share_with_nearly_the_exact_interval():
    for count in (0, 3, 40, 197, 200):
        found, number = stratified_rate(np.array([10**9]), np.array([200]), np.array([count]))
        assert number == pytest.approx(200, rel=1e-3)
        exact = proportion(count, 200)
        assert found.value == exact.value
        assert found.low == pytest.approx(exact.low, abs=1e-4)
        assert found.high == pytest.approx(exact.high, abs=1e-4)


def test_it_is_the_prediction_powered_estimate_of_ppi_python():
    # By ppi-python 0.2.3: ppi_mean_pointestimate and ppi_mean_ci with lam 1, with the share of
    # failures of each stratum as predictions. Its interval is normal.
    starts, rollouts = np.array([4000, 3000, 2000, 1000]), np.full(4, 100)
    found, _ = stratified_rate(starts, rollouts, np.array([2, 10, 40, 80]))
    assert found.value == pytest.approx(0.198)
    assert (found.low, found.high) == pytest.approx((0.16825271, 0.22774729), abs=0.003)


class Angle:
    """Γ of the pendulum: the larger the angle, the less it is safe."""

    def predict_one(self, state, preview, features):
        return SimpleNamespace(belief=np.array([0.2, 0.3, 0.5]))

    def predict(self, state, preview, features):
        return SimpleNamespace(probability=np.exp(-3.0 * np.abs(state[:, 0])))


WEAK = {"parameters.effort_share": 0.2}


@pytest.mark.train
def test_an_estimate_is_that_of_ordinary_episodes_and_is_continued(monkeypatch, tmp_path):
    scenario = load_scenario("pendulum", WEAK)
    options = {"num_starts": 120, "num_rollouts": 60, "num_workers": 1, "seed": 3}
    options |= {"path": tmp_path, "variation": "actual"}
    collect = failure_rate.collect_episodes

    def stop(info, indices, *arguments, **known):
        if len(indices) == 120:
            return collect(info, indices, *arguments, **known)
        collect(info, indices[:25], *arguments, **known)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(failure_rate, "collect_episodes", stop)
        estimate_failure_rate(scenario, Angle(), **options)
    found = estimate_failure_rate(scenario, Angle(), **options)
    assert found.rate.n == 60
    ordinary = run_episodes(scenario, 120, variation="actual", seed=3, num_workers=1)
    failed = {one.index: one for one in ordinary if not one.is_safe}
    assert {one.episode for one in found.failures} <= failed.keys()
    assert all(failed[one.episode].time_s[-1] == one.time_s for one in found.failures)
    assert found.rate.low <= len(failed) / 120 <= found.rate.high
    all_of_them = estimate_failure_rate(scenario, Angle(), **(options | {"num_rollouts": 120}))
    assert all_of_them.rate.value == pytest.approx(len(failed) / 120)


@pytest.mark.train
def test_the_command_writes_the_rate_and_the_failures(monkeypatch, tmp_path):
    file = train_shuttle(tmp_path)
    options = ("--assessment", tmp_path, "--starts", 60, "--episodes", 40, "--workers", 1)
    assert call(monkeypatch, "rate", file, *options, "--out", tmp_path / "out") == 0
    results = Results.read(tmp_path / "out/rate.json")
    rate = results["", "", "failure_rate"]
    assert rate.n == 40 and 0.0 < rate.low < rate.value < rate.high < 1.0
    assert len(results.entries["failures"]) > 0
