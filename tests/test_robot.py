"""A robot is data: what its YAML says enters a plant, and what it misspells is named."""

import numpy as np
import pytest
import yaml
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_safety.control.robot import (
    PlantVariation,
    add_robot,
    apply_mass_scale,
    posture_positions,
    servo_joints,
)
from drake_safety.control.robot_model import (
    Foot,
    ReachingFrame,
    RobotModel,
    TaskGains,
    WholeBody,
    by_pattern,
    load_robot_file,
)
from drake_safety.models import load_robot, robot_names
from legged_robots import ROBOT_NAMES, robot_model, write_biped, write_hexapod


def edited(path, **changes):
    """Rewrites keys of a robot.yaml."""
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))
    return path


def plant_of(robot, variation=None):
    plant = MultibodyPlant(0.001)
    add_robot(plant, robot, variation)
    plant.Finalize()
    return plant


def test_every_robot_of_the_package_loads():
    for name in robot_names():
        assert load_robot(name).name == name


def test_an_unknown_robot_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match=r"robot 'nobody' does not exist.*laikago"):
        load_robot("nobody")


def test_a_missing_robot_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.yaml' does not exist"):
        load_robot(str(tmp_path / "gone.yaml"))


def test_a_misspelt_key_is_answered_with_the_keys_that_exist(tmp_path):
    path = edited(write_hexapod(tmp_path), foot_frictoin=0.5)
    with pytest.raises(ValueError, match=r"unknown key 'foot_frictoin'.*foot_friction"):
        load_robot_file(path)


def test_a_misspelt_nested_key_is_named_with_its_path(tmp_path):
    path = edited(write_hexapod(tmp_path), joint_gains={".*": {"stiffnes": 3.0}})
    with pytest.raises(ValueError, match=r"joint_gains\.\.\*\.stiffnes.*'stiffness'"):
        load_robot_file(path)


def test_values_of_a_file_are_validated_like_those_of_a_constructor(tmp_path):
    with pytest.raises(ValueError, match="foot_friction must be positive; got -1"):
        RobotModel(name="mine", foot_friction=-1.0)
    with pytest.raises(ValueError, match="foot_friction must be positive; got -1"):
        load_robot_file(edited(write_hexapod(tmp_path), foot_friction=-1.0))


def test_contact_points_are_triples():
    with pytest.raises(ValueError, match=r"foot 'left': contact_points must be a list of \[x, y"):
        RobotModel(name="mine", feet={"left": Foot(contact_points=[[0.0, 0.1]])})


def test_a_file_that_is_not_yaml_is_refused(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("name: [")
    with pytest.raises(ValueError, match="is not YAML"):
        load_robot_file(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "pelvic"}, "robot 'biped' has no body 'pelvic'; it has .*pelvis"),
        ({"posture": {"elbow": 1.0}}, "no joint for posture pattern 'elbow'; it has .*left_knee"),
        ({"posture": {".*knee": 1.0, "left.*": 0.5}}, "posture of joint 'left_knee' matches"),
        ({"joint_gains": {".*": {}, "left_knee": {}}}, "gains of joint 'left_knee' matches"),
    ],
)
def test_names_that_the_model_lacks_are_answered_with_those_it_has(tmp_path, change, message):
    robot = load_robot_file(edited(write_biped(tmp_path), **change))
    with pytest.raises(ValueError, match=message):
        plant_of(robot)


@pytest.mark.parametrize(("key", "what"), [("body", "body"), ("joints", "joint")])
def test_a_foot_on_nothing_is_answered_with_what_exists(tmp_path, key, what):
    path = write_biped(tmp_path)
    feet = yaml.safe_load(path.read_text())["feet"]
    feet["left"][key] = "flipper" if key == "body" else ["flipper"]
    with pytest.raises(ValueError, match=f"robot 'biped' has no {what} 'flipper'; it has"):
        plant_of(load_robot_file(edited(path, feet=feet)))


