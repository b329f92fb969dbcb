"""Recorded runs of our own loops, written as a robot's logs would be: tables, MCAP, ROS bags."""

import dataclasses
import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from cart_episodes import ARRAYS
from drake_safety import load_scenario
from drake_safety.logs.conversion import angular_velocities, rates
from drake_safety.logs.robot_log import RobotLog, read_pieces
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import episode_rng
from exported_robots import edited

ORIGIN_NS = 1_700_000_000_123_000_000
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
        End(duration_s=scenario.episode_duration_s, after_fall_s=math.inf),
        step_s=scenario.time_step_s,
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
def walked():
    """A trot in the world's direction of 1 rad, whose stance feet do not move, with a rocking base.

    Velocities are the derivatives of the positions.
    """
    kinematics, time_s = balancing_loop().kinematics, np.arange(400) / 200

    def heading(at_s):
        yaw = 1.0 + 0.3 * at_s
        x = 0.4 / 0.3 * np.stack([np.sin(yaw), -np.cos(yaw)], axis=-1)
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
            kinematics.set_positions(q)
            p_WC, J = kinematics.present_contacts()
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


ROBOT = balancing_loop().robot
JOINTS = balancing_loop().kinematics.joint_names
BASE, GYRO, LINEAR, GOAL = (
    [f"{name}_{a}" for a in "xyz"] for name in ("base", "gyro", "velocity", "goal")
)
QUATERNION = [f"quat_{a}" for a in "xyzw"]
ANGLES, RATES = ([f"{joint}_{kind}" for joint in JOINTS] for kind in ("pos", "vel"))
FEET = [f"feet_{i}" for i in range(12)]


def stamps_ns(log):
    return ORIGIN_NS + np.round(log.time_s * 1e9).astype(np.int64)


def body_rates(log):
    """Angular and linear velocity in the base, (N, 3) each."""
    turns = Rotation.from_quat(log.q[:, :4], scalar_first=True).inv()
    return turns.apply(log.v[:, :3]), turns.apply(log.v[:, 3:6])


def frame_of(log):
    """A table with millimetres, degrees, x y z w and body velocities, whose clock counts ns."""
    import pandas as pd

    turning, moving = body_rates(log)
    values = [1e3 * log.q[:, 4:7], log.q[:, [1, 2, 3, 0]], np.rad2deg(turning), moving]
    values += [np.rad2deg(log.q[:, 7:]), log.v[:, 6:], log.desired_output, log.foot_positions]
    columns = [*BASE, *QUATERNION, *GYRO, *LINEAR, *ANGLES, *RATES, *GOAL, *FEET]
    frame = pd.DataFrame(np.hstack(values), columns=columns)
    frame.insert(0, "stamp", stamps_ns(log))
    return frame


TABLE_MAP = """
time: {column: stamp, unit: ns}
base_position: {columns: [base_x, base_y, base_z], unit: mm}
base_orientation: {columns: [quat_x, quat_y, quat_z, quat_w], order: xyzw}
base_angular_velocity: {columns: [gyro_x, gyro_y, gyro_z], unit: deg, frame: body}
base_linear_velocity: {columns: [velocity_x, velocity_y, velocity_z], frame: body}
joint_positions: {template: "{joint}_pos", unit: deg}
joint_velocities: {template: "{joint}_vel"}
desired_output: {columns: [goal_x, goal_y, goal_z]}
foot_positions: {columns: FEET}
""".replace("FEET", str(FEET))

MESSAGE_MAP = """
time: {column: header.stamp}
base_position: {topic: /odom, columns: [POSE.position.x, POSE.position.y, POSE.position.z]}
base_orientation:
  topic: /odom
  columns: [POSE.orientation.x, POSE.orientation.y, POSE.orientation.z, POSE.orientation.w]
  order: xyzw
base_angular_velocity:
  {topic: /odom, columns: [TWIST.angular.x, TWIST.angular.y, TWIST.angular.z], frame: body}
base_linear_velocity:
  {topic: /odom, columns: [TWIST.linear.x, TWIST.linear.y, TWIST.linear.z], frame: body}
joint_positions: {topic: /joint_states, template: "position[{joint}]"}
joint_velocities: {topic: /joint_states, template: "velocity[{joint}]"}
desired_output: {topic: /goal, columns: [point.x, point.y, point.z]}
foot_positions: {topic: /feet, columns: FEET}
""".replace("POSE", "pose.pose").replace("TWIST", "twist.twist")
MESSAGE_MAP = MESSAGE_MAP.replace("FEET", str([f"position[{i}]" for i in range(12)]))


