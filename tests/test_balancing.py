import functools

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.systems.analysis import Simulator

from balancing_loops import PACKAGED, packaged_loop, scenario_of, standing_loop, started
from drake_safety import load_scenario, run_episode
from drake_safety.plants.balls import Throw
from drake_safety.simulation.motion import Recorder
from drake_safety.simulation.scenario import parse_scenario
from legged_robots import ROBOT_NAMES, edited, robot_kinematics, write_hexapod


@functools.cache
def episode_of(robot=PACKAGED, variation="nominal"):
    return run_episode(standing_loop(robot, variation))


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_any_robot_with_feet_stands_for_two_seconds_within_five_millimetres(name):
    episode = episode_of(name)
    assert episode.is_safe
    assert episode.time_s[-1] == pytest.approx(2.0)
    error = np.linalg.norm(episode.output - episode.desired_output, axis=1)
    assert error.max() < 0.005


def test_the_packaged_robot_stands_on_the_actual_plant_too():
    scenario = load_scenario("laikago_balancing")
    standing = scenario_of(PACKAGED)
    scenario.parameters = standing.parameters
    episode = run_episode(scenario.make_loop("actual"))
    assert episode.is_safe
    true_height = episode.true_state[:, 2]
    assert np.abs(true_height - robot_kinematics(PACKAGED).standing_height).max() < 0.01


def test_without_an_assessment_or_recovery_nothing_is_promised_of_them():
    loop = standing_loop()
    assert not loop.HasOutputPort("recovery_active")
    assert loop.num_input_ports() == 0


def test_a_robot_without_gains_is_refused(tmp_path):
    edited(write_hexapod(tmp_path), joint_gains={})
    scenario = parse_scenario(
        "task: drake_safety.diagrams.balancing:Balancing\nrobot: robot.yaml\n"
        "variations: {nominal: {}}",
        name="weak",
        folder=tmp_path,
    )
    with pytest.raises(ValueError, match="stiffness must be 18 positive numbers"):
        scenario.make_loop()


@pytest.mark.parametrize(("variation", "scale"), [("nominal", 1.0), ("light", 0.8)])
def test_the_variations_mass_is_the_plants(variation, scale):
    loop = standing_loop(variation=variation)
    _, context = started(loop)
    mass = loop.plant.CalcTotalMass(loop.plant.GetMyContextFromRoot(context), [loop.robot_instance])
    assert mass == pytest.approx(scale * 25.433, abs=0.001)


def test_the_controller_believes_in_the_nominal_mass_whatever_the_plants_is():
    scenario = load_scenario("laikago_balancing")
    actual, nominal = scenario.make_loop("actual"), scenario.make_loop("nominal")
    assert actual.kinematics.total_mass == nominal.kinematics.total_mass
    assert actual.kinematics.total_mass == pytest.approx(0.8 * 25.433, abs=0.001)


def test_feet_and_ground_take_the_variations_friction():
    loop = standing_loop(variation="slippery")
    inspector = loop.GetSubsystemByName("scene_graph").model_inspector()
    found = []
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        properties = inspector.GetProximityProperties(geometry)
        friction = properties.GetProperty("material", "coulomb_friction").static_friction()
        if friction == 0.123:
            found.append(inspector.GetName(geometry))
    assert len(found) == len(loop.robot.feet) + 1
    assert any("ground" in name for name in found)


@functools.cache
def joint_motion(variation):
    """Largest joint motion in the tenth of a second after a small shift of the set points."""
    loop = standing_loop(variation=variation)
    simulator, context = started(loop)
    simulator.AdvanceTo(0.3)
    plant_context = loop.plant.GetMyContextFromRoot(context)
    before = loop.plant.GetPositions(plant_context, loop.robot_instance)[7:].copy()
    controller = loop.GetSubsystemByName("inverse_kinematics_controller")
    feet = np.column_stack([loop.kinematics.nominal_contacts, loop.kinematics.foot_radii])
    # Half a millimetre at the feet asks the servos for some 1.1 N·m.
    controller.set_foot_positions(
        controller.GetMyMutableContextFromRoot(context), feet - [0.0, 0.0, 0.0005]
    )
    simulator.AdvanceTo(0.4)
    after = loop.plant.GetPositions(plant_context, loop.robot_instance)[7:]
    return np.abs(after - before).max()


def test_dry_friction_holds_the_joints_against_small_commands():
    assert joint_motion("rough") < 0.5 * joint_motion("nominal")


def test_dry_friction_is_no_part_of_the_nominal_plant():
    smooth, rough = standing_loop(), standing_loop(variation="rough")
    count = smooth.plant.num_actuators(smooth.robot_instance)
    assert rough.plant.num_actuators(rough.robot_instance) == 2 * count


def test_every_servo_follows_its_own_joint():
    for variation in ("nominal", "rough"):
        loop = standing_loop("biped", variation)
        simulator, context = started(loop)
        simulator.AdvanceTo(0.5)
        plant_context = loop.plant.GetMyContextFromRoot(context)
        q = loop.plant.GetPositions(plant_context, loop.robot_instance)[7:]
        np.testing.assert_allclose(q, loop.kinematics.posture, atol=0.02)


