import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import stance_state
from drake_safety.robots.robot import ObservationNoise
from drake_safety.systems.state_observer import StateObserver
from legged_robots import robot_kinematics
from system_doubles import Bench

NOISE = ObservationNoise(position=0.01, velocity=0.05)


def plant_state(kinematics):
    X_WB = RigidTransform([0.3, -0.2, kinematics.standing_height])
    q = kinematics.positions_at(X_WB, kinematics.posture)
    return np.concatenate([q, np.linspace(-1, 1, kinematics.num_velocities)])


def observed(kinematics, noise=None, draws=None, x=None, **options):
    x = plant_state(kinematics) if x is None else x
    inputs = {"plant_state": x} if draws is None else {"plant_state": x, "noise": draws}
    return Bench(StateObserver(kinematics, noise, **options), **inputs).outputs()


def test_without_noise_the_measurement_is_the_truth():
    kinematics = robot_kinematics("laikago")
    x = plant_state(kinematics)
    for values in (
        observed(kinematics),
        observed(kinematics, NOISE),  # Nothing is connected to the noise port.
        observed(kinematics, ObservationNoise(), np.ones(2 * kinematics.num_velocities)),
    ):
        np.testing.assert_array_equal(values["measured_plant_state"], x)
        np.testing.assert_array_equal(values["output"], [0.3, -0.2, kinematics.standing_height])
        n_q = kinematics.num_positions
        np.testing.assert_array_equal(values["state"], stance_state(kinematics, x[:n_q], x[n_q:]))


def test_with_a_hand_the_output_is_where_the_measured_hand_is():
    kinematics, hand = robot_kinematics("porter"), "left"
    frame = kinematics.robot.reaching_frame(hand)
    x, n_q = plant_state(kinematics), kinematics.num_positions
    draws = np.random.default_rng(0).normal(size=2 * kinematics.num_velocities)
    for noise in (None, NOISE):
        values = observed(kinematics, noise, draws, hand=hand)
        q = values["measured_plant_state"][:n_q]
        expected = kinematics.reaching_position(q, frame)
        np.testing.assert_array_equal(values["output"], expected)
        without = observed(kinematics, noise, draws)
        for port in ("measured_plant_state", "state"):
            np.testing.assert_array_equal(values[port], without[port])
    assert np.any(values["output"] != kinematics.reaching_position(x[:n_q], frame))
    assert StateObserver(kinematics, hand=hand).output_names == ["hand_x", "hand_y", "hand_z"]


def test_a_mirror_reflects_the_state_and_nothing_else():
    kinematics = robot_kinematics("porter")
    mirror, n_q = Mirror(kinematics), kinematics.num_positions
    draws = np.random.default_rng(0).normal(size=2 * kinematics.num_velocities)
    plain = observed(kinematics, NOISE, draws, hand="left")
    mirrored = observed(kinematics, NOISE, draws, hand="left", mirror=mirror)
    for port in ("measured_plant_state", "output"):
        np.testing.assert_array_equal(mirrored[port], plain[port])
    q, v = np.split(plain["measured_plant_state"], [n_q])
    expected = stance_state(kinematics, *mirror.plant_state(q, v))
    np.testing.assert_allclose(mirrored["state"], expected, atol=1e-9)
    assert np.abs(mirrored["state"] - plain["state"]).max() > 0.1