def map_beside(path, *changes):
    """Writes the map of a log of `write` or `save` beside it, with changes of its text."""
    text = TABLE_MAP if path.suffix in (".csv", ".parquet") else MESSAGE_MAP
    (path.parent / "columns.yaml").write_text(edited(text, dict(changes)))
    return path.parent / "columns.yaml"


def read(path, *changes, reader=read_pieces, **options):
    return reader(path, map_beside(path, *changes), ROBOT, **options)


def save(frame, folder, kind="csv"):
    path = folder / f"run.{kind}"
    if kind == "csv":
        frame.to_csv(path, index=False)
    else:
        frame.to_parquet(path)
    return path


TYPES = {
    "/odom": "nav_msgs/msg/Odometry",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/goal": "geometry_msgs/msg/PointStamped",
    "/feet": "sensor_msgs/msg/JointState",
}


def messages(log, store, change):
    """Every message as (topic, stamp, message); joints stand in an order of their own."""

    def of(kind, *values):
        return store.types[kind.replace("/", "/msg/")](*values)

    def header(stamp):
        names = store.types["std_msgs/msg/Header"].__dataclass_fields__
        time = of("builtin_interfaces/Time", *divmod(stamp, 1_000_000_000))
        return of("std_msgs/Header", *([0] if "seq" in names else []), time, "world")

    w, v = body_rates(log)
    none, covariance = np.zeros(0), np.zeros(36)
    for i, stamp in enumerate(stamps_ns(log).tolist()):
        qw, *q_xyz = log.q[i, :4]
        position = of("geometry_msgs/Point", *log.q[i, 4:7])
        pose = of("geometry_msgs/Pose", position, of("geometry_msgs/Quaternion", *q_xyz, qw))
        pose = of("geometry_msgs/PoseWithCovariance", pose, covariance)
        rates = (of("geometry_msgs/Vector3", *vector[i]) for vector in (v, w))
        twist = of("geometry_msgs/Twist", *rates)
        twist = of("geometry_msgs/TwistWithCovariance", twist, covariance)
        yield "/odom", stamp, of("nav_msgs/Odometry", header(stamp), "base", pose, twist)
        values = map(np.ascontiguousarray, (log.q[i, :6:-1], log.v[i, :5:-1]))
        state = of("sensor_msgs/JointState", header(stamp), JOINTS[::-1], *values, none)
        for other, delay in change(state, i):
            late = stamp + delay
            yield "/joint_states", late, dataclasses.replace(other, header=header(late))
        point = of("geometry_msgs/Point", *log.desired_output[i])
        yield "/goal", stamp, of("geometry_msgs/PointStamped", header(stamp), point)
        feet = of("sensor_msgs/JointState", header(stamp), [], log.foot_positions[i], none, none)
        yield "/feet", stamp, feet


def write(log, folder, kind, *, change=lambda message, i: [(message, 0)]):
    """Writes a log in one of the `FORMATS`; returns its path.

    In messages `change` gives, for a message of joints and its number, those to be written instead,
    each with a delay [ns].
    """
    if kind in ("csv", "parquet"):
        return save(frame_of(log), folder, kind)
    import mcap.writer
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    path = folder / {"ros1": "run.bag", "ros2": "run_ros2", "mcap": "run.mcap"}[kind]
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    found = [(t, at, serialize(m, TYPES[t])) for t, at, m in messages(log, store, change)]
    if kind == "mcap":
        with path.open("wb") as file:
            writer = mcap.writer.Writer(file)
            writer.start("ros2")
            channels = {}
            for topic, name in TYPES.items():
                text = store.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name.replace("/msg/", "/"), "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            for topic, stamp, data in found:
                writer.add_message(channels[topic], stamp, bytes(data), stamp)
            writer.finish()
        return path
    with rosbag1.Writer(path) if kind == "ros1" else rosbag2.Writer(path, version=9) as writer:
        topics = {t: writer.add_connection(t, name, typestore=store) for t, name in TYPES.items()}
        for topic, stamp, data in found:
            writer.write(topics[topic], stamp, data)
    return path


def part(log, first, last, again=0, end=0):
    """The rows of a log from one to another, and of a second such part; time is from the first."""
    rows = np.r_[first:last, again:end]
    arrays = {name: getattr(log, name) for name in ("q", "v", "desired_output", "foot_positions")}
    found = {name: None if array is None else array[rows] for name, array in arrays.items()}
    return dataclasses.replace(log, time_s=log.time_s[rows] - log.time_s[first], **found)


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
