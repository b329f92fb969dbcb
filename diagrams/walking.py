"""Walking: a legged robot follows velocity commands by a trained policy."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.policy import (
    CommandLimits,
    Policy,
    PolicyParameters,
    load_policy,
    network_file,
)
from drake_safety.control.walking_safe_set import WalkingLimits, WalkingSafeSet
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.models import load_robot
from drake_safety.plants.physics import Scene
from drake_safety.robots.robot_model import RobotModel, load_typed_file
from drake_safety.simulation.closed_loop import LoopScenario
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.policy_controller import PolicyController

_NUM_OUTLOOK = 9  # Samples of the commands from now to the end, for the features.
_RAMP_S = 0.1  # From one command to the next.


@dataclass(kw_only=True)
class CommandSampling:
    """Random velocity profiles."""

    reach: float = 1.6
    """How far commands go beyond the policy's ranges, as a factor on them."""
    num_segments: list[int] = field(default_factory=lambda: [1, 3])
    """Least and largest number of constant commands in an episode."""
    standing_share: float = 0.1
    """Share of commands that are zero."""

    def __post_init__(self) -> None:
        if not self.reach > 0:
            raise ValueError(f"commands: reach must be positive; got {self.reach}")
        low, high = self.num_segments
        if not 1 <= low <= high:
            raise ValueError(f"commands: num_segments must be [1 or more, ...]; got {[low, high]}")

    def sample(
        self, limits: CommandLimits, rng: np.random.Generator, duration_s: float
    ) -> PiecewisePolynomial:
        """Samples a profile of constant commands with short ramps between them.

        Args:
            limits: The policy's ranges.
            rng: Random generator.
            duration_s: Of the profile [s].
        """
        low, high = self.reach * np.array(limits.lowest), self.reach * np.array(limits.highest)
        count = int(rng.integers(self.num_segments[0], self.num_segments[1] + 1))
        commands = [
            np.zeros(3) if rng.random() < self.standing_share else rng.uniform(low, high)
            for _ in range(count)
        ]
        changes = np.sort(rng.uniform(0.1 * duration_s, 0.9 * duration_s, count - 1))
        return profile(commands, changes.tolist(), duration_s)


def profile(
    commands: list[np.ndarray], changes_s: list[float], duration_s: float
) -> PiecewisePolynomial:
    """A profile of constant commands.

    Args:
        commands: (v_x, v_y, ω_z) each, (3,) [m/s, rad/s].
        changes_s: Ascending times at which the next command begins [s].
        duration_s: Of the profile [s].
    """
    times, values = [0.0], [commands[0]]
    for change_s, before, after in zip(changes_s, commands[:-1], commands[1:], strict=True):
        begins = max(change_s, times[-1] + 1e-3)
        times += [begins, begins + _RAMP_S]
        values += [before, after]
    times.append(max(duration_s, times[-1] + 1e-3))
    values.append(values[-1])
    return PiecewisePolynomial.FirstOrderHold(times, np.transpose(values))


@dataclass(kw_only=True)
class WalkingStart:
    """Random initial states: a phase of the undisturbed gait, and an offset as after a push."""

    walked_s: list[float] = field(default_factory=lambda: [0.6, 1.6])
    """Shortest and longest time since the robot stood [s]."""
    push_share: float = 0.7
    """Share of episodes with an offset."""
    velocity_m_s: float = 2.0
    """Largest horizontal velocity offset of the base."""
    angular_velocity_rad_s: float = 1.5
    """Half-width of the base's angular velocity offset, per axis."""
    tilt_rad: float = 0.15
    """Half-width of roll and pitch offsets."""
    joint_rad: float = 0.05
    """Standard deviation of the joints' offsets."""


@dataclass(kw_only=True)
class WalkingParameters:
    """The task's part of the scenario file."""

    policy: str = "policy.yaml"
    """Policy file, relative to the folder of the robot's YAML file."""
    safe_set: WalkingLimits = field(default_factory=WalkingLimits)
    commands: CommandSampling = field(default_factory=CommandSampling)
    start: WalkingStart = field(default_factory=WalkingStart)
    assessment_period_s: float = 0.02
    """Time between two evaluations of Γ [s]."""


