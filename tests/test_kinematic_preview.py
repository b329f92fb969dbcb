"""KinematicPreview: the hand follows its path, the feet stay, and the cost is at its minimum."""

import functools

import numpy as np
import pytest
from scipy.linalg import null_space

from drake_safety.control.whole_body_model import PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import task_errors
from drake_safety.diagrams.reaching.kinematic_preview import KinematicPreview
from legged_robots import robot_kinematics


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
    J_feet = kinematics.contact_jacobian(q)
    J, error = task_errors(model, reference)
    slope = (model.task_weights * J).T @ error
    slope[6:] += model.parameters.posture.weight * (reference.posture - q[7:])
    still = null_space(J_feet, rcond=1e-9)
    hand = (model.task_weights * J)[-3:].T @ np.full(3, 0.01)  # As a centimetre amiss would pull.
    return np.linalg.norm(still.T @ slope), np.linalg.norm(still.T @ hand)


@pytest.mark.parametrize(("name", "hand"), [("porter", "right"), ("atlas", "left")])
def test_the_hand_arrives_with_fixed_feet_where_the_cost_is_minimal(name, hand):
    preview = preview_of(name, hand)
    kinematics = preview.model.kinematics
    q = kinematics.standing_positions()
    before, feet = q.copy(), kinematics.contact_positions(q)
    reference = preview.model.reference(q)
    for path in easy_paths(preview, num=3):
        positions = preview.follow(q, path)
        for ahead in positions:
            np.testing.assert_allclose(kinematics.contact_positions(ahead), feet, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(positions[:, :4], axis=1), 1.0, atol=1e-12)
        reached = preview.model.reaching_position(positions[-1])
        assert np.linalg.norm(reached - path[-1]) < 5e-3
        # No motion that leaves the feet still lowers the cost, to first order.
        reference.reaching = PointReference(position=path[-1])
        slope, one_centimetre = gradient(preview, reference, positions[-1])
        assert slope < 0.02 * one_centimetre
        longer = preview.follow(q, np.vstack([path, np.repeat(path[-1:], 30, axis=0)]))
        slope, one_centimetre = gradient(preview, reference, longer[-1])
        assert slope < 1e-4 * one_centimetre
    np.testing.assert_array_equal(q, before)
