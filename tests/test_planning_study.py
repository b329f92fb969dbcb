from pathlib import Path

import numpy as np
import pytest

from drake_safety.planning.plan_choice import plan_inputs
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import SCENARIO as GLIDING
from goal_field import FieldAssessment
from shuttle_task import shuttling
from studies.planning import planning_estimates, run_trials


class Knowing(FieldAssessment):
    """Γ by the speeds along x and y, in a task in which slower is safer."""

    def __init__(self, sign=1.0):
        super().__init__(lambda state: 0.5 - sign * 0.1 * np.clip(state[:, 3:5].sum(axis=1), -4, 4))


OPTIONS = {"num_plans": 5, "seed": 9, "num_workers": 1}


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    return run_trials(shuttling(), 40, **OPTIONS, path=tmp_path_factory.mktemp("planning"))


def test_every_candidate_of_every_start_is_executed(trials):
    assert list(trials) == list(range(40))
    for trial in trials.values():
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
    found = (trials[3].state, trials[3].desired_preview, trials[3].features)
    for one, expected in zip(found, seen, strict=True):
        np.testing.assert_array_equal(one, expected)


def test_who_knows_comes_all_the_way_to_hindsight_and_who_errs_does_not(trials):
    found = planning_estimates(Knowing(), trials, threshold=0.0)
    default = np.mean([trial.is_safe[0] for trial in trials.values()])
    best = np.mean([trial.is_safe.any() for trial in trials.values()])
    assert found["default plan.safe"].value == default < best
    assert found["chosen.safe"].value == found["best in hindsight.safe"].value == best
    assert found["chosen.gain"].value == 1.0
    # The default is the fastest: taking the least safe is taking it.
    wrong = planning_estimates(Knowing(sign=-1.0), trials, threshold=0.0)
    assert wrong["chosen.gain"].value == 0.0
    assert default < found["any candidate.safe"].value < best


def test_starts_that_no_plan_is_accepted_for_are_told_apart(trials):
    found = planning_estimates(Knowing(), trials, threshold=0.5)
    gamma = [Knowing().predict(t.state, t.desired_preview, t.features) for t in trials.values()]
    accepted = [one.probability.max() >= 0.5 for one in gamma]
    assert found["chosen.accepted"].value == np.mean(accepted)
    assert found["chosen and accepted.safe"].n == sum(accepted)


def test_without_starts_or_plans_there_is_nothing_to_study(tmp_path):
    with pytest.raises(ValueError, match="there is no start"):
        planning_estimates(Knowing(), {}, threshold=0.5)
    gliding = parse_scenario(GLIDING, name="gliding", folder=Path())
    with pytest.raises(ValueError, match="'Gliding' has no plans to choose from"):
        run_trials(gliding, 1, num_plans=2, seed=0, num_workers=1, path=tmp_path)
