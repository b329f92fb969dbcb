import functools
from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Role

from balancing_loops import PACKAGED, packaged_loop, standing_loop, started
from drake_safety import load_assessment, load_scenario, run_episode
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing.sampling import throw_start
from drake_safety.diagrams.balancing.throws import run_throw
from drake_safety.plants.balls import Throw
from legged_robots import robot_kinematics
from system_doubles import begun

ROBOTS = (PACKAGED, "hexapod")
MASS_KG = 25.433


@functools.cache
def episode_of(robot=PACKAGED, variation="nominal"):
    return run_episode(standing_loop(robot, variation))


@pytest.mark.parametrize("name", ROBOTS)
def test_any_robot_with_feet_stands_for_two_seconds_within_five_millimetres(name):
    episode = episode_of(name)
    assert episode.is_safe and episode.time_s[-1] == pytest.approx(2.0)
    error = np.linalg.norm(episode.output - episode.desired_output, axis=1)
    assert error.max() < 0.005


def test_noise_follows_from_the_generator_and_is_held_for_a_control_period():
    loop = standing_loop(variation="noisy")

    def noise(seed, time_s):
        start = np.random.default_rng(seed), loop.standing_start()
        simulator, context = begun(loop, loop.reset_to, *start)
        simulator.AdvanceTo(time_s)
        measured, true = (loop.GetOutputPort(n).Eval(context) for n in ("state", "true_state"))
        return (measured - true)[:12]

    np.testing.assert_array_equal(noise(0, 0.011), noise(0, 0.011))
    np.testing.assert_allclose(noise(0, 0.019), noise(0, 0.011), atol=1e-3)
    for other in (noise(1, 0.011), noise(0, 0.021)):
        assert np.abs(other - noise(0, 0.011)).max() > 2e-3


def test_the_plant_has_the_variations_mass_and_the_controller_the_nominal_one():
    loop = standing_loop(variation="light")
    _, context = started(loop)
    mass = loop.plant.CalcTotalMass(loop.plant.GetMyContextFromRoot(context), [loop.robot_instance])
    assert mass == pytest.approx(0.8 * MASS_KG, abs=0.001)
    assert loop.kinematics.total_mass == pytest.approx(MASS_KG, abs=0.001)
    actual = load_scenario("laikago_balancing").make_loop("actual", ball=False)
    assert actual.kinematics.total_mass == pytest.approx(0.8 * MASS_KG, abs=0.001)


def test_feet_and_ground_have_the_variations_friction():
    loop = standing_loop(variation="slippery")
    inspector = loop.GetSubsystemByName("scene_graph").model_inspector()
    slippery = []
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        properties = inspector.GetProximityProperties(geometry)
        friction = properties.GetProperty("material", "coulomb_friction").static_friction()
        if friction == 0.123:
            slippery.append(inspector.GetName(geometry))
    assert len(slippery) == len(loop.robot.feet) + 1
    assert any("ground" in name for name in slippery)


def test_noise_is_only_where_it_was_configured():
    quiet, noisy, blurred = (episode_of(variation=v) for v in ("nominal", "noisy", "blurred"))
    np.testing.assert_array_equal(quiet.state, quiet.true_state)
    # Noise on the assessor's input alone: the motion is the quiet one's, to the bit.
    np.testing.assert_array_equal(blurred.true_state, quiet.true_state)
    np.testing.assert_array_equal(blurred.output, quiet.output)
    # Noise on the measured state: output and state both show it.
    assert np.abs(noisy.output[:, 2] - noisy.true_state[:, 2]).max() > 0.004
    n_j = robot_kinematics(PACKAGED).num_joints
    for episode in (noisy, blurred):
        assert np.abs(episode.features - quiet.features).max() > 1e-4
        error = episode.state - episode.true_state
        assert np.std(error[:, 12 : 12 + n_j]) == pytest.approx(0.004, rel=0.15)
        assert np.std(error[:, 12 + n_j :]) == pytest.approx(0.016, rel=0.15)
    other = run_episode(standing_loop(variation="blurred"), 1)
    errors = [(one.state - one.true_state)[:, 12:].ravel() for one in (blurred, other)]
    assert abs(np.corrcoef(errors)[0, 1]) < 0.1


def test_a_loop_without_a_ball_says_how_to_get_one_and_a_parked_one_changes_nothing():
    loop = standing_loop()
    with pytest.raises(ValueError, match="without a ball; pass ball=True"):
        loop.throw_ball(loop.CreateDefaultContext(), Throw(), 0.1)
    with_ball = run_episode(standing_loop(variation="nominal", ball=True))
    np.testing.assert_allclose(with_ball.true_state, episode_of().true_state, atol=1e-6)


