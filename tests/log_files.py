"""Recorded runs of our own loops, written as a robot's logs would be: tables, MCAP, ROS bags."""

import dataclasses
import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from cart_episodes import ARRAYS
from drake_safety import load_scenario
from drake_safety.logs.conversion import angular_velocities, rates
from drake_safety.logs.robot_log import RobotLog
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.motion import simulate
from drake_safety.simulation.rollouts import episode_rng

ORIGIN_NS = 1_700_000_000_123_000_000
POINT = ("x", "y", "z")
FORMATS = ("csv", "parquet", "mcap", "ros2", "ros1")
# Episodes of the short balancing below that end so.
SAFE, UNSAFE = 0, 5


@functools.cache
def balancing_scenario():
    """Short episodes of the packaged robot, whose actual plant is measured without noise."""
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 0.6
    scenario.parameters.push.share = 0.0
    start = scenario.parameters.start
    start.plan_duration_s = [0.3, 0.5]  # The log holds all of the plan.
    start.base_height_m = [0.39, 0.42]
    start.tracking_offset_m = [0.0, 0.0, 0.0]
    scenario.assessment.preview_stride, scenario.assessment.shortest_segment = 1, 0
    scenario.parameters.safe_set.height_m = [0.37, 0.44]
    scenario.variations["actual"] = PlantVariation(joint_friction_nm=0.4)
    return scenario


@functools.cache
def balancing_loop():
    return balancing_scenario().make_loop("actual")


def record(loop, index=0, **goal):
    """An episode's run at the plant's own rate, to the end of its time whatever happens."""
    scenario = loop.scenario
    starts = []

    def start(context):
        loop.reset(context, episode_rng(0, index), **goal)
        starts.append(loop.start_of(context))

    motion = simulate(
        loop,
        start,
        ["plant_state", "desired_output"],
        duration_s=scenario.episode_duration_s,
        step_s=scenario.time_step_s,
        after_fall_s=math.inf,
    )
    q, v = np.split(motion["plant_state"].copy(), [loop.kinematics.num_positions], axis=1)
    times, feet = motion.time_s, starts[0].foot_positions
    q[:, :4] /= np.linalg.norm(q[:, :4], axis=1, keepdims=True)
    return RobotLog(
        path="recorded",
        robot=loop.robot.name,
        time_s=times,
        q=q,
        v=v,
        desired_output=motion["desired_output"],
        foot_positions=None if feet is None else np.tile(feet.ravel(), (len(times), 1)),
    )


@functools.cache
def recorded(index=0):
    return record(balancing_loop(), index)


@functools.cache
def walked(speed_m_s=0.4, turn_rad_s=0.3, duration_s=2.0, rate_hz=200):
    """A trot in the world's direction of 1 rad, whose stance feet do not move, with a rocking base.

    Velocities are the derivatives of the positions.
    """
    kinematics = balancing_loop().kinematics
    time_s = np.arange(int(duration_s * rate_hz)) / rate_hz

    def heading(at_s):
        yaw = 1.0 + turn_rad_s * at_s
        x = speed_m_s / turn_rad_s * np.stack([np.sin(yaw), -np.cos(yaw)], axis=-1)
        return yaw, x

    def print_of(foot, at_s):
        yaw, x = heading(at_s)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        point = x + turn @ (kinematics.nominal_contacts[foot] - kinematics.nominal_base_offset)
        return np.array([*point, kinematics.foot_radii[foot]])

    half_s, standing = 0.25, kinematics.standing_positions()
    joints, rows = standing[7:].copy(), []
    for now in time_s:
        yaw, x = heading(now)
        rocking = 0.08 * np.sin(2 * np.pi * np.array([2.0, 2.5]) * now)
        height = 0.96 * kinematics.standing_height + 0.01 * np.sin(12.0 * now)
        R_WB = Rotation.from_euler("ZYX", [yaw, *rocking])
        q = np.concatenate([R_WB.as_quat(scalar_first=True), x, [height], joints])
        targets = []
        for foot in range(kinematics.num_contacts):
            number, share = divmod(now / half_s + (foot in (0, 3)), 2)
            # In even halves of its period a foot stands, in odd ones it swings.
            last = print_of(foot, half_s * (2 * number + 0.5 - (foot in (0, 3))))
            after = print_of(foot, half_s * (2 * number + 2.5 - (foot in (0, 3))))
            swing = np.clip(share - 1.0, 0.0, 1.0)
            lift = [0.0, 0.0, 0.06 * np.sin(np.pi * swing)]
            targets.append(last + (3 - 2 * swing) * swing**2 * (after - last) + lift)
        for _ in range(6):
            p_WC, J = kinematics.contact_positions_and_jacobian(q)
            q[7:] += np.linalg.solve(J[:, 6:], (np.array(targets) - p_WC).ravel())
        joints = q[7:].copy()
        rows.append(q)
    q = np.array(rows)
    turns = Rotation.from_quat(q[:, :4], scalar_first=True)
    v = np.hstack([angular_velocities(time_s, turns), rates(time_s, q[:, 4:])])
    feet = np.tile(print_of(0, 0.0), (len(q), kinematics.num_contacts))
    return RobotLog(
        path="walked",
        robot=balancing_loop().robot.name,
        time_s=time_s,
        q=q,
        v=v,
        desired_output=q[:, 4:7],
        foot_positions=feet,
    )


