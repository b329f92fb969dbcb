"""Logs of any format say the same of a robot, and what is wrong with one is said where it is."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_safety.logs.conversion import angular_velocities, rates
from drake_safety.logs.episodes import cut_log
from drake_safety.logs.messages import field_of
from drake_safety.logs.robot_log import read_log
from log_files import (
    FORMATS,
    JOINTS,
    ROBOT,
    UNSAFE,
    assert_same,
    balancing_loop,
    frame_of,
    map_beside,
    part,
    read,
    recorded,
    save,
    write,
)

VALUES = ("time_s", "q", "v", "desired_output", "foot_positions")


def few_rows():
    return part(recorded(UNSAFE), 0, 40)


@pytest.mark.train
@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_episode(kind, tmp_path):
    log = recorded(UNSAFE)
    found = read(write(log, tmp_path, kind))
    (piece,) = found.pieces
    assert (found.cuts, found.kept_share) == ([], 1.0)
    for name in VALUES:
        np.testing.assert_allclose(getattr(piece, name), getattr(log, name), atol=1e-11)
    (direct,) = cut_log(log, balancing_loop())[0]
    (episode,) = cut_log(piece, balancing_loop())[0]
    assert not direct.is_safe
    assert_same(episode, direct)


def test_derivatives_are_exact_for_constant_acceleration_at_uneven_times():
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    np.testing.assert_allclose(rates(times, times[:, None] ** 2)[:, 0], 2 * times, atol=1e-12)
    angle = 0.5 * times + times**2
    turns = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    expected = np.outer(0.5 + 2 * times, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(angular_velocities(times, turns), expected, atol=1e-12)


SPOILT = {
    "missing columns": (lambda f: f, [("{joint}_pos", "l_{joint}")],
                        r"no columns \['l_.*, .*\] and 7 more; it has \['stamp', 'base_x'"),
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
    "metres as millimetres": (lambda f: f.assign(base_z=f.base_z / 1e3), [],
                              "below the ground.*'base_position.unit' is m$"),
    "milliseconds": (lambda f: f.assign(stamp=f.stamp / 1e6), [("unit: ns", "unit: s")],
                     r"2.5 s apart, which is implausible: check 'time.unit'"),
    "goal in millimetres": (lambda f: f.assign(goal_z=1e3 * f.goal_z), [],
                            "desired output is .* m from the robot"),
    "goal in metres as millimetres": (lambda f: f, [("goal_z]", "goal_z], unit: mm")],
                                      r"at z = 0.0004.*expected .*'desired_output.unit' is m$"),
    "a velocity as goal": (
        lambda f: f.assign(**{f"goal_{a}": f[f"velocity_{a}"] for a in "xyz"}), [],
        "expected a position, no velocity, within 1.27 m, at z = 0.212 to 0.849 m: check col"),
    "a joint beyond its stop": (
        lambda f: f.assign(**{f"{JOINTS[2]}_pos": f[f"{JOINTS[2]}_pos"] + 200.0 * (f.index == 9)}),
        [], rf"line 11, column '{JOINTS[2]}_pos': joint .* far beyond its stops"),
}  # fmt: skip


@pytest.mark.train
@pytest.mark.parametrize("what", SPOILT)
def test_what_is_wrong_is_named_with_row_and_column(what, tmp_path):
    spoil, changes, message = SPOILT[what]
    with pytest.raises(ValueError, match=message):
        read(save(spoil(frame_of(few_rows())), tmp_path), *changes)


@pytest.mark.train
def test_messages_that_lack_something_say_what_there_is(tmp_path):
    path = write(few_rows(), tmp_path, "mcap")
    for old, new, message in [
        ("topic: /goal", "topic: /aim", r"no messages of topics \['/aim'\]; .*'/goal'"),
        ("point.x", "point.q", "message 0 of topic '/goal': cannot read 'point.q': .*'x', 'y'"),
        ("position[0]", "position[0", "is not a field path"),
        ("{topic: /goal, ", "{", "must name the topic of .*point.x"),
    ]:
        with pytest.raises(ValueError, match=message):
            read(path, (old, new))


@pytest.mark.train
@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_without_the_extra_it_is_named(kind, tmp_path, monkeypatch):
    path = write(few_rows(), tmp_path, kind)
    for name in ("pandas", "mcap", "rosbags"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=r"pip install 'drake_safety\[logs\]'"):
        read(path)


@pytest.mark.train
def test_what_is_no_log_or_no_table_with_topics_is_refused(tmp_path):
    log = tmp_path / "run.csv"
    columns = map_beside(log)
    for path, message in [(log, "does not exist"), (columns, "suffix '.yaml'; known are")]:
        with pytest.raises(ValueError, match=message):
            read_log(path, columns, ROBOT)
    write(few_rows(), tmp_path, "csv")
    with pytest.raises(ValueError, match="has no topics; the map names"):
        read_log(log, map_beside(tmp_path / "run.mcap"), ROBOT)


def test_a_field_is_found_by_number_by_the_name_beside_it_and_by_its_frame():
    motors = SimpleNamespace(name=("a", "b"), q=(1.0, 2.0))
    state = SimpleNamespace(motors=(motors, motors))
    assert field_of("motors[1].q[0]")(state) == 1.0
    assert field_of("motors[0].q[b]")(state) == 2.0
    frames = [SimpleNamespace(child_frame_id=name, x=x) for x, name in enumerate(("hip", "/base"))]
    message = SimpleNamespace(transforms=frames)
    assert field_of("transforms[base].x")(message) == 1
    with pytest.raises(LookupError, match=r"no entry is named 'foot'; .*\['hip', 'base'\]"):
        field_of("transforms[foot].x")(message)
