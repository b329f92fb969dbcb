import copy

import numpy as np
import pytest

from drake_safety import SafetyAssessment, load_scenario, run_episodes
from drake_safety.assessments import load_assessment
from drake_safety.diagrams.balancing.throws import VIOLATIONS, run_throw
from drake_safety.plants.balls import Throw
from drake_safety.robots.robot import PlantVariation

pytestmark = pytest.mark.slow

HARD = Throw(time_s=0.4, mass_kg=3.0, speed_m_s=8.0, direction_rad=-1.2)


@pytest.fixture(scope="module")
def scenario():
    scenario = load_scenario("laikago_balancing")
    scenario.assessment.epochs = 12
    scenario.assessment.ensemble_size = 2
    scenario.assessment.hidden_sizes = [64, 64]
    return scenario


@pytest.fixture(scope="module")
def episodes(scenario):
    return run_episodes(scenario, 128, seed=3)


@pytest.fixture(scope="module")
def assessment(scenario, episodes, tmp_path_factory):
    path = tmp_path_factory.mktemp("assessment") / "sharpened.safetensors"
    SafetyAssessment(scenario.assessment).fit(episodes).save(path)
    return SafetyAssessment.load(path)


def test_gamma_tells_unsafe_episodes_from_safe_ones_shortly_before_the_end(
    scenario, episodes, assessment
):
    assert any(episode.first_step == 1 for episode in episodes), "some begin as a ball hits"
    fresh = run_episodes(scenario, 24, seed=4)
    last = []
    for episode in fresh:
        row = max(episode.num_steps - 3, episode.first_step)
        result = assessment.predict(
            episode.state[row : row + 1],
            episode.desired_preview[row : row + 1],
            episode.features[row : row + 1],
        )
        last.append(result.belief[0, 0])
    is_safe = np.array([episode.is_safe for episode in fresh])
    assert np.mean(np.array(last)[is_safe]) - np.mean(np.array(last)[~is_safe]) > 0.2


def test_gamma_in_the_diagram_is_gamma_on_the_log(scenario, assessment):
    # Without measurement noise, of which every reading at an instant may be a fresh draw.
    quiet = copy.deepcopy(scenario)
    quiet.variations["quiet"] = PlantVariation(joint_friction_nm=0.4)
    loop = quiet.make_loop("quiet", assessment=assessment, recovery=False, ball=True)
    ports = ("safety_probability", "belief")
    log = run_throw(loop, 0, seed=8, throws=[HARD], duration_s=1.0, ports=ports)
    result = assessment.predict(log["state"], log["desired_preview"], log["features"])
    # Outside the safe set nothing is safe.
    is_outside = log["margins"].min(axis=1) < 0.0
    assert is_outside.any() and not is_outside.all()
    belief = result.belief.copy()
    belief[is_outside, 1] += belief[is_outside, 0]
    belief[is_outside, 0] = 0.0
    inside = ~is_outside[:, None]
    # A row shows the state before the updates of its instant: Γ of a row is published in the next.
    for name, expected in (
        ("safety_probability", result.probability[:, None] * inside),
        ("belief", belief),
    ):
        np.testing.assert_allclose(log[name][1:], expected[:-1], atol=1e-5)
    assert np.ptp(result.belief[:, 0]) > 0.35


def test_gamma_falls_at_the_hit_and_recovery_saves_the_robot():
    # A map of a few episodes raises false alarms too; the one that comes along has to do better.
    scenario, assessment = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    alone = scenario.make_loop("actual", assessment=assessment, recovery=False, ball=True)
    log = run_throw(alone, 0, seed=8, throws=[HARD], duration_s=2.5)
    assert log.has_fallen
    loop = scenario.make_loop("actual", assessment=assessment, ball=True)
    log = run_throw(loop, 0, seed=8, throws=[HARD], duration_s=3.0)
    assert not log.has_fallen
    assert HARD.time_s < log.recovery_intervals_s[0][0] < HARD.time_s + 0.1
    violated = dict(zip(VIOLATIONS, log["violations"].any(axis=0), strict=True))
    assert not (violated["legs_collide"] or violated["joint_position"] or violated["joint_effort"])
