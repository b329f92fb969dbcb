"""Obstacles: they stand where they are told to, and distances to them are those of geometry."""

import itertools

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_safety.plants.obstacles import (
    Clearance,
    Obstacle,
    add_obstacles,
    arm_geometries,
    collision_geometries,
    filter_collisions,
)
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import HAND_RADIUS_M, robot_kinematics, robot_model, write_porter
from urdf_files import GOOD, LINK, written

SIZE = np.array([0.3, 0.8, 0.1])
FAR_M = 9.0  # A range that nothing here is beyond.


def link(name, *, is_solid=True):
    box = f'<geometry><box size="{SIZE[0]} {SIZE[1]} {SIZE[2]}"/></geometry>'
    shape = f"<collision>{box}</collision>" if is_solid else f"<visual>{box}</visual>"
    return LINK.format(name, GOOD, shape)


def joint(kind, parent, child):
    return (
        f'<joint name="{child}_joint" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )


def model(folder, *parts):
    return str(written(folder, *parts, name="block.urdf"))


def block(folder, position, yaw_rad=0.0):
    """A box in the middle of its link."""
    return Obstacle(model=model(folder, link("box")), position=list(position), yaw_rad=yaw_rad)


def box_distance(p_WP, obstacle):
    """Signed distance of points to a block, (N,) [m]."""
    R_WO = RotationMatrix.MakeZRotation(obstacle.yaw_rad).matrix()
    excess = np.abs((p_WP - obstacle.position) @ R_WO) - SIZE / 2
    outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
    return np.where(excess.max(axis=1) < 0, excess.max(axis=1), outside)


def postures(num=30, seed=0):
    """Postures of the porter all over the place, (num, n_q)."""
    kinematics, rng = robot_kinematics("porter"), np.random.default_rng(seed)
    return [
        kinematics.positions_at(
            RigidTransform(RollPitchYaw(rng.uniform(-0.3, 0.3, 3)), rng.uniform(-0.3, 0.3, 3)),
            rng.uniform(-0.3, 0.3, kinematics.num_joints),
        )
        for _ in range(num)
    ]


def hands(q):
    """Where the porter's hands are, (2, 3) [m]."""
    kinematics = robot_kinematics("porter")
    frames = kinematics.robot.reaching_frames.values()
    return np.array([kinematics.reaching_position(q, frame) for frame in frames])


def test_the_clearance_of_arms_is_the_signed_distance_of_their_spheres_to_the_box(tmp_path):
    obstacle = block(tmp_path, (0.35, 0.1, -0.1), yaw_rad=0.7)
    clearance = Clearance(robot_model("porter"), [obstacle], range_m=FAR_M)
    seen = []
    for q in postures():
        seen.append(clearance.of_arms(q))
        expected = (box_distance(hands(q), obstacle) - HAND_RADIUS_M).min()
        assert seen[-1] == pytest.approx(expected, abs=1e-6)
    assert min(seen) < 0 < max(seen)


def test_the_clearance_of_points_is_the_signed_distance_of_spheres_to_the_box(tmp_path):
    obstacle = block(tmp_path, (0.4, -0.2, 0.9), yaw_rad=-0.4)
    clearance = Clearance(robot_model("porter"), [obstacle], range_m=FAR_M)
    p_WP = obstacle.position + np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    p_WP[0] = obstacle.position
    for radius in (0.0, 0.05):
        expected = box_distance(p_WP, obstacle) - radius
        np.testing.assert_allclose(clearance.of_points(p_WP, radius), expected, atol=1e-12)
        assert expected.min() < 0 < expected.max()


def test_the_nearest_of_several_obstacles_counts(tmp_path):
    obstacles = [block(tmp_path, (0.5, y, -0.1)) for y in (0.6, -0.6)]
    robot = robot_model("porter")
    both = Clearance(robot, obstacles, range_m=FAR_M)
    alone = [Clearance(robot, [obstacle], range_m=FAR_M) for obstacle in obstacles]
    for q in postures(5):
        assert both.of_arms(q) == min(one.of_arms(q) for one in alone)
        p_WP = hands(q)
        expected = np.minimum(*(one.of_points(p_WP) for one in alone))
        np.testing.assert_array_equal(both.of_points(p_WP), expected)


def test_clearances_are_saturated_at_their_range(tmp_path):
    obstacle = block(tmp_path, (0.45, 0.1, -0.1))
    robot, qs = robot_model("porter"), postures()
    far = Clearance(robot, [obstacle], range_m=FAR_M)
    near = Clearance(robot, [obstacle], range_m=0.1)
    distances = np.array([far.of_arms(q) for q in qs])
    assert distances.min() < 0.1 < distances.max()
    np.testing.assert_array_equal([near.of_arms(q) for q in qs], np.minimum(distances, 0.1))
    p_WP = np.concatenate([hands(q) for q in qs])
    for radius in (0.0, 0.05):
        expected = np.minimum(far.of_points(p_WP, radius), 0.1)
        np.testing.assert_allclose(near.of_points(p_WP, radius), expected, atol=1e-15)


@pytest.mark.parametrize("is_seen", [False, True])
def test_where_nothing_can_be_touched_everything_is_as_clear_as_can_be(tmp_path, is_seen):
    picture = Obstacle(model=model(tmp_path, link("picture", is_solid=False)))
    clearance = Clearance(robot_model("porter"), [picture] * is_seen, range_m=0.2)
    q = postures(1)[0]
    assert clearance.of_arms(q) == 0.2
    np.testing.assert_array_equal(clearance.of_points(hands(q)), 0.2)


def test_no_answer_depends_on_the_one_before(tmp_path):
    clearance = Clearance(robot_model("porter"), [block(tmp_path, (0.4, 0.1, -0.1))], range_m=FAR_M)
    one, other = postures(2)
    before = clearance.of_arms(one), clearance.of_points(hands(one))
    clearance.of_arms(other)
    np.testing.assert_array_equal(clearance.of_points(hands(one)), before[1])
    assert clearance.of_arms(one) == before[0]


@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
def test_a_range_that_is_none_is_refused_and_positions_that_are_not_finite(value):
    with pytest.raises(ValueError, match="clearance: range_m must be finite and positive; got"):
        Clearance(robot_model("porter"), [], range_m=value)
    if not np.isfinite(value):
        q = postures(1)[0]
        q[9] = value
        with pytest.raises(ValueError, match="clearance: positions must be finite; got"):
            Clearance(robot_model("porter"), [], range_m=0.1).of_arms(q)


def test_arms_that_nothing_can_touch_are_refused_where_there_is_something_to_touch(tmp_path):
    path = write_porter(tmp_path)
    urdf = path.with_name("porter.urdf")
    urdf.write_text(urdf.read_text().replace(f'radius="{HAND_RADIUS_M}"', 'radius="0.01"'))
    obstacle = block(tmp_path, (0.4, 0.1, 0.0))
    Clearance(load_robot_file(path), [obstacle], range_m=0.1)
    start, end = "<collision>", "</collision>"
    pieces = urdf.read_text().split(start)
    bare = [p.split(end, 1)[1] if 'radius="0.01"' in p else start + p for p in pieces[1:]]
    urdf.write_text("".join([pieces[0], *bare]))
    robot = load_robot_file(path)
    with pytest.raises(ValueError, match=r"robot 'porter': no body moved by .* has collision"):
        Clearance(robot, [obstacle], range_m=0.1)
    assert Clearance(robot, [], range_m=0.1).of_arms(postures(1)[0]) == 0.1


def scene(robot, obstacles):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    add_robot(plant, robot)
    add_ground(plant, 0.8)
    instances = add_obstacles(plant, obstacles)
    plant.Finalize()
    return plant, scene_graph, instances


@pytest.mark.parametrize("name", ["porter", "atlas"])
def test_of_all_contacts_those_of_arms_with_obstacles_and_the_rest_with_ground_are_left(
    tmp_path, name
):
    robot = robot_model(name)
    plant, scene_graph, instances = scene(robot, [block(tmp_path, (0.6, y, 1.0)) for y in (-1, 1)])
    filter_collisions(plant, scene_graph, robot, instances)
    arms = set(arm_geometries(plant, robot))
    robots = set(collision_geometries(plant, [plant.GetModelInstanceByName(robot.name)]))
    boxes = collision_geometries(plant, instances)
    ground = plant.GetCollisionGeometriesForBody(plant.world_body())
    assert len(boxes) == 2 and arms < robots
    if name == "porter":
        inspector = scene_graph.model_inspector()
        frames = sorted(inspector.GetName(inspector.GetFrameId(one)) for one in arms)
        assert frames == ["porter::left_palm", "porter::right_palm"]
    pairs = [*itertools.product(arms, boxes), *itertools.product(robots - arms, ground)]
    expected = {frozenset(pair) for pair in pairs}
    found = {frozenset(pair) for pair in scene_graph.model_inspector().GetCollisionCandidates()}
    assert found == expected


# Whatever link the file names first, the one that nothing holds is put in place.
@pytest.mark.parametrize("names", [("post", "board"), ("board", "post")])
def test_obstacles_stand_still_where_they_are_told_to(tmp_path, names):
    plant = MultibodyPlant(0.001)
    first, second = map(link, names)
    path = model(tmp_path, first, joint("fixed", "post", "board"), second)
    obstacles = [Obstacle(model=path, position=[1.0, 2.0, 3.0], yaw_rad=0.5)]
    obstacles.append(Obstacle(model=path, position=[-1.0, 0.0, 0.0]))
    instances = add_obstacles(plant, obstacles)
    plant.Finalize()
    assert plant.num_velocities() == 0
    context = plant.CreateDefaultContext()
    for obstacle, instance in zip(obstacles, instances, strict=True):
        X_WO = plant.GetBodyByName("post", instance).EvalPoseInWorld(context)
        turn = RotationMatrix.MakeZRotation(obstacle.yaw_rad)
        assert X_WO.IsNearlyEqualTo(RigidTransform(turn, obstacle.position), 1e-12)


HELD = ['<link name="world"/>', joint("fixed", "world", "a"), link("a")]
MOVING = [link("frame"), joint("revolute", "frame", "door"), link("door")]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([link("a"), link("b")], r"of the links \['a', 'b'\] these are \['a', 'b'\]"),
        (HELD, r"of the links \['a'\] these are \[\]"),
        (MOVING, r"obstacles do not move; the model has the joints \['door_joint'\]"),
        (["<link>"], "obstacle '.*block.urdf'"),
    ],
    ids=["two", "held", "moving", "broken"],
)
def test_a_model_that_cannot_stand_in_the_world_is_refused(tmp_path, parts, message):
    obstacle = Obstacle(model=model(tmp_path, *parts))
    with pytest.raises(ValueError, match=message):
        add_obstacles(MultibodyPlant(0.001), [obstacle])


def test_a_file_with_two_models_is_refused(tmp_path):
    path = tmp_path / "pair.sdf"
    models = "".join(f'<model name="{n}"><link name="l"/></model>' for n in "ab")
    path.write_text(f'<sdf version="1.9"><world name="w">{models}</world></sdf>')
    with pytest.raises(ValueError, match="expected one model; the file has 2"):
        add_obstacles(MultibodyPlant(0.001), [Obstacle(model=str(path))])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "must be a package:// URL or the absolute path"),
        ("bookshelf.urdf", "must be a package:// URL or the absolute path"),
        ("/nowhere/shelf.urdf", "obstacle '/nowhere/shelf.urdf': .* of an existing file"),
        ("package://drake_safety_models/scenes/shelf.urdf", "of an existing file"),
        ("package://drake_safety_models/scenes", "of an existing file"),
        ("package://shelves/shelf.urdf", "no package 'shelves'; use a path instead"),
    ],
)
def test_a_model_that_is_not_there_is_refused_by_name(name, message):
    with pytest.raises(ValueError, match=message):
        add_obstacles(MultibodyPlant(0.001), [Obstacle(model=name)])
