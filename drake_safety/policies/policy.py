"""Locomotion policies as data: observation terms, actions, gait clock and command limits."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat
from pydrake.math import RotationMatrix

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.control.observation import quaternion_of
from drake_safety.files.schema import (
    Count,
    NotNegative,
    Pattern,
    Positive,
    Requirement,
    Triple,
    load_typed,
    load_typed_file,
    schema,
)
from drake_safety.policies.policy_network import PolicyNetwork, load_network
from drake_safety.robots.model_files import model_file
from drake_safety.robots.robot_model import (
    JointGains,
    RobotModel,
    as_pattern,
    by_pattern,
    require_known,
)


@dataclass(kw_only=True, eq=False)
class PolicyInput:
    """Arguments of observation terms."""

    R_WB: np.ndarray  # Orientation of the base, (3, 3).
    w_WB: np.ndarray  # Its velocities in the world, (3,) [rad/s, m/s].
    v_WB: np.ndarray
    positions: np.ndarray  # Joint positions less the positions of zero action, (n_a,) [rad].
    rates: np.ndarray
    command: np.ndarray  # (v_x, v_y, ω_z), (3,) [m/s, rad/s].
    action: np.ndarray  # The last action, (n_a,).
    phases: np.ndarray  # Phases of the gait clock, in [-π, π], (n_p,) [rad].
    all_positions: np.ndarray  # All joints of the robot in its order, (n_j,) [rad].
    all_rates: np.ndarray


Term = Callable[[PolicyInput], np.ndarray]
_Change = Annotated[float, Field(ge=0)]  # Of a command; it may be infinite.
# Registered terms by the names of Isaac Lab; clocks and parts of the command are Holosoma's.
TERMS: dict[str, Term] = {
    "base_lin_vel": lambda inputs: inputs.R_WB.T @ inputs.v_WB,
    "base_ang_vel": lambda inputs: inputs.R_WB.T @ inputs.w_WB,
    "projected_gravity": lambda inputs: inputs.R_WB.T @ [0.0, 0.0, -1.0],
    "velocity_commands": lambda inputs: inputs.command,
    "command_lin_vel": lambda inputs: inputs.command[:2],
    "command_ang_vel": lambda inputs: inputs.command[2:],
    "joint_pos_rel": lambda inputs: inputs.positions,
    "joint_vel_rel": lambda inputs: inputs.rates,
    "last_action": lambda inputs: inputs.action,
    "sin_phase": lambda inputs: np.sin(inputs.phases),
    "cos_phase": lambda inputs: np.cos(inputs.phases),
    "gait_phase": lambda inputs: np.hstack([np.sin(inputs.phases), np.cos(inputs.phases)]),
}


def observation_term(name: str) -> Callable[[Term], Term]:
    """Registers a function of a :class:`PolicyInput` as an observation term."""

    def register(term: Term) -> Term:
        if TERMS.setdefault(name, term) is not term:
            raise ValueError(f"observation term '{name}' is already registered")
        return term

    return register


@schema(kw_only=True)
class ObservationTerm:
    """A part of the network's input."""

    name: str = ""  # One of the registered terms; see :func:`observation_term`.
    scale: list[FiniteFloat] = field(default_factory=lambda: [1.0])  # Factor, one or one per entry.
    clip: Annotated[float, Field(gt=0)] = 100.0  # Largest absolute value after scaling.
    history: Count = 1  # Number of samples, the oldest first.
    # Joints whose positions or rates it has, in its order; by default the moved joints.
    joints: list[str] = field(default_factory=list)


@schema(kw_only=True)
class GaitClock:
    """A clock whose phases are part of the observation."""

    period_s: NotNegative = 0.0  # Period of a cycle [s]; 0 for policies without a clock.
    # Phase of each foot at the start, as a share of the period.
    offsets: list[FiniteFloat] = field(default_factory=lambda: [0.0, 0.5])
    standing_below: float = 0.01  # Norm of the command below which every phase is half a period.


