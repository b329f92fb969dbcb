"""What a log says twice and its map reads in two ways is refused, and honest noise is not."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_safety.logs.robot_log import read_log
from log_files import (
    ANGLES,
    BASE,
    GYRO,
    JOINTS,
    LINEAR,
    QUATERNION,
    RATES,
    SAFE,
    TABLE_MAP,
    UNSAFE,
    frame_of,
    read,
    recorded,
    save,
    walked,
)

pytestmark = pytest.mark.train
pd = pytest.importorskip("pandas")


def times(columns, *factors):
    return lambda frame: frame.assign(**(frame[columns] * np.resize(factors, len(columns))))


def with_values(frame, columns, values):
    return frame.assign(**dict(zip(columns, values.T, strict=True)))


def turns_of(frame):
    return Rotation.from_quat(np.array(frame[QUATERNION]))


def oriented(change):
    """A log whose quaternion a sensor that is mounted otherwise would write."""
    return lambda frame: with_values(frame, QUATERNION, change(turns_of(frame)).as_quat())


def with_legs(names):
    """Columns of joints that were written in another order of the legs."""
    order = [JOINTS.index(names[one[:2]] + one[2:]) for one in JOINTS]

    def spoil(frame):
        for columns in (ANGLES, RATES):
            frame = with_values(frame, columns, frame[[columns[i] for i in order]].to_numpy())
        return frame

    return spoil


def with_signs(*parts):
    """Motors that count the other way, of the joints whose names have one of the parts."""
    signs = [-1 if any(part in joint for part in parts) else 1 for joint in JOINTS]
    return times([*ANGLES, *RATES], *signs, *signs)


def slowly(spoil):
    """A spoilt log of a motion four times as slow."""
    return lambda f: spoil(times([*LINEAR, *GYRO, *RATES], 0.25)(f.assign(stamp=4 * f.stamp)))


UNMAPPED = [(line, "") for line in TABLE_MAP.splitlines() if "velocit" in line]
CONTRADICTIONS = {
    "in the world": (lambda f: with_values(f, LINEAR, turns_of(f).apply(np.array(f[LINEAR]))), [],
                     r"linear_velocity', columns .* by 0\.48 m/s.*, but by "
                     r"0\.00 m/s if 'base_linear_velocity.frame' is world"),
    "millimetres": (times(LINEAR, 1e3), [], "if 'base_linear_velocity.unit' is mm"),
    "x forwards, z down": (times(LINEAR, 1, -1, -1), [], r"by 180° about \[-?1.0, 0.0, 0.0\] in"
                           " the body"),
    "noise alone": (lambda f: f.assign(**{n: np.resize([0.7, -0.6, 0.5, -0.8], len(f)) for n in
                                          LINEAR}), [],
                    r"columns \['velocity_x', .* unit agrees: leave 'base_linear_velocity' out"),
    "gyro turned": (lambda f: f.assign(gyro_x=f.gyro_y, gyro_y=-f.gyro_x), [],
                    r"turned by 90° about \[-?0.0, -?0.0, 1.0\] .* in the body"),
    "motors": (times(RATES, 6.33), [], "is multiplied by 0.158: a gear ratio"),
    "two exchanged": (lambda f: f.assign(**{RATES[1]: f[RATES[4]], RATES[4]: f[RATES[1]]}), [],
                      f"it is of joint '{JOINTS[4]}'"),
    "half as fast": (lambda f: f.assign(stamp=2 * f.stamp), [], "by 0.5: .*the rate of time"),
    "another north": (oriented(lambda R: Rotation.from_rotvec([0, 0, 1]) * R), [],
                      "slide by .*_orientation' is turned by 60° about the vertical"),
    "order": (lambda f: f, [("order: xyzw", "order: wxyz")],
              r"line 2 and .* slide by .* 'base_orientation.order' is xyzw"),
    "left is right": (with_legs({"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}), [],
                      r"of left and right legs are exchanged: {'FR_hip_joint': 'FL_hip_joint_pos'"),
    "motors mounted mirrored": (with_signs("R_hip"), [], r"slide by .* if 'joint_positions.sign' "
                                r"is {'FR_hip_joint_pos': -1, 'RR_hip_joint_pos': -1}$"),
    "height from the start": (lambda f: f.assign(base_z=f.base_z - f.base_z[0]), [],
                              r"below the .* m higher: 'base_position.offset' of .base_z: 4"),
    "two frames in turn": (lambda f: f.assign(base_y=f.base_y + 250.0 * (f.index % 2)), [],
                           "line 3, column 'base_y': .* m/s since the row before"),
    "slow, two exchanged": (
        slowly(lambda f: f), [("velocity_x, velocity_y", "velocity_y, velocity_x")],
        "if columns 'velocity_y' and 'velocity_x' are exchanged"),
    "slow, a dead encoder": (slowly(times(ANGLES[:1], 0)), [], f"encoder of '{ANGLES[0]}' is dead"),
    "slow, gyro in the world": (slowly(lambda f: f), [("deg, frame: body", "deg, frame: world")],
                                "if 'base_angular_velocity.frame' is body"),
    "slow, another rate": (slowly(times([*LINEAR, *RATES], 2)), [], r"by 0.5\d*: .*of time"),
    "slow, left-handed": (slowly(times(["base_y", "goal_y"], -1)), [],
                          r"slide by .* if 'base_position.sign' is {base_y: -1} .and of"),
    "a gyroscope's spike": (lambda f: f.assign(gyro_x=f.gyro_x + 9e3 * (f.index == 30)), [],
                            "line 32, column 'gyro_x': the value is 8947.84, .*rad/s; robots stay"),
}  # fmt: skip


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_a_contradiction_names_the_columns_the_reading_that_fits_and_by_how_much(what, tmp_path):
    spoil, changes, message = CONTRADICTIONS[what]
    with pytest.raises(ValueError, match=message):
        read(save(spoil(frame_of(walked())), tmp_path), *changes)


def noisy(frame, rng):
    """Measures a motion by encoders, an inertial measurement unit and a state estimator."""

    def add(columns, size):
        values = frame[columns].to_numpy()
        drift = np.cumsum(rng.normal(size=values.shape), axis=0) / np.sqrt(len(values))
        frame[columns] = values + size * (rng.normal(size=values.shape) + drift)

    frame = frame.copy()
    add(BASE, 2.0)  # mm
    add(LINEAR, 0.06)
    add(GYRO, 3.0)  # deg/s
    add(ANGLES, 0.1)  # deg
    add(RATES, 0.2)
    turns = turns_of(frame)
    tilts = Rotation.from_rotvec(0.005 * rng.normal(size=(len(frame), 3)))
    frame[QUATERNION] = (turns * tilts).as_quat() * rng.choice([-1, 1], (len(frame), 1))
    late = 4 if len(frame) > 100 else 0  # Filtered velocities come late.
    frame[RATES] = frame[RATES].shift(late).bfill()
    return frame


@pytest.mark.parametrize("every", [1, 20], ids=["200 Hz", "10 Hz"])
def test_a_noisy_log_is_read(every, tmp_path):
    frame = noisy(frame_of(walked()), np.random.default_rng(0))[::every]
    log = read(save(frame, tmp_path), ("ns}", "ns}\nmax_gap_s: 0.11"), reader=read_log)
    assert len(log.time_s) == len(frame)


@pytest.mark.parametrize("seed", range(3))
def test_a_slow_log_with_biased_estimators_is_read(seed, tmp_path):
    rng = np.random.default_rng(seed)
    frame = slowly(lambda f: f)(frame_of(walked()))
    bias = rng.normal(size=(3, 3))
    bias /= np.linalg.norm(bias, axis=1, keepdims=True)
    frame[BASE] += np.outer(frame.stamp - frame.stamp[0], 2e-8 * bias[0])  # mm
    frame[LINEAR] += 0.05 * bias[1]
    frame[GYRO] += np.rad2deg(0.02) * bias[2]
    frame[RATES] += 0.5 * rng.normal(size=(len(frame), len(RATES)))
    frame.stamp += (2e6 * rng.normal(size=len(frame))).astype(int)
    read(save(frame, tmp_path), reader=read_log)


@pytest.mark.parametrize("index", [SAFE, UNSAFE])
def test_a_noisy_log_of_a_robot_that_stands_or_falls_is_read(index, tmp_path):
    rng = np.random.default_rng(index)
    read(save(noisy(frame_of(recorded(index)), rng), tmp_path), reader=read_log)


def test_velocities_that_were_never_filled_in_or_are_not_mapped_are_derivatives(tmp_path):
    path = save(times([*LINEAR, *GYRO, *RATES], 0)(frame_of(walked())), tmp_path)
    for changes, told in ([], ["linear", "angular", "joint"]), (UNMAPPED, []):
        found = read(path, *changes)
        np.testing.assert_allclose(found.pieces[0].v, walked().v, atol=1e-6)
        assert [re.search("(linear|angular|joint)_veloc", one)[1] for one in found.cuts] == told


HELD = {"all": [*BASE, *QUATERNION, *GYRO, *LINEAR, *ANGLES, *RATES], "base": BASE}


@pytest.mark.parametrize(("held", "number"), [("all", 2.5), ("base", 5)])
def test_rows_that_repeat_a_measurement_are_left_out(held, number, tmp_path):
    frame, columns = frame_of(walked()), HELD[held]
    rows = (np.floor(np.arange(len(frame)) / number) * number).astype(int)
    path = save(with_values(frame, columns, frame[columns].to_numpy()[rows]), tmp_path)
    found = read(path)
    assert f"changes only at every {number}th row" in found.cuts[0]
    (log,) = found.pieces
    # A measurement in between is repeated for the rest of a row.
    assert abs(len(log.time_s) - len(frame) / number) < 2
    np.testing.assert_allclose(np.diff(log.q[:, 4]) / np.diff(log.time_s), log.v[1:, 3], atol=0.15)
    assert read(path, reader=read_log).piece == 0


def test_a_robot_that_stands_still_repeats_itself(tmp_path):
    frame = times([*LINEAR, *GYRO, *RATES], 0)(frame_of(walked()))
    still = pd.concat([frame[:1]] * 400).assign(stamp=frame.stamp.to_numpy())
    assert len(read(save(still, tmp_path), reader=read_log).time_s) == 400


def test_signs_and_offsets_of_the_map_are_applied_and_a_height_is_noted(tmp_path):
    frame = times([ANGLES[0], RATES[0]], -1)(frame_of(walked()))
    frame = frame.assign(base_z=frame.base_z + 20.0)
    signs = [
        (f'{{joint}}_{n}"', f'{{joint}}_{n}", sign: {{{JOINTS[0]}_{n}: -1}}')
        for n in ("pos", "vel")
    ]
    found = read(save(frame, tmp_path), *signs)
    (note,) = found.notes
    assert "0.02 m above the ground z = 0: 'base_position.offset' of {base_z: -2" in note
    found = read(tmp_path / "run.csv", *signs, ("base_z], ", "base_z], offset: {base_z: -20}, "))
    assert not found.cuts
    np.testing.assert_allclose(found.pieces[0].q, walked().q, atol=1e-9)
    with pytest.raises(ValueError, match=r"'offset' of 'base_position' are by column.*\['z'\]"):
        read(tmp_path / "run.csv", ("base_z], ", "base_z], offset: {z: -20}, "))


def test_stamps_with_too_few_digits_are_refused(tmp_path):
    frame = frame_of(walked()).assign(stamp=lambda f: (1e-9 * f.stamp).round(1).map(str))
    with pytest.raises(ValueError, match=r"line \d+, column 'stamp': .*too few digits"):
        read(save(frame, tmp_path), ("unit: ns", "unit: s"))