def test_noise_stands_only_where_it_was_configured():
    quiet, noisy, blurred = (episode_of(variation=v) for v in ("nominal", "noisy", "blurred"))
    np.testing.assert_array_equal(quiet.state, quiet.true_state)
    # Noise on the assessor's input alone: the motion is the quiet one's, to the bit.
    np.testing.assert_array_equal(blurred.true_state, quiet.true_state)
    np.testing.assert_array_equal(blurred.output, quiet.output)
    assert not np.array_equal(blurred.state, blurred.true_state)
    # Noise on what is measured: output and state both show it.
    assert np.abs(noisy.output[:, 2] - noisy.true_state[:, 2]).max() > 0.004
    for episode in (noisy, blurred):
        assert np.abs(episode.features - quiet.features).max() > 1e-4


@pytest.mark.parametrize("variation", ["noisy", "blurred"])
def test_noise_has_its_standard_deviation(variation):
    episode = episode_of(variation=variation)
    error = episode.state - episode.true_state
    n_j = robot_kinematics(PACKAGED).num_joints
    assert np.std(error[:, 12 : 12 + n_j]) == pytest.approx(0.004, rel=0.15)
    assert np.std(error[:, 12 + n_j :]) == pytest.approx(0.016, rel=0.15)


def test_every_episode_has_noise_of_its_own():
    errors = []
    for index in (0, 1):
        episode = run_episode(standing_loop(variation="blurred"), index)
        errors.append((episode.state - episode.true_state)[:, 12:].ravel())
    assert abs(np.corrcoef(errors)[0, 1]) < 0.1


PORTS = ("state", "true_state", "desired_output", "features", "margins")


@pytest.mark.parametrize("variation", ["nominal", "actual"])
def test_a_reset_is_the_same_for_the_same_generator(variation):
    rows = []
    for _ in range(2):
        simulator, context = started(packaged_loop(variation), seed=3)
        recorder = Recorder(packaged_loop(variation), PORTS)
        for time in (0.0, 0.05, 0.1):
            simulator.AdvanceTo(time)
            recorder.record(context)
        rows.append(recorder.arrays())
    for name in PORTS:
        np.testing.assert_array_equal(rows[0][name], rows[1][name])
    _, context = started(packaged_loop(variation), seed=4)
    other = packaged_loop(variation).GetOutputPort("true_state").Eval(context)
    assert not np.allclose(other, rows[0]["true_state"][0])


def test_starts_are_inside_the_ranges_that_the_scenario_gives():
    loop = packaged_loop()
    sampling = loop.scenario.parameters.start
    names = loop.state_names
    first_steps = set()
    for seed in range(60):
        context = loop.CreateDefaultContext()
        first_steps.add(loop.reset(context, np.random.default_rng(seed)))
        state = loop.GetOutputPort("true_state").Eval(context)
        lowest, highest = loop.kinematics.position_limits.T
        joints = state[12 : 12 + loop.kinematics.num_joints]
        assert np.all((joints >= lowest) & (joints <= highest))
        height = state[names.index("base_z")]
        offset_m = sampling.tracking_offset_m[2]
        assert (
            sampling.base_height_m[0] - offset_m <= height <= sampling.base_height_m[1] + offset_m
        )
        assert np.abs(state[3:5]).max() < 2 * sampling.tilt_rad
    assert first_steps == {0, 1}


def test_a_loop_without_a_ball_says_how_to_get_one():
    loop = standing_loop()
    with pytest.raises(ValueError, match="without a ball; pass ball=True"):
        loop.throw_ball(loop.CreateDefaultContext(), Throw(), 0.1)


def test_a_ball_that_waits_far_away_changes_nothing():
    alone = episode_of()
    with_ball = run_episode(standing_loop(variation="nominal", ball=True))
    np.testing.assert_allclose(with_ball.true_state, alone.true_state, atol=1e-6)


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_servo_load_is_what_is_commanded_minus_what_is_measured(name):
    loop = standing_loop(name)
    joints = loop.kinematics.joint_names
    assert loop.feature_names[-len(joints) :] == [f"servo_load_{joint}" for joint in joints]
    simulator, context = started(loop)
    controller = loop.GetSubsystemByName("inverse_kinematics_controller")
    # Without noise there is one observer for controller and assessor.
    observer = loop.GetSubsystemByName("observer")

    def expected():
        command = controller.GetOutputPort("desired_joint_state").Eval(
            controller.GetMyContextFromRoot(context)
        )
        measured = observer.GetOutputPort("measured_plant_state").Eval(
            observer.GetMyContextFromRoot(context)
        )
        return command[: len(joints)] - measured[7 : 7 + len(joints)]

    for time in (0.0, 0.5):
        simulator.AdvanceTo(time)
        load = loop.GetOutputPort("features").Eval(context)[-len(joints) :]
        np.testing.assert_allclose(load, expected(), atol=1e-12)
    # At rest the servos carry the robot: load times stiffness is the static torque.
    assert np.abs(load).max() > 1e-3


def test_a_reset_commands_what_the_start_does():
    loop = load_scenario("laikago_balancing").make_loop(ball=False)
    context = loop.CreateDefaultContext()
    features = loop.GetOutputPort("features")

    def started_features():
        simulator = Simulator(loop, context.Clone())
        simulator.Initialize()
        return features.Eval(simulator.get_context())

    loop.reset(context, np.random.default_rng(1))
    np.testing.assert_array_equal(features.Eval(context), started_features())
