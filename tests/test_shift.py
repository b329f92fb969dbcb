"""Shifts: lasting conditions of plant and sensors, as data of a plant variation."""

import dataclasses
import math

import numpy as np
import pytest

from drake_safety import load_scenario
from drake_safety.models import load_robot
from drake_safety.robots.shift import Fault, JointShift, Shift
from drake_safety.simulation.rollouts import run_episode
from system_doubles import begun

SCENARIO = "laikago_balancing"
KNEE = "FR_calf_joint"


def loop_with(shift, engine="drake"):
    scenario = load_scenario(SCENARIO)
    nominal = scenario.variations["nominal"]
    scenario.variations["shifted"] = dataclasses.replace(nominal, engine=engine, shift=shift)
    return scenario.make_loop("shifted", **({} if engine == "drake" else {"ball": False}))


def standing(shift, seconds, height_m=0.0):
    """The diagram and its Context after standing, or falling from a height, for a while."""
    loop = loop_with(shift)
    start = loop.standing_start()
    start.q[6] += height_m
    simulator, context = begun(loop, loop.reset_to, None, start)
    simulator.AdvanceTo(seconds)
    return loop, context


def positions(loop, context):
    return loop.GetOutputPort("plant_state").Eval(context)[: loop.kinematics.num_positions]


def test_a_slope_turns_the_gravity_and_keeps_its_magnitude():
    shift = Shift(slope_rad=0.2, slope_direction_rad=0.5 * math.pi)
    gravity = loop_with(shift).plant.gravity_field().gravity_vector()
    expected = 9.81 * np.array([0.0, math.sin(0.2), -math.cos(0.2)])
    np.testing.assert_allclose(gravity, expected, atol=1e-12)


def test_a_steady_force_is_as_large_as_stated_and_in_its_direction():
    force_n = np.array([-2.0, 3.0, 4.0])
    momenta = []
    for shift in (None, Shift(base_force_n=force_n.tolist())):
        loop, context = standing(shift, 0.2, height_m=5.0)
        plant_context = loop.plant.GetMyContextFromRoot(context)
        momentum = loop.plant.CalcSpatialMomentumInWorldAboutPoint(plant_context, np.zeros(3))
        momenta.append(momentum.translational())
    np.testing.assert_allclose((momenta[1] - momenta[0]) / 0.2, force_n, rtol=0.01, atol=0.02)


def test_a_weak_joint_has_less_torque_and_a_soft_one_lower_gains():
    weaker = Shift(joints={KNEE: JointShift(effort_scale=0.5, stiffness_scale=0.25)})
    plain, shifted = loop_with(None).plant, loop_with(weaker).plant

    def actuator(plant, joint):
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
        return next(each for each in actuators if each.joint().name() == joint)

    weak, strong = actuator(shifted, KNEE), actuator(plain, KNEE)
    assert weak.effort_limit() == 0.5 * strong.effort_limit()
    gains, usual = weak.get_controller_gains(), strong.get_controller_gains()
    assert (gains.p, gains.d) == (0.25 * usual.p, 0.25 * usual.d)
    other = "FL_calf_joint"
    assert actuator(shifted, other).effort_limit() == actuator(plain, other).effort_limit()


def test_a_locked_joint_does_not_move():
    lock = Shift(joints={KNEE: JointShift(is_locked=True)})
    knee = 12 + loop_with(None).kinematics.joint_names.index(KNEE)
    episodes = [run_episode(loop_with(shift), 3, seed=11) for shift in (None, lock)]
    moves = [np.ptp(episode.true_state[:, knee]) for episode in episodes]
    assert moves[0] > 0.02 and moves[1] < 1e-3


def test_feet_over_holes_find_the_ground_lower():
    feet = list(load_robot("laikago").feet)
    plain = positions(*standing(None, 0.5))
    all_lower = positions(*standing(Shift(holes_m=dict.fromkeys(feet, 0.03)), 0.5))
    assert all_lower[6] - plain[6] == pytest.approx(-0.03, abs=0.004)
    # A foot alone over a hole carries nothing: the robot leans to it.
    rolls = [positions(*standing(Shift(holes_m={foot: 0.03}), 0.5))[1] for foot in ("FR", "FL")]
    assert rolls[0] > 1e-3 > -1e-3 > rolls[1]


