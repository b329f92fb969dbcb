"""Logs of any format say the same of a robot, and what is wrong with one is said where it is."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_safety.logs.conversion import angular_velocities, rates
from drake_safety.logs.episodes import episodes_from_log
from drake_safety.logs.messages import field_of
from drake_safety.logs.robot_log import read_log
from log_files import (
    FORMATS,
    UNSAFE,
    assert_same,
    balancing_loop,
    frame_of,
    map_text,
    part,
    recorded,
    write,
)

JOINTS = balancing_loop().kinematics.joint_names
ROBOT = balancing_loop().robot
VALUES = ("time_s", "q", "v", "desired_output", "foot_positions")


def map_of(kind, folder, *changes):
    text = map_text(kind)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "columns.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def few_rows():
    return part(recorded(UNSAFE), 0, 40)


def read_csv(frame, folder, *changes):
    frame.to_csv(folder / "run.csv", index=False)
    return read_log(folder / "run.csv", map_of("csv", folder, *changes), ROBOT)


@pytest.mark.train
@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_episode(kind, tmp_path):
    log = recorded(UNSAFE)
    read = read_log(write(log, JOINTS, kind, tmp_path), map_of(kind, tmp_path), ROBOT)
    for name in VALUES:
        np.testing.assert_allclose(getattr(read, name), getattr(log, name), atol=1e-11)
    (direct,) = episodes_from_log(log, balancing_loop())
    (episode,) = episodes_from_log(read, balancing_loop())
    assert not direct.is_safe
    assert_same(episode, direct)


@pytest.mark.train
def test_a_log_can_be_resampled(few_rows, tmp_path):
    frame_of(few_rows, JOINTS).to_parquet(tmp_path / "run.parquet")
    log = read_log(tmp_path / "run.parquet", map_of("parquet", tmp_path), ROBOT, step_s=0.00375)
    np.testing.assert_allclose(log.time_s, 0.00375 * np.arange(27), atol=1e-12)
    np.testing.assert_allclose(log.q[2], few_rows.q[3], atol=1e-11)
    middle = 0.5 * (few_rows.v[1] + few_rows.v[2])
    np.testing.assert_allclose(log.v[1], middle, atol=1e-11)


@pytest.mark.train
def test_velocities_that_are_not_logged_are_derivatives(few_rows, tmp_path):
    path = map_of("csv", tmp_path)
    lines = [line for line in path.read_text().splitlines() if "velocit" not in line]
    frame_of(few_rows, JOINTS).to_csv(tmp_path / "run.csv", index=False)
    path.write_text("\n".join(lines))
    log = read_log(tmp_path / "run.csv", path, ROBOT)
    # Drake's discrete velocity is that of the step that led to a state.
    between = 0.5 * (few_rows.v[2:-2] + few_rows.v[3:-1])
    np.testing.assert_allclose(log.v[2:-2, 3:6], between[:, 3:6], atol=2e-3)
    np.testing.assert_allclose(log.v[2:-2, 6:], between[:, 6:], atol=2e-2)
    np.testing.assert_allclose(log.v[2:-2, :3], between[:, :3], atol=2e-2)


def test_derivatives_are_exact_for_constant_acceleration_at_uneven_times():
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    np.testing.assert_allclose(rates(times, times[:, None] ** 2)[:, 0], 2 * times, atol=1e-12)
    angle = 0.5 * times + times**2
    turns = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    expected = np.outer(0.5 + 2 * times, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(angular_velocities(times, turns), expected, atol=1e-12)


SPOILT = {
    "a gap": (lambda f: f.drop(index=range(10, 25)), [("ns}", "ns}\nmax_gap_s: 0.03")],
              r"line 12, column 'stamp': a gap of 0.04 s"),
    "time backwards": (lambda f: f.iloc[[0, 1, 2, 4, 3, *range(5, 40)]], [],
                       "line 6, column 'stamp': time runs backwards"),
    "time twice": (lambda f: f.iloc[[0, 1, 2, 2, *range(3, 40)]], [],
                   "line 5, column 'stamp': time stands still"),
    "a missing column": (lambda f: f.drop(columns=["base_y"]), [],
                         r"no columns \['base_y'\]; it has .*'base_x', 'base_z'"),
    "an empty cell": (lambda f: f.assign(gyro_x=f.gyro_x.where(f.index != 7)), [],
                      "line 9, column 'gyro_x': the value is nan"),
    "a NaN": (lambda f: f.assign(gyro_x=f.gyro_x.where(f.index != 7, np.inf)), [],
              "line 9, column 'gyro_x': the value is inf"),
    "a word": (lambda f: f.assign(goal_x=["stop", *f.goal_x[1:]]), [],
               "line 2, column 'goal_x': 'stop' is not a number"),
    "no unit quaternion": (lambda f: f.assign(quat_x=f.quat_x + (f.index == 4)), [],
                           "line 6, columns .*norm of 1.4"),
    "quaternion order": (
        lambda f: f.rename(columns={"quat_w": "quat_x", "quat_x": "quat_y", "quat_y": "quat_z",
                                    "quat_z": "quat_w"}), [],
        "line 2: .*tilted by .*would stand if 'base_orientation.order' is wxyz"),
    "degrees as radians": (lambda f: f, [('_pos", unit: deg', '_pos", unit: rad')],
                           "far beyond its stops .*would stand if 'joint_positions.unit' is deg"),
    "millimetres as metres": (lambda f: f, [("base_z], unit: mm", "base_z], unit: m")],
                              "above the ground.*'base_position.unit' is mm"),
    "metres as millimetres": (lambda f: f.assign(base_z=f.base_z / 1e3), [],
                              "below the ground.*'base_position.unit' is m$"),
    "milliseconds": (lambda f: f.assign(stamp=f.stamp / 1e6), [("unit: ns", "unit: s")],
                     r"2.5 apart, .* one of \['ms'\]"),
    "goal in millimetres": (lambda f: f.assign(goal_z=1e3 * f.goal_z), [],
                            "desired output is .* m from the base"),
    "rates in degrees": (lambda f: f.assign(gyro_x=200.0), [("deg, frame", "rad, frame")],
                         r"columns \['gyro_x', .* by 202\.48 rad/s.* leave .* out"),
    "a joint beyond its stop": (
        lambda f: f.assign(**{f"{JOINTS[2]}_pos": f[f"{JOINTS[2]}_pos"] + 200.0 * (f.index == 9)}),
        [], rf"line 11, column '{JOINTS[2]}_pos': joint .* far beyond its stops"),
}  # fmt: skip


@pytest.mark.train
@pytest.mark.parametrize("what", SPOILT)
def test_what_is_wrong_is_named_with_row_and_column(what, few_rows, tmp_path):
    spoil, changes, message = SPOILT[what]
    with pytest.raises(ValueError, match=message):
        read_csv(spoil(frame_of(few_rows, JOINTS)), tmp_path, *changes)


@pytest.mark.train
def test_a_quaternion_order_that_turns_the_robot_around_is_told_by_its_sliding_feet(tmp_path):
    with pytest.raises(ValueError, match=r"line 2 and .* slide by .* 'base_orient.* is xyzw"):
        read_csv(frame_of(recorded(UNSAFE), JOINTS), tmp_path, ("order: xyzw", "order: wxyz"))


@pytest.mark.train
def test_messages_that_lack_something_say_what_there_is(few_rows, tmp_path):
    path = write(few_rows, JOINTS, "mcap", tmp_path)
    for old, new, message in [
        ("topic: /goal", "topic: /aim", r"no messages of topics \['/aim'\]; .*'/goal'"),
        ("point.x", "point.q", "message 0 of topic '/goal': cannot read 'point.q': .*'x', 'y'"),
        ("position[{joint}]", "position[l_{joint}]", f"no entry is named 'l_{JOINTS[0]}'"),
        ("position[{joint}]", "position[99]{joint}", "cannot read"),
        ("position[0]", "position[0", "is not a field path"),
        ("{topic: /goal, ", "{", "must name the topic of .*point.x"),
    ]:
        with pytest.raises(ValueError, match=message):
            read_log(path, map_of("mcap", tmp_path, (old, new)), ROBOT)


@pytest.mark.train
@pytest.mark.parametrize("kind", ["csv", "parquet", "mcap", "ros1"])
def test_a_file_that_was_cut_off_is_refused(kind, few_rows, tmp_path):
    path = write(few_rows, JOINTS, kind, tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole.rsplit(b",", 30)[0] if kind == "csv" else whole[: len(whole) * 2 // 3])
    message = "cut off: its last line" if kind == "csv" else "damaged|cut off"
    with pytest.raises(ValueError, match=message):
        read_log(path, map_of(kind, tmp_path), ROBOT)


@pytest.mark.train
@pytest.mark.parametrize("kind", ["csv", "parquet", "mcap", "ros2"])
def test_without_the_extra_it_is_named(kind, few_rows, tmp_path, monkeypatch):
    path = write(few_rows, JOINTS, kind, tmp_path)
    for name in ("pandas", "mcap", "rosbags"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=r"pip install 'drake_safety\[logs\]'"):
        read_log(path, map_of(kind, tmp_path), ROBOT)


@pytest.mark.train
def test_what_is_no_log_or_no_table_with_topics_is_refused(few_rows, tmp_path):
    columns = map_of("csv", tmp_path)
    for path, message in [
        (tmp_path / "none.csv", "does not exist"),
        (tmp_path, "without the metadata.yaml"),
        (columns, "suffix '.yaml'; known are"),
    ]:
        with pytest.raises(ValueError, match=message):
            read_log(path, columns, ROBOT)
    path = write(few_rows, JOINTS, "csv", tmp_path)
    with pytest.raises(ValueError, match="has no topics; the map names"):
        read_log(path, map_of("mcap", tmp_path), ROBOT)


@pytest.mark.train
def test_a_map_without_a_column_for_a_joint_names_it(few_rows, tmp_path):
    joints = f"{{columns: {{{JOINTS[0]}: a, wing: b}}, unit: deg}}"
    change = ('{template: "{joint}_pos", unit: deg}', joints)
    with pytest.raises(ValueError, match=rf"none for \['{JOINTS[1]}'.*no joints \['wing'\]"):
        read_csv(frame_of(few_rows, JOINTS), tmp_path, change)


def test_a_field_is_found_by_name_by_number_and_by_the_name_beside_it():
    class Motors:
        name = ("a", "b")
        q = (1.0, 2.0)

    class State:
        motors = (Motors(), Motors())

    assert field_of("motors[1].q[0]")(State()) == 1.0
    assert field_of("motors[0].q[b]")(State()) == 2.0
    with pytest.raises(LookupError, match="no entry is named 'c'; the names are"):
        field_of("motors[0].q[c]")(State())


@pytest.mark.train
def test_a_date_column_needs_no_unit(few_rows, tmp_path):
    frame = frame_of(few_rows, JOINTS)
    import pandas as pd

    frame["stamp"] = pd.to_datetime(frame["stamp"])
    frame.to_parquet(tmp_path / "run.parquet")
    changes = ("unit: ns", "unit: s")
    log = read_log(tmp_path / "run.parquet", map_of("parquet", tmp_path, changes), ROBOT)
    np.testing.assert_allclose(log.time_s, few_rows.time_s, atol=1e-12)