def stamps_ns(log):
    return ORIGIN_NS + np.round(log.time_s * 1e9).astype(np.int64)


def frame_of(log, joints):
    """A table with millimetres, degrees, x y z w and body velocities, whose clock counts ns."""
    columns = {"stamp": stamps_ns(log)}
    columns |= {f"base_{a}": 1e3 * log.q[:, 4 + i] for i, a in enumerate(POINT)}
    columns |= {f"quat_{a}": log.q[:, i] for a, i in zip("xyzw", (1, 2, 3, 0), strict=True)}
    rotations = Rotation.from_quat(log.q[:, :4], scalar_first=True)
    body = rotations.inv().apply(log.v[:, :3]), rotations.inv().apply(log.v[:, 3:6])
    columns |= {f"gyro_{a}": np.rad2deg(body[0][:, i]) for i, a in enumerate(POINT)}
    columns |= {f"velocity_{a}": body[1][:, i] for i, a in enumerate(POINT)}
    columns |= {f"{name}_pos": np.rad2deg(log.q[:, 7 + i]) for i, name in enumerate(joints)}
    columns |= {f"{name}_vel": log.v[:, 6 + i] for i, name in enumerate(joints)}
    columns |= {f"goal_{a}": log.desired_output[:, i] for i, a in enumerate(POINT)}
    columns |= {f"feet_{i}": log.foot_positions[:, i] for i in range(log.foot_positions.shape[1])}
    import pandas as pd

    return pd.DataFrame(columns)


TABLE_MAP = """
time: {column: stamp, unit: ns}
base_position: {columns: [base_x, base_y, base_z], unit: mm}
base_orientation: {columns: [quat_x, quat_y, quat_z, quat_w], order: xyzw}
base_angular_velocity: {columns: [gyro_x, gyro_y, gyro_z], unit: deg, frame: body}
base_linear_velocity: {columns: [velocity_x, velocity_y, velocity_z], frame: body}
joint_positions: {template: "{joint}_pos", unit: deg}
joint_velocities: {template: "{joint}_vel"}
desired_output: {columns: [goal_x, goal_y, goal_z]}
foot_positions:
  columns: [feet_0, feet_1, feet_2, feet_3, feet_4, feet_5,
            feet_6, feet_7, feet_8, feet_9, feet_10, feet_11]
"""

MESSAGE_MAP = """
time: {column: header.stamp}
base_position:
  topic: /odom
  columns: [pose.pose.position.x, pose.pose.position.y, pose.pose.position.z]
base_orientation:
  topic: /odom
  columns:
    - pose.pose.orientation.x
    - pose.pose.orientation.y
    - pose.pose.orientation.z
    - pose.pose.orientation.w
  order: xyzw
base_linear_velocity:
  topic: /odom
  columns: [twist.twist.linear.x, twist.twist.linear.y, twist.twist.linear.z]
  frame: body
base_angular_velocity:
  topic: /odom
  columns: [twist.twist.angular.x, twist.twist.angular.y, twist.twist.angular.z]
  frame: body
joint_positions: {topic: /joint_states, template: "position[{joint}]"}
joint_velocities: {topic: /joint_states, template: "velocity[{joint}]"}
desired_output: {topic: /goal, columns: [point.x, point.y, point.z]}
foot_positions:
  topic: /feet
  columns:
"""
MESSAGE_MAP += "".join(f'    - "position[{i}]"\n' for i in range(12))


def map_text(kind):
    return TABLE_MAP if kind in ("csv", "parquet") else MESSAGE_MAP


def write(log, joints, kind, folder, **how):
    """Writes a log in one of the `FORMATS`; returns its path.

    In messages `change` gives, for a message of joints and its number, those to be written instead,
    each with a delay [ns]; `chunk_size` is that of an MCAP file.
    """
    path = folder / {"ros1": "run.bag", "ros2": "run_ros2"}.get(kind, f"run.{kind}")
    if kind == "csv":
        frame_of(log, joints).to_csv(path, index=False)
    elif kind == "parquet":
        frame_of(log, joints).to_parquet(path)
    elif kind == "mcap":
        _write_mcap(log, joints, path, **how)
    else:
        _write_bag(log, joints, path, kind, **how)
    return path


def _typestore(ros1=False):
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


TYPES = {
    "/odom": "nav_msgs/msg/Odometry",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/goal": "geometry_msgs/msg/PointStamped",
    "/feet": "sensor_msgs/msg/JointState",
}