def test_whole_body_gains_and_reaching_frames_are_read_by_name(tmp_path):
    path = edited(
        write_biped(tmp_path),
        reaching_frames={"knee": {"body": "left_shin", "point": [0, 0, -0.1], "radius_m": 0.02}},
        whole_body={"orientation": {"pelvis": {"weight": 7}}, "posture": {"damping": 3.0}},
    )
    robot = load_robot_file(path)
    assert robot.reaching_frame("knee").body == "left_shin"
    tasks = robot.whole_body.tasks()
    assert tasks["orientation.pelvis"].weight == 7
    assert tasks["posture"].damping == 3.0
    # What the file leaves out is as by default.
    assert tasks["posture"].weight == WholeBody().posture.weight
    assert tasks["center_of_mass"] == WholeBody().center_of_mass
    plant_of(robot)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"whole_body": {"com": {}}}, r"unknown key 'whole_body\.com'.*'center_of_mass'"),
        (
            {"whole_body": {"reaching": {"wieght": 1}}},
            r"unknown key 'whole_body\.reaching\.wieght'.*'weight'",
        ),
        (
            {"whole_body": {"orientation": {"pelvis": {"gain": 1}}}},
            r"unknown key 'whole_body\.orientation\.pelvis\.gain'.*'stiffness'",
        ),
        (
            {"reaching_frames": {"left": {"bodie": "left_shin"}}},
            r"unknown key 'reaching_frames\.left\.bodie'.*'body'",
        ),
        (
            {"whole_body": {"orientation": {"pelvis": {"weight": -1}}}},
            r"whole_body\.orientation\.pelvis\.weight must be finite and not negative; got -1",
        ),
        (
            {"whole_body": {"friction": 0.0}},
            r"whole_body\.friction must be finite and positive; got 0",
        ),
        (
            {"reaching_frames": {"left": {"body": "left_shin", "point": [0, 1]}}},
            r"reaching frame 'left': point must be \[x, y, z\]; got \[0.0, 1.0\]",
        ),
        ({"mirror": {"(": "x"}}, r"mirror pattern '\(' is not a regular expression"),
    ],
)
def test_whole_body_names_and_values_that_do_not_fit_are_answered_with_what_does(
    tmp_path, change, message
):
    with pytest.raises(ValueError, match=message):
        load_robot_file(edited(write_biped(tmp_path), **change))


def test_gains_of_a_constructor_are_validated_like_those_of_a_file():
    with pytest.raises(ValueError, match=r"whole_body\.posture\.damping"):
        WholeBody(posture=TaskGains(damping=float("nan")))
    with pytest.raises(ValueError, match="reaching frame 'left': radius_m must be finite"):
        RobotModel(name="mine", reaching_frames={"left": ReachingFrame(radius_m=-1.0)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"whole_body": {"orientation": {"head": {}}}},
            "robot 'biped' has no body 'head'; it has .*pelvis",
        ),
        (
            {"reaching_frames": {"left": {"body": "hand"}}},
            "robot 'biped' has no body 'hand'; it has .*pelvis",
        ),
        (
            {"reaching_frames": {"left": {"body": "left_shin", "joints": ["elbow"]}}},
            "robot 'biped' has no joint 'elbow'; it has .*left_knee",
        ),
        ({"mirror": {"arm": "leg"}}, "no joint for mirror pattern 'arm'; it has .*left_knee"),
        (
            {"mirror": {"left_(.*)": r"starboard_\1"}},
            "no joint 'starboard_hip_z', the mirror of 'left_hip_z'; it has .*right_hip_z",
        ),
        (
            {"mirror": {"left_(.*)": r"right_\2"}},
            "mirror pattern 'left_.*' cannot be replaced by",
        ),
        (
            {"mirror": {"left_(hip_x|knee)": "right_knee"}},
            "mirror pairs joint 'right_knee' with 'left_hip_x' and with 'left_knee'",
        ),
    ],
)
def test_tasks_and_hands_of_bodies_and_joints_that_do_not_exist_are_refused_by_the_plant(
    tmp_path, change, message
):
    robot = load_robot_file(edited(write_biped(tmp_path), **change))
    with pytest.raises(ValueError, match=message):
        plant_of(robot)


def test_an_unknown_hand_is_answered_with_those_that_exist():
    robot = RobotModel(name="mine", reaching_frames={"left": ReachingFrame()})
    with pytest.raises(ValueError, match=r"robot 'mine' has no reaching frame 'tail'.*'left'"):
        robot.reaching_frame("tail")


def test_mirroring_pairs_joints_both_ways_and_leaves_the_others_to_themselves():
    robot = RobotModel(name="mine", mirror={"l_(.*)": r"r_\1"})
    partners = robot.mirror_partners(["back", "l_arm", "r_arm"])
    assert partners == {"back": "back", "l_arm": "r_arm", "r_arm": "l_arm"}


