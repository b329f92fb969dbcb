"""KinematicPreview: the hand goes where it is led, the feet stay, and the cost is at its least."""

import functools

import numpy as np
import pytest
from scipy.linalg import null_space

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.whole_body_model import PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import task_errors
from drake_safety.diagrams.reaching.kinematic_preview import KinematicPreview, chain_joints
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import edited, robot_kinematics, robot_model, write_porter

HANDS = [("porter", "left"), ("porter", "right"), ("atlas", "left"), ("atlas", "right")]


@functools.cache
def preview_of(name, hand):
    return KinematicPreview(WholeBodyModel(robot_kinematics(name), hand))


def easy_paths(preview, num=5, seed=0):
    """Straight paths of six samples to goals in front of the robot, on its hand's side."""
    model, rng = preview.model, np.random.default_rng(seed)
    start = model.reaching_position(model.kinematics.standing_positions())
    outwards = np.sign(start[1])
    for _ in range(num):
        step = rng.uniform([-0.05, -0.1, -0.05], [0.1, 0.05, 0.1]) * [1.0, outwards, 1.0]
        yield start + np.linspace(1 / 6, 1.0, 6)[:, np.newaxis] * step


def gradient(preview, reference, q):
    """Of half the cost in the motions that leave the feet still, and the hand's share of it."""
    model, kinematics = preview.model, preview.model.kinematics
    _, J_feet = kinematics.contact_positions_and_jacobian(q)
    J, error = task_errors(model, reference)
    slope = (model.task_weights * J).T @ error
    slope[6:] += model.parameters.posture.weight * (reference.posture - q[7:])
    still = null_space(J_feet, rcond=1e-9)
    hand = (model.task_weights * J)[-3:].T @ np.full(3, 0.01)  # As a centimetre amiss would pull.
    return np.linalg.norm(still.T @ slope), np.linalg.norm(still.T @ hand)


@pytest.mark.parametrize(("name", "hand"), HANDS)
def test_the_feet_stay_where_they_are_and_the_hand_arrives_at_easy_goals(name, hand):
    preview = preview_of(name, hand)
    kinematics = preview.model.kinematics
    q = kinematics.standing_positions()
    before = kinematics.contact_positions(q)
    for path in easy_paths(preview):
        positions = preview.follow(q, path)
        for ahead in positions:
            np.testing.assert_allclose(kinematics.contact_positions(ahead), before, atol=1e-4)
        reached = preview.model.reaching_position(positions[-1])
        assert np.linalg.norm(reached - path[-1]) < 5e-3


@pytest.mark.parametrize(("name", "hand"), HANDS)
def test_the_last_posture_is_where_the_cost_is_at_its_least(name, hand):
    # No motion that leaves the feet still makes it less, to first order.
    preview = preview_of(name, hand)
    q = preview.model.kinematics.standing_positions()
    reference = preview.model.reference(q)
    for path in easy_paths(preview):
        reference.reaching = PointReference(position=path[-1])
        slope, one_centimetre = gradient(preview, reference, preview.follow(q, path)[-1])
        assert slope < 0.02 * one_centimetre
        longer = np.vstack([path, np.repeat(path[-1:], 30, axis=0)])
        positions = preview.follow(q, longer)
        slope, one_centimetre = gradient(preview, reference, positions[-1])
        assert slope < 1e-4 * one_centimetre
        np.testing.assert_allclose(positions[-1], positions[-2], atol=1e-6)  # Nothing moves.


def test_one_sample_is_a_path():
    preview = preview_of("porter", "left")
    q = preview.model.kinematics.standing_positions()
    goal = preview.model.reaching_position(q) + [0.02, 0.0, 0.02]
    (ahead,) = preview.follow(q, goal[np.newaxis])
    assert np.linalg.norm(preview.model.reaching_position(ahead) - goal) < 5e-3


def test_the_positions_it_starts_from_are_left_alone():
    preview = preview_of("porter", "left")
    q = preview.model.kinematics.standing_positions()
    before = q.copy()
    positions = preview.follow(q, next(easy_paths(preview)))
    np.testing.assert_array_equal(q, before)
    assert positions.shape == (6, len(q))
    np.testing.assert_allclose(np.linalg.norm(positions[:, :4], axis=1), 1.0, atol=1e-12)


def test_a_path_does_not_depend_on_the_one_before():
    preview = preview_of("porter", "left")
    q = preview.model.kinematics.standing_positions()
    one, other = easy_paths(preview, num=2)
    before = preview.follow(q, one)
    preview.follow(preview.follow(q, other)[-1], other)
    np.testing.assert_array_equal(preview.follow(q, one), before)


@pytest.mark.parametrize(("name", "hand"), HANDS)
def test_the_chain_is_made_of_the_joints_that_move_the_hand(name, hand):
    model = preview_of(name, hand).model
    kinematics, body = model.kinematics, model.hand.body
    rng = np.random.default_rng(0)
    q = kinematics.standing_positions()
    q[7:] += rng.uniform(-0.1, 0.1, kinematics.num_joints)
    kinematics.set_positions(q)
    before = body.EvalPoseInWorld(kinematics.context).GetAsMatrix4()
    moving = []
    for i in range(kinematics.num_joints):
        moved = q.copy()
        moved[7 + i] += 0.1
        kinematics.set_positions(moved)
        after = body.EvalPoseInWorld(kinematics.context).GetAsMatrix4()
        if np.abs(after - before).max() > 1e-9:
            moving.append(i)
    assert chain_joints(kinematics, model.hand) == moving
    arm = set(robot_model(name).reaching_frame(hand).joints)
    assert arm <= {kinematics.joint_names[i] for i in moving}


def test_heavier_tasks_win(tmp_path):
    # What a hand cannot have without its centre of mass it gets as its weight says.
    misses = []
    for weight in (5.0, 500.0):
        tasks = {"reaching": {"weight": weight}, "orientation": {"pelvis": {"weight": 20.0}}}
        robot = load_robot_file(edited(write_porter(tmp_path), whole_body=tasks))
        model = WholeBodyModel(RobotKinematics(robot), "left")
        q = model.kinematics.standing_positions()
        # Farther than its arm.
        path = model.reaching_position(q) + np.linspace(0, 1, 8)[1:, None] * [0.4, 0.0, 0.0]
        ahead = KinematicPreview(model).follow(q, path)[-1]
        misses.append(np.linalg.norm(model.reaching_position(ahead) - path[-1]))
    assert misses[1] < 0.5 * misses[0]