class Walking(LeggedLoop):
    """The diagram of the walking task, for any robot.yaml with feet and a policy.yaml.

    Plans are velocity profiles (v_x, v_y, ω_z) in the heading frame [m/s, rad/s]; the output z is
    the measured velocity.

    Args:
        scenario: The scenario.
        variation: Name of the plant variation.
        assessment: Adds an assessor.
        meshcat: Adds a visualiser.

    Raises:
        ValueError: The policy does not fit the robot, or an assessment is that of another diagram.
    """

    Parameters = WalkingParameters
    angular_constraints = WalkingSafeSet.angular_names

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
    ):
        super().__init__(scenario, variation, assessment)
        parameters = scenario.parameters
        self.policy = load_policy(policy_file(scenario), self.kinematics)
        # The servos' gains are part of the policy, and its default posture is how it stands.
        self.robot = with_policy(self.robot, self.policy, self.kinematics.joint_names)
        self.kinematics = RobotKinematics(self.robot, scenario.variation("nominal"))
        tick_offset_s = 0.25 * scenario.time_step_s
        builder = DiagramBuilder()
        physics = self._add_robot(builder, Scene(), servos=True)
        measured = self._add_observers(builder, is_walking=True)
        planner = self._add_planner(
            builder, outlook_s=scenario.episode_duration_s, num_outlook=_NUM_OUTLOOK
        )
        controller = self._controller = builder.AddNamedSystem(
            "policy_controller",
            PolicyController(self.kinematics, self.policy, offset_s=tick_offset_s),
        )
        builder.Connect(measured, controller.GetInputPort("plant_state"))
        builder.Connect(planner.GetOutputPort("desired_output"), controller.GetInputPort("command"))
        physics.connect_servos(
            builder, self.kinematics.joint_names, controller.GetOutputPort("desired_joint_state")
        )
        self._watch(
            builder,
            WalkingSafeSet(self.kinematics, parameters.safe_set),
            controller_features=(
                controller.GetOutputPort("action_state"),
                controller.action_names,
            ),
            has_stance=False,
        )
        self._export_robot(
            builder,
            assessment_period_s=parameters.assessment_period_s,
            meshcat=meshcat,
        )
        builder.ExportOutput(controller.GetOutputPort("status"), "controller_status")
        self._rehearsal: Walking | None = None
        self.finish(builder)

    @classmethod
    def model_files(cls, scenario: LoopScenario) -> list[Path]:
        """The robot's files and those of the policy."""
        path = policy_file(scenario)
        policy = load_typed_file(PolicyParameters, path, f"policy file '{path}'")
        return [*super().model_files(scenario), path, network_file(policy, str(path.parent))]

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples a phase of the gait, an offset of the state and a velocity profile."""
        parameters = self.scenario.parameters
        sampling, limits = parameters.start, self.policy.parameters.command
        duration_s = self.scenario.episode_duration_s
        plan = parameters.commands.sample(limits, rng, duration_s)
        before = np.clip(plan.value(0.0).ravel(), limits.lowest, limits.highest)
        start, memory = self.rehearse(before, rng.uniform(*sampling.walked_s))
        q, v = start.q, start.v
        if rng.random() < sampling.push_share:
            q, v = self._pushed(q, v, rng)
        self._enter(context, EpisodeStart(q=q, v=v, plan=plan))
        self._controller.set_state(self._controller.GetMyMutableContextFromRoot(context), memory)
        self._observers.reseed(context, rng)
        return 0

    def _pushed(
        self, q: np.ndarray, v: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        sampling, kinematics = self.scenario.parameters.start, self.kinematics
        q, v = q.copy(), v.copy()
        half = 0.5 * rng.uniform(-1, 1, 2) * sampling.tilt_rad
        w, x, y, z = q[:4]
        # A small rotation about the base's x and y axes.
        turned = np.array(
            [
                w - x * half[0] - y * half[1],
                x + w * half[0] - z * half[1],
                y + w * half[1] + z * half[0],
                z + x * half[1] - y * half[0],
            ]
        )
        q[:4] = turned / np.linalg.norm(turned)
        lowest, highest = kinematics.position_limits.T
        joints = q[7:] + rng.normal(size=kinematics.num_joints) * sampling.joint_rad
        q[7:] = np.clip(joints, lowest, highest)
        # Feet that were turned into the ground are lifted out of it.
        heights = kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii
        q[6] += max(0.0, -float(heights.min()))
        speed, direction = rng.uniform(0, sampling.velocity_m_s), rng.uniform(-math.pi, math.pi)
        v[:3] += rng.uniform(-1, 1, 3) * sampling.angular_velocity_rad_s
        v[3:5] += speed * np.array([math.cos(direction), math.sin(direction)])
        return q, v

    def rehearse(
        self, command: np.ndarray, duration_s: float
    ) -> tuple[EpisodeStart, list[np.ndarray]]:
        """Walks undisturbed from the standing posture, by the nominal robot.

        Args:
            command: (v_x, v_y, ω_z) (3,) [m/s, rad/s].
            duration_s: For how long [s]; rounded to the policy's period, so that the controller's
                next update is due.

        Returns:
            The state at the end, at the origin, and the controller's memory.
        """
        if self._rehearsal is None:
            self._rehearsal = type(self)(self.scenario)
        other = self._rehearsal
        period_s = self.policy.parameters.period_s
        simulator = Simulator(other)
        context = simulator.get_mutable_context()
        standing = other.standing_start()
        other.reset_to(context, None, replace(standing, plan=PiecewisePolynomial(command[:, None])))
        simulator.Initialize()
        simulator.AdvanceTo(max(round(duration_s / period_s), 0) * period_s)
        start = other.start_of(context)
        q = start.q.copy()
        q[:4] /= np.linalg.norm(q[:4])
        q[4:6] = 0.0
        memory = other._controller.state_of(other._controller.GetMyContextFromRoot(context))
        return replace(start, q=q), memory

    def standing_start(self) -> EpisodeStart:
        """A start at rest in the standing posture, with a command of zero."""
        q = self.kinematics.standing_positions()
        v = np.zeros(self.kinematics.num_velocities)
        return EpisodeStart(q=q, v=v, plan=PiecewisePolynomial(np.zeros((3, 1))))

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        del start
        return np.zeros(3)  # Commands are in the heading frame, wherever the feet are.


def policy_file(scenario: LoopScenario) -> Path:
    """The policy file of a scenario, relative to its robot's folder.

    Args:
        scenario: A scenario of the walking task.
    """
    return Path(load_robot(scenario.robot).source_dir) / scenario.parameters.policy


def with_policy(robot: RobotModel, policy: Policy, joint_names: list[str]) -> RobotModel:
    """A robot with the gains, rotor inertias and posture of a policy.

    Args:
        robot: The robot.
        policy: The policy.
        joint_names: The robot's joints, in the order of the policy's default positions.
    """
    posture = dict(zip(joint_names, policy.default_positions.tolist(), strict=True))
    inertia = policy.parameters.rotor_inertia
    return replace(
        robot,
        posture=posture,
        joint_gains={**policy.gains},
        rotor_inertia=inertia or robot.rotor_inertia,
    )