def test_a_pattern_matches_whole_names_only():
    assert by_pattern({"knee": 1.0}, "left_knee", "gains", "mine") is None
    assert by_pattern({".*knee": 1.0}, "left_knee", "gains", "mine") == 1.0


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_every_joint_has_a_servo_with_the_gains_of_the_yaml(name):
    robot = robot_model(name)
    plant = plant_of(robot)
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert sorted(a.joint().name() for a in actuators) == sorted(servo_joints(plant, robot))
    for actuator in actuators:
        gains = by_pattern(robot.joint_gains, actuator.joint().name(), "gains", name)
        assert actuator.get_controller_gains().p == gains.stiffness
        assert actuator.get_controller_gains().d == gains.damping


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_the_default_positions_are_the_posture(name):
    robot = robot_model(name)
    plant = plant_of(robot)
    context = plant.CreateDefaultContext()
    for joint, position in posture_positions(plant, robot).items():
        assert plant.GetJointByName(joint).GetOnePosition(context) == position


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_the_mass_scale_scales_the_whole_mass_matrix(name):
    robot = robot_model(name)
    plant = plant_of(robot)
    context = plant.CreateDefaultContext()
    M = plant.CalcMassMatrix(context)
    for _ in range(2):  # A scale replaces the one before; it does not multiply it.
        apply_mass_scale(plant, context, robot, 0.8)
    np.testing.assert_allclose(plant.CalcMassMatrix(context), 0.8 * M, rtol=1e-12, atol=1e-15)


def test_the_mass_scale_leaves_other_models_alone():
    plant = MultibodyPlant(0.001)
    first, second = robot_model("biped"), robot_model("hexapod")
    add_robot(plant, first)
    add_robot(plant, second)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    instance = [plant.GetModelInstanceByName(second.name)]
    before = plant.CalcTotalMass(context, instance)
    apply_mass_scale(plant, context, first, 2.0)
    assert plant.CalcTotalMass(context, instance) == before


def test_joint_damping_is_added_to_the_models_own():
    robot = robot_model("laikago")
    published, damped = plant_of(robot), plant_of(robot, PlantVariation(joint_damping=0.7))
    for name in servo_joints(published, robot):
        before = published.GetJointByName(name).default_damping()
        assert damped.GetJointByName(name).default_damping() == pytest.approx(before + 0.7)


def test_the_feet_and_only_the_feet_take_the_variations_friction():
    robot = robot_model("laikago")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    assert isinstance(scene_graph, SceneGraph)
    add_robot(plant, robot, PlantVariation(foot_friction=0.123), scene_graph=scene_graph)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    feet = 0
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        friction = inspector.GetProximityProperties(geometry).GetProperty(
            "material", "coulomb_friction"
        )
        feet += friction.static_friction() == 0.123
    assert feet == len(robot.feet)


FRICTION_NM = 0.4


def joint_rate_under(torque, variation, seconds=0.01):
    """Rate of one joint of a robot in free space, after a constant torque without any servo."""
    robot = robot_model("hexapod")
    robot = RobotModel(**{**vars(robot), "joint_gains": {}})
    plant = plant_of(robot, variation)
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


def test_dry_friction_sticks_below_its_torque():
    variation = PlantVariation(joint_friction_nm=FRICTION_NM)
    assert abs(joint_rate_under(0.9 * FRICTION_NM, variation, 0.3)) < FRICTION_NM / 100
    assert joint_rate_under(0.9 * FRICTION_NM, None) > 1.0


def test_a_sliding_joint_accelerates_by_what_friction_leaves_of_the_torque():
    variation = PlantVariation(joint_friction_nm=FRICTION_NM)
    little = joint_rate_under(1.5 * FRICTION_NM, variation)
    much = joint_rate_under(2.0 * FRICTION_NM, variation)
    assert little > 0.2
    assert much / little == pytest.approx((2.0 - 1) / (1.5 - 1), rel=0.05)


@pytest.mark.parametrize(
    "change",
    [{"mass_scale": 0.0}, {"foot_friction": -0.1}, {"joint_friction_nm": -1.0}]
    + [{"joint_damping": float("nan")}],
)
def test_an_impossible_variation_is_refused_by_name(change):
    (name,) = change
    with pytest.raises(ValueError, match=f"plant variation: {name}"):
        PlantVariation(**change)


def test_friction_needs_a_robot_twice_as_many_actuators():
    robot = robot_model("biped")
    plain, rough = plant_of(robot), plant_of(robot, PlantVariation(joint_friction_nm=0.1))
    assert rough.num_actuators() == 2 * plain.num_actuators()