def test_servo_load_is_the_commanded_minus_the_measured_position():
    loop = standing_loop()
    joints = loop.kinematics.joint_names
    assert loop.feature_names[-len(joints) :] == [f"servo_load_{joint}" for joint in joints]
    simulator, context = started(loop)
    ports = {
        "inverse_kinematics_controller": "desired_joint_state",
        "observer": "measured_plant_state",
    }
    for time in (0.0, 0.5):
        simulator.AdvanceTo(time)
        command, measured = (
            system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(context))
            for system, port in ((loop.GetSubsystemByName(n), p) for n, p in ports.items())
        )
        load = loop.GetOutputPort("features").Eval(context)[-len(joints) :]
        expected = command[: len(joints)] - measured[7 : 7 + len(joints)]
        np.testing.assert_allclose(load, expected, atol=1e-12)
    # At rest the servos carry the robot: load times stiffness is the static torque.
    assert np.abs(load).max() > 1e-3


@pytest.mark.parametrize("elapsed_s", [0.0, 0.4, 2.0])
def test_a_calm_start_is_a_point_of_its_motion_with_the_motions_velocity(elapsed_s):
    kinematics = robot_kinematics(PACKAGED)
    options = {"half_widths_m": [0.05, 0.03], "plan_duration_s": [1.0, 1.0]}
    start = throw_start(kinematics, np.random.default_rng(1), elapsed_s=elapsed_s, **options)
    assert start.plan.start_time() == -elapsed_s
    np.testing.assert_allclose(start.q[4:7], start.plan.value(0.0).ravel())
    np.testing.assert_allclose(kinematics.contact_jacobian(start.q) @ start.v, 0.0, atol=1e-6)
    is_moving = np.linalg.norm(start.v[3:6]) > 1e-3
    assert is_moving == (0.0 < elapsed_s < 1.0)


def test_a_low_probability_makes_the_robot_step_and_balance_again():
    loop = standing_loop(PACKAGED, recovery=True)
    probability = loop.GetInputPort("safety_probability")
    simulator, context = started(loop)
    probability.FixValue(context, [1.0])
    rows = []
    for step in range(181):
        time = 0.01 * step
        simulator.AdvanceTo(time)
        probability.FixValue(context, [0.0 if abs(time - 0.2) < 0.011 else 1.0])
        x = loop.GetOutputPort("plant_state").Eval(context)
        p_WC = loop.kinematics.contact_positions(x[: loop.kinematics.num_positions])
        active = loop.GetOutputPort("recovery_active").Eval(context)[0]
        margins = loop.GetOutputPort("margins").Eval(context)
        rows.append((time, active, p_WC[:, 2] - loop.kinematics.foot_radii, margins))
    time, active, clearance, margins = (np.array(column) for column in zip(*rows, strict=True))
    start, end = time[active > 0][[0, -1]]
    assert 0.2 <= start <= 0.2 + 0.021 and end < time[-1]
    assert np.all(active[(time >= start) & (time <= end)] > 0)
    assert clearance[time < 0.2].max() < 0.005
    assert np.all(clearance[active > 0].max(axis=0) > 0.01)  # Every foot swung.
    assert margins[-1].min() > 0 and clearance[-1].max() < 0.005


@pytest.mark.parametrize("on_alarm", ["unknown", "report"])
def test_in_a_lasting_alarm_the_robot_steps_by_gamma_alone(on_alarm):
    scenario = load_scenario("laikago_balancing", {"on_alarm": on_alarm})
    gamma = load_assessment("laikago_balancing")
    gamma.detector_ = replace(gamma.detector_, alarm_level=-1.0)
    weak, strong = scenario.parameters.demonstration
    loop = scenario.make_loop("nominal", assessment=gamma, ball=True)
    throws = [replace(weak, time_s=0.4), replace(strong, time_s=1.2)]
    log = run_throw(
        loop, 0, seed=7_000_000, throws=throws, duration_s=1.5, ports=["alarm", "belief"]
    )
    is_unknown = (log["belief"][5:] == [0.0, 0.0, 1.0]).all()
    assert log["alarm"][5:].all() and is_unknown == (on_alarm == "unknown")
    ((start_s, _),) = log.recovery_intervals_s
    assert 1.2 < start_s < 1.3


def test_during_recovery_features_and_preview_are_of_the_same_plan():
    loop = packaged_loop(recovery=True)
    simulator, context = started(loop)
    loop.GetInputPort("safety_probability").FixValue(context, [0.0])
    observer = loop.GetSubsystemByName("assessor_observer")
    safe_set = BalanceSafeSet(loop.kinematics, loop.scenario.parameters.safe_set)
    for time in (0.05, 0.3, 0.55):
        simulator.AdvanceTo(time)
        assert loop.GetOutputPort("recovery_active").Eval(context)[0] == 1.0
        own_context = observer.GetMyContextFromRoot(context)
        x = observer.GetOutputPort("measured_plant_state").Eval(own_context)
        # The recovery's plan is a set point that is held.
        preview = loop.GetOutputPort("desired_preview").Eval(context).reshape(-1, 3)
        expected = safe_set.features(*np.split(x, [loop.kinematics.num_positions]), preview)
        features = loop.GetOutputPort("features").Eval(context)
        np.testing.assert_allclose(features[: len(expected)], expected, atol=1e-12)