@schema(kw_only=True)
class CommandLimits:
    """Commands (v_x, v_y, ω_z) for which the policy was trained [m/s, m/s, rad/s]."""

    lowest: Triple = field(default_factory=lambda: [-1.0, -1.0, -1.0])
    highest: Triple = field(default_factory=lambda: [1.0, 1.0, 1.0])
    change: Annotated[list[_Change], Field(min_length=3, max_length=3)] = field(
        default_factory=lambda: 3 * [math.inf]  # Largest in one period.
    )

    def __post_init__(self) -> None:
        if not np.all(np.less_equal(self.lowest, self.highest)):
            raise ValueError(f"lowest must not exceed highest; got {self.lowest}, {self.highest}")


@schema(kw_only=True)
class WholeHistory:
    """Samples of the whole observation in the network's input."""

    # Age of each sample in periods, 0 for the newest, in the network's order.
    ages: list[int] = field(default_factory=list)
    # Outer order: all terms of a ``time`` together, or all samples of a ``term``.
    by: Literal["time", "term"] = "time"

    def __post_init__(self) -> None:
        if sorted(self.ages) != list(range(len(self.ages))):
            samples = f"the newest {len(self.ages)} samples"
            raise ValueError(f"ages must name each of {samples} once; got {self.ages}")


@schema(kw_only=True)
class PolicyParameters:
    """The schema of ``policy.yaml``."""

    network: str = ""  # ONNX or TorchScript file: ``package://…`` or relative to the YAML file.
    requires: Requirement = ""  # Package of ``network``, installed without dependencies.
    # Joints in the network's order; by default from the network's metadata.
    joints: list[str] = field(default_factory=list)
    # Joint positions at zero action [rad], by regular expression; 0 for others. The default of
    # this, ``action_scale`` and ``gains`` is in the network's metadata.
    default_positions: dict[Pattern, FiniteFloat] = field(default_factory=dict)
    # Joint positions per unit of action [rad], by regular expression.
    action_scale: dict[Pattern, FiniteFloat] = field(default_factory=dict)
    action_clip: Annotated[float, Field(gt=0)] = 100.0  # Largest absolute action.
    gains: dict[Pattern, JointGains] = field(default_factory=dict)  # Servo gains, by pattern.
    # Rotor inertia as the joints feel it [kg·m²], by regular expression.
    rotor_inertia: dict[Pattern, NotNegative] = field(default_factory=dict)
    period_s: Positive = 0.02  # Time between two actions [s].
    observation: list[ObservationTerm] = field(default_factory=list)  # In the network's order.
    history: WholeHistory = field(default_factory=WholeHistory)
    gait: GaitClock = field(default_factory=GaitClock)
    command: CommandLimits = field(default_factory=CommandLimits)

    def __post_init__(self) -> None:
        own = [term.name for term in self.observation if term.history > 1]
        if self.history.ages and own:
            raise ValueError(f"either history or terms with their own; got both, {own}")


