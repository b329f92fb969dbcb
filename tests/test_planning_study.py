from pathlib import Path

import numpy as np
import pytest

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.planning.plan_choice import plan_inputs
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import SCENARIO as GLIDING
from goal_field import FieldAssessment
from shuttle_task import shuttling
from studies import planning_study as planning_study_module
from studies.planning_study import planning_study, planning_verdict, run_trials


class Knowing(FieldAssessment):
    """Γ by the speeds along x and y, in a task in which slower is safer."""

    uses_features = True

    def __init__(self, sign=1.0):
        super().__init__(lambda state: 0.5 - sign * 0.1 * np.clip(state[:, 3:5].sum(axis=1), -4, 4))


@pytest.fixture(scope="module")
def trials():
    return run_trials(shuttling(), 40, num_plans=5, seed=9, num_workers=1)


def test_every_candidate_of_every_start_is_executed(trials):
    assert [trial.index for trial in trials] == list(range(40))
    for trial in trials:
        assert trial.is_safe.shape == (5,)
        # All of them from one place, and with the noise of none.
        assert len(np.unique(trial.state[:, :3], axis=0)) == 1
        # A slower one along the same line is safe where a faster one is.
        order = np.argsort(np.abs(trial.state[:, 3]))
        assert not np.any(np.diff(trial.is_safe[order].astype(int)) > 0)


def test_what_gamma_sees_of_a_plan_is_what_it_would_see_when_it_chooses(trials):
    loop = shuttling().make_loop()
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(9, 3))
    rng = np.random.default_rng(np.random.SeedSequence(9, spawn_key=(3, 1)))
    seen = plan_inputs(loop, context, loop.candidate_plans(context, rng, 5))
    trial = trials[3]
    for expected, found in zip(
        seen, (trial.state, trial.desired_preview, trial.features), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.train
def test_a_stopped_study_goes_on_with_the_motions_it_has(trials, tmp_path, monkeypatch):
    num_run = 0
    run_episode = planning_study_module.run_episode

    def counted(*arguments, **options):
        nonlocal num_run
        num_run += 1
        return run_episode(*arguments, **options)

    def stop(done, total):
        assert total == 200
        if done >= 23:
            raise KeyboardInterrupt

    monkeypatch.setattr(planning_study_module, "run_episode", counted)
    options = {"num_plans": 5, "seed": 9, "num_workers": 1, "path": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        run_trials(shuttling(), 40, **options, progress=stop)
    assert 23 <= num_run < 30
    # Starts 0 to 3 are whole, and the next one is not: it has its first candidates alone.
    kept = [completed(tmp_path / f"plan-{i}") for i in range(5)]
    assert sum(map(len, kept)) == num_run
    assert kept[0] > kept[4]
    calls = []
    again = run_trials(shuttling(), 40, **options, progress=lambda *call: calls.append(call))
    assert calls[0] == (sum(map(len, kept)), 200) and calls[-1] == (200, 200)
    assert num_run == 200
    for one, other in zip(again, trials, strict=True):
        assert one.index == other.index
        for name in ("state", "desired_preview", "features", "is_safe"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    # All are there, and fewer starts are the first of them.
    fewer = run_trials(shuttling(), 7, **options)
    assert num_run == 200
    assert [trial.index for trial in fewer] == list(range(7))
    defaults = load_episodes(tmp_path / "plan-0")
    assert [e.is_safe for e in defaults] == [trial.is_safe[0] for trial in trials]
    with pytest.raises(ValueError, match="holds episodes of another set"):
        run_trials(shuttling(), 7, **{**options, "seed": 10})


def test_who_knows_comes_all_the_way_to_hindsight_and_who_errs_does_not(trials):
    estimates = planning_study(Knowing(), trials, threshold=0.0).estimates
    default = np.mean([trial.is_safe[0] for trial in trials])
    best = np.mean([trial.is_safe.any() for trial in trials])
    assert estimates["default"].value == default < best
    assert estimates["chosen"].value == estimates["best_in_hindsight"].value == best
    assert estimates["gain"].value == 1.0
    # The default is the fastest: taking the least safe is taking it.
    wrong = planning_study(Knowing(sign=-1.0), trials, threshold=0.0).estimates
    assert wrong["gain"].value == 0.0
    assert default < estimates["any_candidate"].value < best


def test_starts_that_no_plan_is_accepted_for_are_told_apart(trials):
    study = planning_study(Knowing(), trials, threshold=0.5)
    accepted = [values.max() >= 0.5 for values in study.safety_probability]
    assert study.estimates["accepted"].value == np.mean(accepted)
    assert study.estimates["chosen_if_accepted"].n == sum(accepted)


def test_without_starts_or_plans_there_is_nothing_to_study():
    with pytest.raises(ValueError, match="there is no start"):
        planning_study(Knowing(), [], threshold=0.5)
    gliding = parse_scenario(GLIDING, name="gliding", folder=Path())
    with pytest.raises(ValueError, match="'Gliding' has no plans to choose from"):
        run_trials(gliding, 1, num_plans=2, seed=0, num_workers=1)


@pytest.mark.parametrize(
    ("gain", "start"),
    [
        (
            (0.5, 0.1, 0.8),
            "Γ is better: 75.0 % (58.8–87.3) of the starts stay safe with the plan that",
        ),
        ((-0.5, -0.9, -0.1), "The default plan is better: "),
        ((0.1, -0.2, 0.4), "No significant difference: "),
        ((np.nan, np.nan, np.nan), "No difference: "),
    ],
)
def test_the_verdict_follows_from_the_interval_of_the_gain(gain, start):
    estimates = {"default": proportion(24, 40), "chosen": proportion(30, 40)}
    estimates["gain"] = Estimate(*gain, 40)
    assert planning_verdict(estimates).startswith(start)
    del estimates["gain"]
    assert "incomplete" in planning_verdict(estimates)
