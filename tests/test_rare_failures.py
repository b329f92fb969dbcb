"""Rates of rare failures: against known ones, and the command."""

from functools import partial

import numpy as np
import pytest

from command_line import call
from drake_safety.evaluation import rare_failures
from drake_safety.evaluation.rare_failures import estimate_rare_failure, search_and_sample
from drake_safety.evaluation.rare_figure import telling_facts
from drake_safety.evaluation.results import Results
from drake_safety.simulation.normal_space import NormalGenerator, NormalPoint
from studies.rare import KnownRate, one_side, two_sides
from toy_tasks import SCENARIO, Gliding, gliding

SYSTEMS = {"one side": one_side, "two sides": two_sides}


@pytest.mark.train
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("rate", [1e-3, 1e-5])
def test_rates_are_found_without_bias_from_few_samples_and_intervals_hold(name, rate):
    found = []
    for seed in range(12):
        toy = KnownRate(partial(SYSTEMS[name], rate))
        found.append(search_and_sample(toy, 256, np.random.default_rng(seed)))
        assert found[-1].simulations == toy.number < 2500
    values = np.array([one.rate.value for one in found])
    assert np.mean(values) / rate == pytest.approx(1.0, abs=4.0 * np.std(values) / rate / 12**0.5)
    assert 0.6 < np.median(values) / rate < 1.4
    assert sum(one.rate.low <= rate <= one.rate.high for one in found) >= 9
    # Random episodes with this variance would be many more.
    assert rate / np.var(values) > 3 * found[0].simulations
    assert np.mean([one.search_rate for one in found]) / rate == pytest.approx(1.0, abs=0.6)


@pytest.mark.train
def test_kinds_of_failures_are_apart_and_their_shares_are_of_the_rate():
    toy = KnownRate(partial(two_sides, 1e-3))
    found = search_and_sample(toy, 256, np.random.default_rng(1))
    assert sum(one.weight for one in found.failures) == pytest.approx(1.0)
    shares = [one.weight for one in found.failures]
    assert shares == sorted(shares, reverse=True)
    sides = [np.sign(one.z[7]) for one in found.failures]
    for side in (-1.0, 1.0):
        share = sum(w for w, one in zip(shares, sides, strict=True) if one == side)
        assert share == pytest.approx(0.5, abs=0.25)


def test_frequent_failures_need_no_search_and_none_are_no_rate_of_zero():
    half = search_and_sample(KnownRate(lambda rng: rng.normal()), 100, np.random.default_rng(0))
    assert half.rate.low < 0.5 < half.rate.high
    assert half.simulations == half.plain_rollouts == 100
    never = search_and_sample(KnownRate(lambda rng: 1.0), 100, np.random.default_rng(0))
    assert (never.rate.value, never.failures, never.simulations) == (0.0, [], 100)
    assert never.rate.high == pytest.approx(0.036, abs=0.001)


# Both the angle and the rate must be near their largest values.
RATE = 2.0 * 0.02**2 / (2.0 * 0.3 * 0.72) / 4.0


@pytest.fixture(scope="module")
def glided(tmp_path_factory):
    folder = tmp_path_factory.mktemp("glided")
    scenario = gliding(speed_m_s=0.9)
    return scenario, folder, estimate_rare_failure(scenario, samples=100, seed=1, path=folder)


@pytest.mark.train
def test_a_task_needs_no_change_and_its_failures_are_replayed(glided):
    scenario, _, found = glided
    assert found.rate.low <= RATE <= found.rate.high
    assert found.rate.value == pytest.approx(RATE, rel=0.7)
    failure = found.failures[0]
    point = NormalPoint(np.random.default_rng(failure.seed), np.array(failure.z))
    episode = rare_failures.run_episode(scenario.make_loop(), draws=NormalGenerator(point))
    assert (episode.cause, episode.time_s[-1]) == (failure.cause, failure.time_s)
    x, v = episode.true_state[0]
    assert (failure.facts["initial x"], failure.facts["initial v"]) == (x, v)
    assert abs(x) > 0.25
    assert set(telling_facts(found)) == {"initial x", "initial v"}
    assert np.sign(x) == np.sign(v) == (1.0 if failure.cause == "right" else -1.0)


@pytest.mark.train
def test_it_continues_and_has_the_same_bits_for_any_number_of_workers(
    glided, monkeypatch, tmp_path
):
    scenario, folder, found = glided
    options = {"samples": 100, "seed": 1, "num_workers": 1}
    with monkeypatch.context() as patch:
        patch.setattr(rare_failures, "map_items", None)
        again = estimate_rare_failure(scenario, path=folder, **options)
    assert (again.rate, again.failures) == (found.rate, found.failures)
    fresh = estimate_rare_failure(scenario, path=tmp_path, **options)
    assert (fresh.rate, fresh.failures) == (found.rate, found.failures)


@pytest.mark.train
def test_any_diagram_is_searched_with_its_reset_alone():
    found = estimate_rare_failure(
        lambda: Gliding(gliding(speed_m_s=0.9)),
        reset=Gliding.reset,
        duration_s=0.8,
        step_s=0.04,
        constraint_names=["right", "left"],
        samples=60,
        num_workers=1,
    )
    assert found.rate.low <= RATE <= found.rate.high
    assert {one.cause for one in found.failures} <= {"right", "left"}


def test_an_unknown_metric_is_refused():
    with pytest.raises(ValueError, match=r"'unsafe', 'fall', 'right', 'left'.*; got 'tilt'"):
        estimate_rare_failure(gliding(), metric="tilt")


@pytest.mark.train
def test_the_command_prints_the_rate_and_the_failures(monkeypatch, tmp_path, capsys):
    file = tmp_path / "glide.yaml"
    file.write_text(f"{SCENARIO}parameters: {{speed_m_s: 0.9}}\n")
    options = ["--rare", "--samples", 60, "--variation", "nominal", "--workers", 1]
    assert call(monkeypatch, "rate", file, *options, "--out", tmp_path / "out") == 0
    printed = capsys.readouterr().out
    assert "initial v" in printed
    assert "--replay=1" in printed
    results = Results.read(tmp_path / "out/rare.json")
    assert f"{results['', '', 'failure_rate'].value:.1e}" in printed
    assert results.entries["failures"][0]["cause"] in ("right", "left")
    assert (tmp_path / "out/rare.png").stat().st_size > 5000
    assert call(monkeypatch, "rate", file, *options, "--out", tmp_path / "out", "--replay", 99) == 2
    assert "failures are 1 to" in capsys.readouterr().out
