"""McapRecorder: writes a simulation as ROS 2 messages into an MCAP file."""

import json
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, Diagram, PortDataType

from drake_safety.extras import require_extra
from drake_safety.learning.inputs import preview_names
from drake_safety.logs.log_map import ATTACHED_MAP
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop

_PERIOD_S = 0.02  # For a diagram without a scenario.
_ROUNDING_S = 1e-6
_BREAK_NS = 1_000_000_000  # Before a motion that begins anew.
_STATE, _GOAL, _FEET = "measured_plant_state", "desired_output", "desired_foot_positions"
_POSE = [f"base_{entry}" for entry in ("qw", "qx", "qy", "qz", "x", "y", "z")]
WATCHED = "watched_inputs"  # Topic of the monitor's inputs.
_RATES = [f"base_{entry}" for entry in ("wx", "wy", "wz", "vx", "vy", "vz")]
_Monitor = Callable[[Context], object]
_BELIEF = ["safe", "unsafe", "unknown"]


class McapRecorder:
    """Records the output ports of a diagram; a ``with`` block closes the file.

    It is a monitor of Drake's Simulator (``set_monitor``) and of `simulate`, and writes a row every
    step of the scenario's change monitor, or 0.02 s. Each port is a topic, each entry of a vector a
    number with a name. A `LeggedLoop` adds ``/tf``, the true poses of all bodies, and the map by
    which `read_pieces` reads the measured state. With the engine ``drake`` it adds ``/actuation``,
    torques [N·m] or forces [N] by joint, and ``/contact_forces`` on each foot in the world [N].
    Stamps are times of the Context; a motion that begins anew follows after a second.

    Args:
        monitor: Called with each Context as well; it may end the simulation.
    """

    def __init__(self, diagram: Diagram, path: str | Path, monitor: _Monitor | None = None):
        require_extra("logs", f"MCAP file '{path}'", "mcap", "rosbags")
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore

        is_loop = isinstance(diagram, ClosedLoop)
        self._period_s = diagram.scenario.monitor_step_s if is_loop else _PERIOD_S
        self._monitor, self._store = monitor, get_typestore(Stores.ROS2_HUMBLE)
        self._now_s = self._due_s = -math.inf
        self._stamp_ns = self._shift_ns = 0
        self._topics: dict[str, tuple[int, Callable[[Context], bytes]]] = {}
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(str(path))  # Closes the file as it finishes.
        self._writer.start("ros2", "drake_safety")
        names = _entry_names(diagram) if is_loop else {}
        for port in map(diagram.get_output_port, range(diagram.num_output_ports())):
            name, size = port.get_name(), port.size()
            if port.get_data_type() == PortDataType.kVectorValued:
                numbered = ["value"] if size == 1 else [f"entry_{i}" for i in range(size)]
                self._add_numbers(name, names.get(name, numbered), port.Eval)
            elif isinstance(port.Allocate().get_value(), str):
                self._add(name, "std_msgs/msg/String", lambda c, port=port: [port.Eval(c)])
        if isinstance(diagram, LeggedLoop):
            self._add_robot(diagram)
            data = json.dumps(_log_map(diagram, names), indent=2).encode()
            self._writer.add_attachment(0, 0, ATTACHED_MAP, "application/json", data)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.finish()

    def __call__(self, context: Context) -> object:
        """Writes a row of a root Context if one is due; returns what the monitor returns."""
        now_s, before_s = context.get_time(), self._now_s
        if now_s < before_s:
            self._shift_ns += round(1e9 * (before_s - now_s)) + _BREAK_NS
            self._due_s = -math.inf
        self._now_s = now_s
        if now_s >= self._due_s - _ROUNDING_S:
            is_late = now_s - self._due_s >= self._period_s  # The simulator's steps are longer.
            self._due_s = self._period_s + (now_s if is_late else self._due_s)
            self._stamp_ns = round(1e9 * now_s) + self._shift_ns
            row = [(channel, make(context)) for channel, make in self._topics.values()]
            for channel, data in row:  # The row is complete, wherever Ctrl-C stops it.
                self._writer.add_message(channel, self._stamp_ns, data, self._stamp_ns)
        return None if self._monitor is None else self._monitor(context)

    def _of(self, kind: str, *values: Any) -> Any:
        """A message of a type such as ``std_msgs/msg/String``."""
        return self._store.types[kind](*values)

    def _add(self, topic: str, kind: str, fields: Callable[..., Iterable[Any]]) -> None:
        """Adds a topic, whose messages have the given fields of a root Context."""
        text, _ = self._store.generate_msgdef(kind, ros_version=2)
        schema = self._writer.register_schema(kind, "ros2msg", text.encode())
        channel = self._writer.register_channel(f"/{topic}", "cdr", schema)

        def make(context: Context) -> bytes:
            return bytes(self._store.serialize_cdr(self._of(kind, *fields(context)), kind))

        self._topics[topic] = channel, make

    def _add_numbers(
        self, topic: str, names: Iterable[str], values: Callable[[Context], Iterable[float]]
    ) -> None:
        from rosbags.typesys import get_types_from_msg

        kind = f"drake_safety/msg/{topic.title().replace('_', '')}"
        if text := "".join(f"float64 {field}\n" for field in field_names(names)):
            self._store.register(get_types_from_msg(text, kind))
            self._add(topic, kind, values)

    def _add_robot(self, loop: LeggedLoop) -> None:
        plant, instance, own = loop.plant, loop.robot_instance, loop.plant.CreateDefaultContext()
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        is_drake = loop.scenario.variation(loop.variation).engine == "drake"

        def plant_context(context: Context) -> Context:
            if is_drake:
                return plant.GetMyContextFromRoot(context)
            state = loop.GetOutputPort("plant_state").Eval(context)
            plant.SetPositionsAndVelocities(own, instance, state)
            return own

        def transforms(context: Context) -> list[Any]:
            at, made = plant_context(context), []
            time = self._of("builtin_interfaces/msg/Time", *divmod(self._stamp_ns, 1_000_000_000))
            header = self._of("std_msgs/msg/Header", time, "world")
            for body in bodies:
                is_own = body.model_instance() == instance
                name = body.name() if is_own else body.scoped_name().get_full()
                X_WB = plant.EvalBodyPoseInWorld(at, body)
                w, *xyz = X_WB.rotation().ToQuaternion().wxyz()
                place = self._of("geometry_msgs/msg/Vector3", *X_WB.translation())
                turn = self._of("geometry_msgs/msg/Quaternion", *xyz, w)
                pose = self._of("geometry_msgs/msg/Transform", place, turn)
                made.append(self._of("geometry_msgs/msg/TransformStamped", header, name, pose))
            return [made]

        self._add("tf", "tf2_msgs/msg/TFMessage", transforms)
        if not is_drake:
            return
        motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
        # The plant reports a joint's net actuation for each of its actuators.
        entry = {motor.joint().name(): i for i, motor in enumerate(motors)}
        net = plant.get_net_actuation_output_port(instance)
        places = [*entry.values()]
        self._add_numbers("actuation", entry, lambda c: net.Eval(plant_context(c))[places])
        feet = [plant.GetBodyByName(foot.body, instance) for foot in loop.robot.feet.values()]

        def forces(context: Context) -> np.ndarray:
            contacts = plant.get_contact_results_output_port().Eval(plant_context(context))
            total = {int(foot.index()): np.zeros(3) for foot in feet}
            for i in range(contacts.num_point_pair_contacts()):
                pair = contacts.point_pair_contact_info(i)
                for body, sign in ((pair.bodyA_index(), -1.0), (pair.bodyB_index(), 1.0)):
                    if int(body) in total:
                        total[int(body)] += sign * pair.contact_force()
            return np.concatenate([*total.values()])

        names = [f"{foot.name()}_{axis}" for foot in feet for axis in "xyz"]
        self._add_numbers("contact_forces", names, forces)