def test_a_foot_on_ice_has_the_stated_friction_with_the_ground():
    robot = load_robot("laikago")
    ground, coefficients = robot.foot_friction, {}
    loop = loop_with(Shift(foot_friction={"FR": 0.1, "FL": ground}))
    inspector = loop.scene_graph.model_inspector()
    for name, foot in robot.feet.items():
        body = loop.plant.GetBodyByName(foot.body)
        for geometry in loop.plant.GetCollisionGeometriesForBody(body):
            properties = inspector.GetProximityProperties(geometry)
            mu = properties.GetProperty("material", "coulomb_friction").static_friction()
            coefficients.setdefault(name, []).append(2.0 * mu * ground / (mu + ground))
    assert min(coefficients.pop("FR")) == pytest.approx(0.1)
    for others in coefficients.values():
        assert max(others) == pytest.approx(ground)
    with pytest.raises(ValueError, match=r"friction of foot 'FR' must be below twice .*; got 5"):
        loop_with(Shift(foot_friction={"FR": 5.0}))
    with pytest.raises(ValueError, match="foot for friction"):
        loop_with(Shift(foot_friction={"paw": 0.1}))


def test_gravity_is_scaled():
    gravity = loop_with(Shift(gravity_scale=1.1)).plant.gravity_field().gravity_vector()
    np.testing.assert_allclose(gravity, [0.0, 0.0, -1.1 * 9.81], atol=1e-12)


def test_a_motor_that_weakens_ends_without_torque():
    knee = loop_with(None).kinematics.joint_names.index(KNEE)
    entries = [KNEE, f"{KNEE}_rate"]
    fade = Shift(command_faults=[Fault(kind="fade", entries=entries, value=0.1)])
    loop, context = standing(fade, 0.2)
    system = loop.GetSubsystemByName("command_faults")
    received = system.get_output_port().Eval(system.GetMyContextFromRoot(context))
    states = loop.GetOutputPort("plant_state").Eval(context)
    num_joints = loop.kinematics.num_joints
    assert received[knee] == states[7 + knee]
    assert received[num_joints + knee] == states[loop.kinematics.num_positions + 6 + knee]


def command(shift, time_s):
    """The joint states that the controller sends, and those that the servos receive."""
    loop, context = standing(shift, time_s)
    system = loop.GetSubsystemByName("command_faults")
    own = system.GetMyContextFromRoot(context)
    return system.get_input_port().Eval(own), system.get_output_port().Eval(own)


def test_a_joint_gets_a_faulty_command_from_the_start_of_the_fault_and_a_late_one_is_late():
    shift = Shift(command_faults=[Fault(kind="zero", entries=[KNEE], start_s=0.1)])
    knee = loop_with(None).kinematics.joint_names.index(KNEE)
    np.testing.assert_array_equal(*command(shift, 0.05))
    sent, received = command(shift, 0.2)
    assert sent[knee] != 0.0 == received[knee]
    np.testing.assert_array_equal(np.delete(received, knee), np.delete(sent, knee))
    late = Shift(command_delay_s=0.1)
    np.testing.assert_allclose(command(late, 0.2)[1], command(late, 0.1)[0], atol=2e-3)


RATES = Fault(kind="zero", entries=[".*_w", "trunk_[wv]."])
DELAY = Fault(kind="delay", value=0.2)


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        (RATES, lambda s, t: np.allclose(s[:, np.r_[6:12, 24 : s.shape[1]]], 0.0)),
        (DELAY, lambda s, t: np.allclose(s[8:, 12], t[3:-5, 12], atol=0.02)),
    ],
)
def test_a_faulty_input_does_not_change_the_motion(fault, seen):
    plain = run_episode(loop_with(None), 0, seed=5)
    episode = run_episode(loop_with(Shift(sensor_faults=[fault])), 0, seed=5)
    np.testing.assert_array_equal(episode.true_state, plain.true_state)
    assert seen(episode.state, episode.true_state)
    assert not seen(plain.state, plain.true_state)


def test_a_plant_without_shift_has_the_hash_from_before_there_were_any():
    scenario = dataclasses.replace(load_scenario(SCENARIO), family=None)
    assert "shift" not in scenario.to_yaml()
    before = scenario.simulation_hash("nominal")
    scenario.variations["nominal"].shift = Shift(slope_rad=0.1)
    assert scenario.simulation_hash("nominal") != before


@pytest.mark.parametrize(
    ("shift", "message"),
    [
        (Shift(joints={"elbow": JointShift(is_locked=True)}), "no joint for shift 'elbow'; it has"),
        (Shift(sensor_faults=[Fault(kind="zero", entries=["elbow_q"])]), "no entry 'elbow_q'"),
    ],
)
def test_a_shift_of_a_part_that_does_not_exist_is_refused(shift, message):
    with pytest.raises(ValueError, match=message):
        loop_with(shift)
    with pytest.raises(ValueError, match="engine 'mujoco' has no shifts"):
        loop_with(shift, engine="mujoco")
