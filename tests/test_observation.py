"""The assessor's state is the same wherever the robot stands, and noise is what it claims."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_safety.control.observation import (
    add_noise,
    quaternion_of,
    rotation_vector,
    stance_state,
)
from drake_safety.robots.robot import ObservationNoise
from legged_robots import robot_kinematics

SEEDS = st.integers(0, 2**32 - 1)


def a_state(kinematics, seed=0):
    rng = np.random.default_rng(seed)
    X_WB = RigidTransform(RollPitchYaw(rng.uniform(-0.3, 0.3, 3)), rng.normal(size=3))
    joints = kinematics.posture + 0.1 * rng.normal(size=kinematics.num_joints)
    q = kinematics.positions_at(X_WB, joints)
    return X_WB, q, rng.normal(size=kinematics.num_velocities)


@settings(max_examples=8)
@given(SEEDS, st.floats(-math.pi, math.pi), st.sampled_from([1.0, -1.0, 1.01]))
def test_the_state_is_the_same_wherever_the_robot_stands_and_for_any_quaternion_of_its_rotation(
    seed, yaw, factor
):
    kinematics = robot_kinematics("biped")
    X_WB, q, v = a_state(kinematics, seed)
    R = RotationMatrix.MakeZRotation(yaw)
    moved = kinematics.positions_at(RigidTransform(R, [4.0, -7.0, 0.0]) @ X_WB, q[7:])
    moved[:4] *= factor  # One that has drifted from unit length is normalised.
    v_moved = np.concatenate([R.matrix() @ v[:3], R.matrix() @ v[3:6], v[6:]])
    here = stance_state(kinematics, q, v)
    np.testing.assert_allclose(stance_state(kinematics, moved, v_moved), here, atol=1e-9)


def test_the_state_of_standing_is_the_posture_over_the_feet():
    kinematics = robot_kinematics("laikago")
    X_WB = RigidTransform(RotationMatrix.MakeZRotation(1.0), [5, 6, kinematics.standing_height])
    q = kinematics.positions_at(X_WB, kinematics.posture)
    state = stance_state(kinematics, q, np.zeros(kinematics.num_velocities))
    expected = np.zeros(12 + 2 * kinematics.num_joints)
    expected[:2] = kinematics.nominal_base_offset
    expected[2] = kinematics.standing_height
    expected[12 : 12 + kinematics.num_joints] = kinematics.posture
    np.testing.assert_allclose(state, expected, atol=1e-9)


@given(SEEDS, st.one_of(st.just(1e-4), st.floats(0.0, 2 * math.pi)))
def test_the_rotation_vector_is_axis_times_angle_and_at_most_half_a_turn(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    quaternion = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
    r = rotation_vector(RotationMatrix(quaternion_of(quaternion)))
    assert np.linalg.norm(r) <= math.pi + 1e-12
    expected = angle * axis if angle <= math.pi else -(2 * math.pi - angle) * axis
    np.testing.assert_allclose(r, expected, atol=1e-7)


def test_noise_has_the_standard_deviations_it_was_given():
    kinematics = robot_kinematics("laikago")
    _, q, v = a_state(kinematics)
    noise = ObservationNoise(position=0.004, velocity=0.016)
    rng = np.random.default_rng(2)
    R = RotationMatrix(quaternion_of(q))
    rotations, positions, velocities = [], [], []
    for _ in range(2000):
        q_noisy, v_noisy = add_noise(q, v, rng.normal(size=2 * len(v)), noise)
        assert np.linalg.norm(q_noisy[:4]) == pytest.approx(1)
        rotations.append(rotation_vector(RotationMatrix(quaternion_of(q_noisy)) @ R.inverse()))
        positions.append(q_noisy[4:] - q[4:])
        velocities.append(v_noisy - v)
    # The standard deviation of 2000 draws errs by 1.6 %.
    for samples, std in ((rotations, 0.004), (positions, 0.004), (velocities, 0.016)):
        np.testing.assert_allclose(np.std(samples, axis=0), std, rtol=0.08)
        assert abs(np.mean(samples)) < 0.1 * std
    correlation = np.corrcoef(np.hstack([rotations, positions, velocities]).T)
    assert np.max(np.abs(correlation - np.eye(len(correlation)))) < 0.12
