"""Obstacles stand where the scenario says, and distances to them are those of geometry."""

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
from legged_robots import HAND_RADIUS_M, robot_kinematics, robot_model
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


def postures(num=20, seed=0):
    """Random postures of the porter, (num, n_q)."""
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


def test_clearances_are_signed_distances_to_the_nearest_box(tmp_path):
    obstacles = [block(tmp_path, (0.35, y, -0.1), yaw_rad=0.7) for y in (0.1, -0.6)]
    clearance = Clearance(robot_model("porter"), obstacles, range_m=FAR_M)
    near = Clearance(robot_model("porter"), obstacles, range_m=0.1)
    distances = []
    for q in postures():
        of_boxes = [box_distance(hands(q), one) for one in obstacles]
        expected = np.min(of_boxes, axis=0) - HAND_RADIUS_M
        # Points are asked for in between: no answer depends on the one before.
        points = clearance.of_points(hands(q), HAND_RADIUS_M)
        np.testing.assert_allclose(points, expected, atol=1e-12)
        distances.append(clearance.of_arms(q))
        assert distances[-1] == pytest.approx(expected.min(), abs=1e-6)
        # They are saturated at their range.
        assert near.of_arms(q) == min(distances[-1], 0.1)
        capped = near.of_points(hands(q), HAND_RADIUS_M)
        np.testing.assert_allclose(capped, np.minimum(points, 0.1), atol=1e-15)
    assert min(distances) < 0 < 0.1 < max(distances)


@pytest.mark.parametrize("is_seen", [False, True])
def test_without_collision_geometry_clearances_are_their_range(tmp_path, is_seen):
    picture = Obstacle(model=model(tmp_path, link("picture", is_solid=False)))
    clearance = Clearance(robot_model("porter"), [picture] * is_seen, range_m=0.2)
    q = postures(1)[0]
    assert clearance.of_arms(q) == 0.2
    np.testing.assert_array_equal(clearance.of_points(hands(q)), 0.2)


def test_contacts_are_those_of_arms_with_obstacles_and_of_the_rest_with_ground(tmp_path):
    robot = robot_model("porter")
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    add_robot(plant, robot)
    add_ground(plant, 0.8)
    instances = add_obstacles(plant, [block(tmp_path, (0.6, y, 1.0)) for y in (-1, 1)])
    plant.Finalize()
    filter_collisions(plant, scene_graph, robot, instances)
    arms = set(arm_geometries(plant, robot))
    robots = set(collision_geometries(plant, [plant.GetModelInstanceByName(robot.name)]))
    boxes = collision_geometries(plant, instances)
    ground = plant.GetCollisionGeometriesForBody(plant.world_body())
    assert len(boxes) == 2 and arms < robots
    inspector = scene_graph.model_inspector()
    frames = sorted(inspector.GetName(inspector.GetFrameId(one)) for one in arms)
    assert frames == ["porter::left_palm", "porter::right_palm"]
    pairs = [*itertools.product(arms, boxes), *itertools.product(robots - arms, ground)]
    candidates = {frozenset(pair) for pair in inspector.GetCollisionCandidates()}
    assert candidates == {frozenset(pair) for pair in pairs}


def test_obstacles_are_welded_where_the_scenario_says(tmp_path):
    plant = MultibodyPlant(0.001)
    first, second = map(link, ("board", "post"))  # The root link is put in place.
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


@pytest.mark.parametrize(
    "parts",
    [[link("a"), link("b")], [link("a"), joint("revolute", "a", "b"), link("b")], ["<link>"]],
    ids=["two roots", "moving", "broken"],
)
def test_a_model_that_cannot_stand_in_the_world_is_refused(tmp_path, parts):
    with pytest.raises(ValueError, match=r"obstacle '.*block\.urdf'"):
        add_obstacles(MultibodyPlant(0.001), [Obstacle(model=model(tmp_path, *parts))])
