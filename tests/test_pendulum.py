import math
from dataclasses import replace

import numpy as np
import pytest

from drake_safety import SafetyAssessment, load_scenario, run_episodes
from drake_safety.diagrams.pendulum.task import PendulumController, PendulumParameters, bob_position
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.rollouts import run_episode
from system_doubles import Bench

LENGTH_M, PERIOD_S = 0.5, 0.01


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("pendulum")


@pytest.fixture(scope="module")
def loop(scenario):
    return scenario.make_loop()


def start(loop, angle, rate, goal=0.0):
    return EpisodeStart(q=np.array([angle]), v=np.array([rate]), plan=loop.plan(0.0, goal, 1.0))


def test_the_pendulum_follows_its_plan(loop):
    episode = run_episode(loop, start=start(loop, 0.0, 0.0, goal=0.2))
    assert episode.is_safe
    expected = LENGTH_M * np.array([math.sin(0.2), 0.0, math.cos(0.2)])
    np.testing.assert_allclose(episode.desired_output[-1], expected, atol=1e-9)
    np.testing.assert_allclose(episode.output[-1], expected, atol=2e-3)


def test_beyond_the_angle_that_the_motor_holds_there_is_no_way_back(scenario, loop):
    hold, heavy = loop.scenario.parameters.hold_angle_rad, scenario.make_loop("actual")
    assert run_episode(loop, start=start(loop, hold - 0.015, 0.0)).is_safe
    assert not run_episode(heavy, start=start(heavy, hold - 0.015, 0.0)).is_safe
    lost = run_episode(loop, start=start(loop, hold + 0.02, 0.0))
    assert (lost.is_safe, lost.cause) == (False, "front")
    assert run_episode(loop, start=start(loop, -hold - 0.02, 0.0)).cause == "back"


def test_what_a_plan_asks_of_the_motor_is_that_of_its_minimum_jerk(loop):
    context = loop.CreateDefaultContext()
    plan = loop.plan(-0.24, 0.24, 1.0)
    loop.reset_to(context, None, EpisodeStart(q=np.zeros(1), v=np.zeros(1), plan=plan))
    features = loop.GetOutputPort("features").Eval(context)
    values = dict(zip(loop.feature_names, features, strict=True))
    t = np.linspace(0.0, 1.0, 2001)
    share = 2.0 * (10 * t**3 - 15 * t**4 + 6 * t**5) - 1.0
    angle = np.arctan2(LENGTH_M * math.sin(0.24) * share, LENGTH_M * math.cos(0.24))
    rate = np.gradient(angle, t)
    time_s = math.sqrt(LENGTH_M / 9.81)
    capture = angle + time_s * rate
    effort = time_s**2 * np.gradient(rate, t) - np.sin(angle)
    hold = math.asin(0.35)
    assert values["plan_capture_reserve_front"] == pytest.approx(hold - capture.max(), abs=0.005)
    assert values["plan_capture_reserve_back"] == pytest.approx(hold + capture.min(), abs=0.005)
    assert values["plan_effort_reserve_front"] == pytest.approx(0.35 + effort.min(), abs=0.01)
    assert values["plan_effort_reserve_back"] == pytest.approx(0.35 - effort.max(), abs=0.01)


@pytest.mark.train
def test_gamma_finds_the_true_safe_set_from_few_episodes(scenario, loop):
    parameters = replace(scenario.assessment, ensemble_size=1, perplexity=20.0)
    gamma = SafetyAssessment(parameters).fit(run_episodes(scenario, 160, num_workers=1))
    angles, rates = np.linspace(-0.5, 0.5, 9), np.linspace(-1.5, 1.5, 9)
    motions = [run_episode(loop, start=start(loop, a, r)) for a in angles for r in rates]
    is_safe = np.array([motion.is_safe for motion in motions])
    rows = [(one.state[0], one.desired_preview[0], one.features[0]) for one in motions]
    is_accepted = np.array([gamma.predict_one(*row).probability >= 0.5 for row in rows])
    assert 0.2 < is_safe.mean() < 0.8
    assert np.sum(is_safe & is_accepted) / np.sum(is_safe | is_accepted) >= 0.75
    # The pendulum is the same in the mirror, and so is what becomes of it.
    np.testing.assert_array_equal(is_safe, is_safe[::-1])


@pytest.mark.parametrize(
    ("effort_share", "state", "angle", "rate", "expected"),
    [
        # 20 (0.1 - 0.05) + 3 (0.4 - 0.2) - 1 * 9.81 * 0.5 sin(0.05) [N·m].
        (0.999, [0.05, 0.2], 0.1, 0.4, 20.0 * 0.05 + 3.0 * 0.2 - 4.905 * math.sin(0.05)),
        (0.35, [0.0, 0.0], 0.3, 0.0, 0.35 * 4.905),  # At its limit.
        (0.35, [0.0, 0.0], -0.3, 0.0, -0.35 * 4.905),
    ],
)
def test_the_torque_is_of_both_errors_less_the_weights_within_its_limit(
    effort_share, state, angle, rate, expected
):
    parameters = PendulumParameters(effort_share=effort_share)
    velocity = rate * LENGTH_M * np.array([math.cos(angle), 0.0, -math.sin(angle)])
    bench = Bench(PendulumController(parameters, PERIOD_S), plant_state=state)
    bench.fix(desired_output=bob_position(angle, LENGTH_M), desired_output_rate=velocity)
    bench.advance(0.1 * PERIOD_S)
    assert bench.get("torque")[0] == pytest.approx(expected, abs=1e-12)