def messages(log, joints, store, array=np.ascontiguousarray):
    """Every message as (topic, stamp, message); joints stand in an order of their own."""

    def of(kind, *values, **named):
        return store.types[kind.replace("/", "/msg/")](*values, **named)

    rotations = Rotation.from_quat(log.q[:, :4], scalar_first=True).inv()
    w, v = rotations.apply(log.v[:, :3]), rotations.apply(log.v[:, 3:6])
    names, none, covariance = joints[::-1], array(np.zeros(0)), array(np.zeros(36))
    fields = store.types["std_msgs/msg/Header"].__dataclass_fields__
    for i, stamp in enumerate(stamps_ns(log).tolist()):
        time = of("builtin_interfaces/Time", *divmod(stamp, 1_000_000_000))
        sequence = {"seq": i} if "seq" in fields else {}
        header = of("std_msgs/Header", stamp=time, frame_id="world", **sequence)
        qw, *q_xyz = log.q[i, :4]
        pose = of(
            "geometry_msgs/Pose",
            of("geometry_msgs/Point", *log.q[i, 4:7]),
            of("geometry_msgs/Quaternion", *q_xyz, qw),
        )
        rates = (of("geometry_msgs/Vector3", *vector[i]) for vector in (v, w))
        pose = of("geometry_msgs/PoseWithCovariance", pose, covariance)
        twist = of("geometry_msgs/Twist", *rates)
        twist = of("geometry_msgs/TwistWithCovariance", twist, covariance)
        yield "/odom", stamp, of("nav_msgs/Odometry", header, "base", pose, twist)
        positions, velocities = array(log.q[i, :6:-1]), array(log.v[i, :5:-1])
        state = of("sensor_msgs/JointState", header, names, positions, velocities, none)
        yield "/joint_states", stamp, state
        point = of("geometry_msgs/Point", *log.desired_output[i])
        yield "/goal", stamp, of("geometry_msgs/PointStamped", header, point)
        feet = array(log.foot_positions[i])
        yield "/feet", stamp, of("sensor_msgs/JointState", header, [], feet, none, none)


def changed(found, change):
    """Messages in which those of joints are replaced; their headers say the delay too."""
    number = 0
    for topic, stamp, message in found:
        if topic != "/joint_states" or change is None:
            yield topic, stamp, message
            continue
        for other, delay in change(message, number):
            time = divmod(stamp + delay, 1_000_000_000)
            header = dataclasses.replace(message.header, stamp=type(message.header.stamp)(*time))
            yield topic, stamp + delay, dataclasses.replace(other, header=header)
        number += 1


def _write_bag(log, joints, path, kind, change=None, chunk_size=None):
    from rosbags import rosbag1, rosbag2

    store = _typestore(ros1=kind == "ros1")
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    bag = rosbag1.Writer(path) if kind == "ros1" else rosbag2.Writer(path, version=9)
    with bag as writer:
        topics = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in TYPES.items()
        }
        for topic, stamp, message in changed(messages(log, joints, store), change):
            writer.write(topics[topic], stamp, serialize(message, TYPES[topic]))


def _write_mcap(log, joints, path, change=None, chunk_size=1 << 20):
    from mcap_ros2.writer import Writer

    store = _typestore()
    with path.open("wb") as file, Writer(file, chunk_size) as writer:
        schemas = {
            topic: writer.register_msgdef(
                name.replace("/msg/", "/"), store.generate_msgdef(name, ros_version=2)[0]
            )
            for topic, name in TYPES.items()
        }
        for topic, stamp, message in changed(messages(log, joints, store, array=list), change):
            writer.write_message(topic, schemas[topic], message, stamp, stamp)


def part(log, first, last):
    """The rows of a log from one to another, with the time from the first of them."""
    rows = slice(first, last)
    values = {
        name: getattr(log, name)[rows]
        for name in ("q", "v", "desired_output", "foot_positions")
        if getattr(log, name) is not None
    }
    times = log.time_s[rows] - log.time_s[first]
    return dataclasses.replace(log, time_s=times, **values)


LOAD_TOLERANCE_RAD = 1e-5


def assert_same(episode, other, rows=slice(None), names=ARRAYS, atol=1e-9, num_loads=0):
    """Compares episodes; of the last features, servo loads, z* is needed between the log's rows."""
    assert (episode.is_safe, episode.cause) == (other.is_safe, other.cause)
    for name in names:
        sides = [getattr(one, name)[rows] for one in (episode, other)]
        if name == "features" and num_loads:
            loads = [side[:, -num_loads:] for side in sides]
            np.testing.assert_allclose(*loads, atol=LOAD_TOLERANCE_RAD, err_msg="servo loads")
            sides = [side[:, :-num_loads] for side in sides]
        np.testing.assert_allclose(*sides, atol=atol, err_msg=name)