class Policy:
    """A network with its observation, for one robot, whose joints are named in its order.

    Attributes:
        joints: The policy's joints as indices into the robot's, (n_a,).
        default_positions: Positions of all joints of the robot at zero action, (n_j,) [rad].
        num_inputs: Number of entries of the network's input, n_o.
    """

    def __init__(
        self,
        parameters: PolicyParameters,
        joint_names: list[str],
        *,
        robot: str = "",
        folder: str = "",
    ):
        self.parameters = parameters
        who = f"policy '{parameters.network}' for robot '{robot}'"
        self.network: PolicyNetwork = load_network(network_file(parameters, folder))
        metadata, (width, num_moved) = self.network.metadata, self.network.widths
        names = parameters.joints or metadata.joints
        if not parameters.joints and num_moved not in (None, len(names)):
            names = []  # Some are observed, and not moved.
        unknown = [name for name in names if name not in joint_names]
        if unknown or len(set(names)) != len(names):
            what = f"got {names}, of which it lacks {unknown}; it has {joint_names}"
            raise ValueError(f"{who}: joints must be different joints of the robot; {what}")
        for key in ("default_positions", "action_scale", "gains", "rotor_inertia"):
            what = f"joint for policy.yaml's {key} pattern"
            require_known(robot, what, getattr(parameters, key), joint_names)
        self.joint_names = list(names)
        self.joints = np.array([joint_names.index(name) for name in names], dtype=int)

        def by_joint(key: str, joints: list[str]) -> dict[str, Any]:
            """Stated values, else values of the network's metadata."""
            values: dict[str, Any] = {}
            for name in joints:
                value = by_pattern(getattr(parameters, key, {}), name, key, robot)
                if value is None:
                    stated = getattr(metadata, key, {})
                    value = by_pattern(stated, name, f"{key} of its metadata", robot)
                if value is not None:
                    values[name] = value
            return values

        positions = by_joint("default_positions", joint_names)
        scales, damping = by_joint("action_scale", names), by_joint("damping", names)
        self.gains: dict[str, JointGains] = {}
        for name, stiffness in by_joint("stiffness", names).items():
            if name in damping:
                both = {"stiffness": stiffness, "damping": damping[name]}
                where = f"{who}: gains of joint '{name}' in its metadata"
                self.gains[name] = load_typed(JointGains, both, where)
        self.gains |= by_joint("gains", names)
        missing = []
        if not names:
            count = f", {num_moved} that it moves" if num_moved else ""
            missing.append(f"'joints' in the network's order{count}; the robot has {joint_names}")
        if not positions:
            missing.append("'default_positions' [rad], such as {.*: 0.0}")
        for key, values in (("'action_scale' [rad]", scales), ("'gains' [N·m/rad]", self.gains)):
            if without := [name for name in names if name not in values]:
                missing.append(f"{key} of joints {without}")
        if not parameters.observation:
            entries = "" if width is None else f", {width} entries in all"
            missing.append(f"'observation', the terms of the network's input{entries}")
        if missing:
            missing += metadata.unread
            raise ValueError(f"{who}: state in policy.yaml {'; '.join(missing)}")
        self.default_positions = np.array([positions.get(name, 0.0) for name in joint_names])
        self.action_scale = np.array([scales[name] for name in names])
        gait = parameters.gait
        offsets = np.array(gait.offsets if gait.period_s else [], dtype=float)
        self.initial_phases = _wrapped(2 * math.pi * offsets)
        self._terms = [(_term(spec, joint_names, who), spec) for spec in parameters.observation]
        q = np.concatenate([np.eye(1, NUM_BASE_POSITIONS)[0], self.default_positions])
        v = np.zeros(NUM_BASE_VELOCITIES + len(joint_names))
        still = self.see(q, v, np.zeros(3), np.zeros(len(names)), self.initial_phases)
        widths, all_ages, described = [], [], []
        for term, spec in self._terms:
            width = np.asarray(term(still)).size
            text = f"{who}: term '{spec.name}'"
            if not width:
                raise ValueError(f"{text} needs a clock: state 'gait: {{period_s: ...}}' [s]")
            if len(spec.scale) not in (1, width):
                raise ValueError(f"{text} has {width} entries; got {len(spec.scale)} scales")
            ages = parameters.history.ages or list(range(spec.history))[::-1]
            widths.append(width)
            all_ages.append(ages)
            described.append(f"{spec.name} {width}" + f" x {len(ages)}" * (len(ages) > 1))
        blocks = [(term, age) for term, ages in enumerate(all_ages) for age in ages]
        if parameters.history.ages and parameters.history.by == "time":
            blocks.sort(key=lambda block: parameters.history.ages.index(block[1]))
        ends = np.cumsum(widths)
        order = [(i, age) for k, age in blocks for i in range(ends[k] - widths[k], ends[k])]
        places = {entry: place for place, entry in enumerate(order)}
        self.num_inputs = len(order)
        # For each entry of the input, that of the present observation, and that of the last input
        # which is one period younger; -1 for the newest samples.
        self._entries = np.array([entry for entry, _ in order], dtype=int)
        self._earlier = np.array([places.get((i, age - 1), -1) for i, age in order], dtype=int)
        num_samples = max(len(parameters.history.ages), 1)
        self.network.check(who, len(order), len(names), ", ".join(described), num_samples)

    def see(
        self,
        q: np.ndarray,
        v: np.ndarray,
        command: np.ndarray,
        action: np.ndarray,
        phases: np.ndarray,
    ) -> PolicyInput:
        """The input of the terms, with a command (3,) [m/s, rad/s] and phases (n_p,) [rad]."""
        joints, rates = q[NUM_BASE_POSITIONS:] - self.default_positions, v[NUM_BASE_VELOCITIES:]
        return PolicyInput(
            R_WB=RotationMatrix(quaternion_of(q)).matrix(),
            w_WB=v[:3],
            v_WB=v[3:NUM_BASE_VELOCITIES],
            positions=joints[self.joints],
            rates=rates[self.joints],
            command=command,
            action=action,
            phases=phases,
            all_positions=joints,
            all_rates=rates,
        )

    def observe(self, inputs: PolicyInput, history: np.ndarray) -> np.ndarray:
        """The network's input; ``history`` is its last one, (n_o,), NaN before the first."""
        present = [
            np.clip(term(inputs) * np.asarray(spec.scale), -spec.clip, spec.clip)
            for term, spec in self._terms
        ]
        observation = np.concatenate(present)[self._entries]
        if np.isfinite(history).all():
            aged = self._earlier >= 0
            observation[aged] = history[self._earlier[aged]]
        return observation

    def act(self, observation: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the action (n_a,) for a network's input (n_o,), and its new memory (n_m,)."""
        clip = self.parameters.action_clip
        action, memory = self.network(observation, memory)
        return np.clip(action, -clip, clip), memory

    def targets(self, action: np.ndarray) -> np.ndarray:
        """Returns the set points of all joints of the robot, (n_j,) [rad]."""
        targets = self.default_positions.copy()
        targets[self.joints] += self.action_scale * action
        return targets

    def next_phases(self, phases: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Returns the phases one period later, (n_p,) [rad]."""
        gait = self.parameters.gait
        if not len(phases):
            return phases
        if np.linalg.norm(command) < gait.standing_below:
            return np.full(len(phases), math.pi)
        if np.all(phases == math.pi):  # It stood.
            phases = self.initial_phases
        return _wrapped(phases + 2 * math.pi * self.parameters.period_s / gait.period_s)

    def next_command(self, applied: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Returns the command of the next period, of limited change, (3,)."""
        change = np.asarray(self.parameters.command.change)
        return np.clip(wanted, applied - change, applied + change)


def _term(spec: ObservationTerm, joint_names: list[str], who: str) -> Term:
    """The function of a term, of its own joints if it has some."""
    if spec.name not in TERMS:
        raise ValueError(f"{who}: unknown term '{spec.name}'; registered are {sorted(TERMS)}")
    if unknown := [name for name in spec.joints if name not in joint_names]:
        raise ValueError(f"{who}: term '{spec.name}' has joints {unknown} that the robot lacks")
    term = TERMS[spec.name]
    if not spec.joints:
        return term
    own = [joint_names.index(name) for name in spec.joints]
    return lambda inputs: term(
        replace(inputs, positions=inputs.all_positions[own], rates=inputs.all_rates[own])
    )


def network_file(parameters: PolicyParameters, folder: str = "") -> Path:
    """Returns the file of a policy's network, named relative to the folder of the YAML file."""
    if not parameters.network:
        raise ValueError("policy: network must name an ONNX or TorchScript file")
    return model_file(parameters.network, folder, parameters.requires)


def _wrapped(phases: np.ndarray) -> np.ndarray:
    return np.fmod(phases + math.pi, 2 * math.pi) - math.pi


def read_policy_file(path: Path, network: str = "") -> PolicyParameters:
    """Reads a ``policy.yaml``; ``network`` replaces the file's network."""
    read = load_typed_file(PolicyParameters, path, f"policy file '{path}'")
    return replace(read, network=network, requires="") if network else read


def load_policy(path: Path, kinematics: RobotKinematics, network: str = "") -> Policy:
    """Loads a policy for a robot; ``network`` replaces the file's network."""
    parameters, robot = read_policy_file(path, network), kinematics.robot.name
    return Policy(parameters, kinematics.joint_names, robot=robot, folder=str(path.parent))


def with_policy(robot: RobotModel, policy: Policy, joint_names: list[str]) -> RobotModel:
    """A robot, whose joints are named, with the gains, rotor inertias and posture of a policy."""
    posture = zip(map(as_pattern, joint_names), policy.default_positions.tolist(), strict=True)
    return replace(
        robot,
        posture=dict(posture),
        joint_gains={as_pattern(name): gains for name, gains in policy.gains.items()},
        rotor_inertia=policy.parameters.rotor_inertia or robot.rotor_inertia,
    )
