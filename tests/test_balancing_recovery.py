from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import Simulator

from balancing_loops import PACKAGED, packaged_loop, standing_loop, started
from drake_safety import load_assessment, load_scenario
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing.throws import run_throw


def test_a_low_probability_makes_the_robot_step_and_hand_over_again():
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
    assert not active[time < 0.2].any()
    start, end = time[active > 0][[0, -1]]
    assert start <= 0.2 + 0.021
    assert end < time[-1]
    assert np.all(active[(time >= start) & (time <= end)] > 0)
    assert clearance[time < 0.2].max() < 0.005
    assert np.all(clearance[active > 0].max(axis=0) > 0.01)  # Every foot swung.
    assert margins[-1].min() > 0
    assert clearance[-1].max() < 0.005


def test_in_an_alarm_that_lasts_the_robot_steps_when_gamma_says_so_and_not_for_ever():
    scenario, gamma = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    gamma.detector_ = replace(gamma.detector_, alarm_level=-1.0)
    scenario.on_alarm = "unknown"
    weak, strong = scenario.parameters.demonstration
    loop = scenario.make_loop("nominal", assessment=gamma, ball=True)
    log = run_throw(
        loop,
        0,
        seed=7_000_000,
        throws=[replace(weak, time_s=0.4), replace(strong, time_s=1.2)],
        duration_s=1.5,
        ports=["alarm", "belief"],
    )
    assert log["alarm"][5:].all() and (log["belief"][5:] == [0.0, 0.0, 1.0]).all()
    ((start_s, _),) = log.recovery_intervals_s
    assert 1.2 < start_s < 1.3


def test_during_recovery_features_and_preview_tell_of_the_same_plan():
    loop = packaged_loop(recovery=True)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset(context, np.random.default_rng(0))
    loop.GetInputPort("safety_probability").FixValue(context, [0.0])
    observer = loop._assessor_observer
    safe_set = BalanceSafeSet(loop.kinematics, loop.scenario.parameters.safe_set)
    num_active = 0
    for time in np.arange(0.05, 0.6, 0.05):
        simulator.AdvanceTo(time)
        num_active += loop.GetOutputPort("recovery_active").Eval(context)[0]
        x = observer.GetOutputPort("measured_plant_state").Eval(
            observer.GetMyContextFromRoot(context)
        )
        # The recovery's plan is a set point that is held.
        preview = loop.GetOutputPort("desired_preview").Eval(context).reshape(-1, 3)
        q, v = np.split(x, [loop.kinematics.num_positions])
        features = loop.GetOutputPort("features").Eval(context)
        expected = safe_set.features(q, v, preview)
        np.testing.assert_allclose(features[: len(expected)], expected, atol=1e-12)
    assert num_active == 11


def test_recovery_from_the_demonstrations_strong_ball_is_short_and_holds_the_heading():
    loop = packaged_loop("actual", ball=True, recovery=True)
    throw = loop.scenario.parameters.demonstration[1]
    log = run_throw(
        loop, 0, seed=0, throws=[replace(throw, time_s=0.5)], trigger_time_s=0.52, duration_s=2.6
    )
    assert not log.has_fallen
    ((start_s, end_s),) = log.recovery_intervals_s
    step = loop.scenario.parameters.recovery.step
    assert end_s - start_s < 13 * step.step_duration_s + step.return_duration_s
    w, x, y, z = log["plant_state"][:, :4].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    turned = yaw - yaw[log.time_s < 0.5][-1]
    assert np.abs(turned).max() < np.radians(30)
    assert abs(turned[-1]) < np.radians(15)
