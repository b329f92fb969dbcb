"""A robot is data: what its YAML says enters a plant, and names it lacks are refused."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from drake_safety.robots.robot import (
    Payload,
    PlantVariation,
    actuation_matrix,
    add_robot,
    apply_masses,
    posture_positions,
    require_motors,
    servo_joints,
)
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import edited, robot_model, write_biped


def plant_of(robot, variation=None, **options):
    plant = MultibodyPlant(0.001)
    add_robot(plant, robot, variation, **options)
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "pelvic"}, "robot 'biped' has no body 'pelvic'; it has .*pelvis"),
        ({"joint_gains": {".*": {}, "left_knee": {}}}, "gains of joint 'left_knee' matches"),
        ({"mirror": {"left_(.*)": r"x_\1"}}, "pairs joints .*'left_hip_z': 'x_hip_z'.*; it has"),
        ({"mirror": {"left_(hip_x|knee)": "right_knee"}}, "'left_hip_x' and with 'left_knee'"),
        ({"joint_gains": {".*": {}, "hip": {}}}, "no joint for joint_gains pattern 'hip'; it has"),
        ({"effort_limits": {"hip": 4.0}}, "no joint for effort_limits pattern 'hip'; it has"),
        ({"velocity_limits": {"hip": 4.0}}, "no joint for velocity_limits pattern 'hip'; it has"),
        ({"rotor_inertia": {"hip": 4.0}}, "no joint for rotor_inertia pattern 'hip'; it has"),
    ],
)
def test_names_that_the_model_lacks_are_answered_with_those_it_has(tmp_path, change, message):
    robot = load_robot_file(edited(write_biped(tmp_path), **change))
    with pytest.raises(ValueError, match=message):
        plant_of(robot)


def test_legs_without_motors_are_refused_with_what_to_write(tmp_path):
    path = write_biped(tmp_path)
    without = plant_of(robot := load_robot_file(edited(path, effort_limits={".*knee": 40.0})))
    message = r"joints \['left_hip_z', .*\] have no motor: .* their largest torques"
    with pytest.raises(ValueError, match=message):
        require_motors(without, robot)
    robot = load_robot_file(edited(path, effort_limits={".*": 40.0}))
    require_motors(plant_of(robot), robot)


def test_a_motor_without_a_limit_takes_that_of_the_yaml(tmp_path):
    path = write_biped(tmp_path)
    urdf = tmp_path / "biped.urdf"
    motor = (
        '<transmission><type>transmission_interface/SimpleTransmission</type><joint name="{0}">'
        "<hardwareInterface>EffortJointInterface</hardwareInterface></joint>"
        '<actuator name="{0}"/></transmission>'
    )
    motors = "".join(motor.format(name) for name in ("left_knee", "right_knee"))
    text = urdf.read_text().replace("</robot>", f"{motors}</robot>")
    # Of one knee the file knows the limit, of the other it does not.
    head, tail = text.split('name="left_knee"', 1)
    tail = tail.replace('effort="40" ', "", 1)
    urdf.write_text(f'{head}name="left_knee"{tail}')
    plant = plant_of(load_robot_file(edited(path, effort_limits={".*": 30.0})))
    assert plant.GetJointActuatorByName("left_knee").effort_limit() == 30.0
    assert plant.GetJointActuatorByName("right_knee").effort_limit() == 40.0


def test_every_joint_has_the_gains_and_the_posture_of_the_yaml():
    robot = robot_model("biped")
    plant = plant_of(robot)
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert sorted(a.joint().name() for a in actuators) == sorted(servo_joints(plant, robot))
    for actuator in actuators:
        gains = robot.gains_of(actuator.joint().name())
        assert actuator.get_controller_gains().p == gains.stiffness
        assert actuator.get_controller_gains().d == gains.damping
    context = plant.CreateDefaultContext()
    for joint, position in posture_positions(plant, robot).items():
        assert plant.GetJointByName(joint).GetOnePosition(context) == position


def test_a_variation_scales_masses_and_a_payload_moves_the_centre_of_mass_by_its_share():
    robot = robot_model("biped")
    plant = plant_of(robot)
    context = plant.CreateDefaultContext()
    M, position = plant.CalcMassMatrix(context), [0.1, -0.02, 0.05]
    for _ in range(2):  # A scale replaces the one before; it does not multiply it.
        apply_masses(plant, context, robot, PlantVariation(mass_scale=0.8))
    np.testing.assert_allclose(plant.CalcMassMatrix(context), 0.8 * M, rtol=1e-12, atol=1e-15)
    mass, centre = plant.CalcTotalMass(context), plant.CalcCenterOfMassPositionInWorld(context)
    p_WP = plant.GetBodyByName(robot.base).EvalPoseInWorld(context) @ np.array(position)
    variation = PlantVariation(mass_scale=0.8, payload=Payload(mass_kg=2.0, position_m=position))
    for _ in range(2):  # It is not put on twice.
        apply_masses(plant, context, robot, variation)
    assert plant.CalcTotalMass(context) == pytest.approx(mass + 2.0)
    loaded = plant.CalcCenterOfMassPositionInWorld(context)
    np.testing.assert_allclose(loaded, (mass * centre + 2.0 * p_WP) / (mass + 2.0), atol=1e-12)
    with pytest.raises(ValueError, match="has no body 'rucksack'"):
        apply_masses(plant, context, robot, PlantVariation(payload=Payload(body="rucksack")))


FRICTION_NM = 0.4


def joint_rate_under(torque, variation, seconds=0.01):
    """Rate of one joint of a robot in free space, after a constant torque without any servo."""
    robot = robot_model("hexapod")
    plant = plant_of(robot, variation, servos=False)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    context = plant.CreateDefaultContext()
    joint = plant.GetJointByName("knee_0")
    actuation = np.zeros(plant.num_actuators())
    actuation[int(plant.GetJointActuatorByName("knee_0_actuator").index())] = torque
    plant.get_actuation_input_port().FixValue(context, actuation)
    if variation is not None:
        instance = plant.GetModelInstanceByName(robot.name)
        port = plant.get_desired_state_input_port(instance)
        port.FixValue(context, np.zeros(port.size()))
    simulator = Simulator(plant, context)
    simulator.AdvanceTo(seconds)
    return joint.get_angular_rate(simulator.get_context())


def test_dry_friction_sticks_below_its_torque_and_takes_it_from_a_sliding_joint():
    variation = PlantVariation(joint_friction_nm=FRICTION_NM)
    assert abs(joint_rate_under(0.9 * FRICTION_NM, variation, 0.3)) < FRICTION_NM / 100
    assert joint_rate_under(0.9 * FRICTION_NM, None) > 1.0
    # A sliding joint accelerates by what friction leaves of the torque.
    little = joint_rate_under(1.5 * FRICTION_NM, variation)
    much = joint_rate_under(2.0 * FRICTION_NM, variation)
    assert little > 0.2
    assert much / little == pytest.approx((2.0 - 1) / (1.5 - 1), rel=0.05)


def test_actuation_follows_the_names_of_the_joints_and_spares_friction():
    robot = robot_model("biped")
    plant = plant_of(robot, PlantVariation(joint_friction_nm=0.1))
    names = sorted(servo_joints(plant, robot))
    torque = {name: float(i + 1) for i, name in enumerate(names)}
    actuation = actuation_matrix(plant, robot, names) @ list(torque.values())
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        is_friction = actuator.name().endswith("_friction")
        expected = 0.0 if is_friction else torque[actuator.joint().name()]
        assert actuation[int(index)] == expected