def _entry_names(loop: ClosedLoop) -> dict[str, list[str]]:
    """Names of the entries of a loop's ports."""
    states, constraints = loop.state_names, loop.constraint_names
    names = dict.fromkeys(("state", "true_state"), states)
    names |= dict.fromkeys(("output", _GOAL), loop.output_names)
    names |= dict.fromkeys(("margins", "predicted_margins", "cause_probability"), constraints)
    names |= dict.fromkeys(("belief", "belief_without_alarm"), _BELIEF)
    names["features"] = loop.feature_names
    if loop.assessment is not None:
        names["desired_preview"] = preview_names(loop.assessment.info_)
        names["levels"] = [states[i] for i in loop.assessment.detector_.watched]
        names[WATCHED] = loop.assessment.detector_.input_names(loop.assessment.info_)
    if isinstance(loop, LeggedLoop):
        joints = loop.kinematics.joint_names
        state = [*_POSE, *joints, *_RATES, *(f"{joint}_rate" for joint in joints)]
        names |= dict.fromkeys(("plant_state", _STATE), state)
    return names


def _log_map(loop: LeggedLoop, names: dict[str, list[str]]) -> dict[str, Any]:
    """The map of the file, as of a `LogMap`."""
    joints, state = loop.kinematics.joint_names, field_names(names[_STATE])
    q, v = state[: loop.kinematics.num_positions], state[loop.kinematics.num_positions :]
    columns: dict[str, Any] = {
        "base_orientation": q[:4],
        "base_position": q[4:7],
        "joint_positions": dict(zip(joints, q[7:], strict=True)),
        "base_angular_velocity": v[:3],
        "base_linear_velocity": v[3:6],
        "joint_velocities": dict(zip(joints, v[6:], strict=True)),
    }
    log_map = {name: {"topic": f"/{_STATE}", "columns": part} for name, part in columns.items()}
    log_map[_GOAL] = {"topic": f"/{_GOAL}", "columns": field_names(names[_GOAL])}
    if loop.HasOutputPort(_FEET):
        entries = [f"entry_{i}" for i in range(loop.GetOutputPort(_FEET).size())]
        log_map["foot_positions"] = {"topic": f"/{_FEET}", "columns": entries}
    return log_map


def field_names(names: Iterable[str]) -> list[str]:
    """Names of fields: lower-case letters, digits and single underscores, each once."""
    fields: list[str] = []
    for name in names:
        field = re.sub(r"[\W_]+", "_", name.lower(), flags=re.ASCII).strip("_")
        field = field if field[:1].isalpha() else f"entry_{field}"
        fields.append(field if field not in fields else f"{field}_{len(fields)}")
    return fields
