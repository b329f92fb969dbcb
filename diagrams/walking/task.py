"""Walking: a legged robot follows velocity commands by a trained policy."""

from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Gain, PortSwitch
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.diagrams.walking.command_guard import CommandGuard
from drake_safety.diagrams.walking.parameters import WalkingParameters, profile
from drake_safety.diagrams.walking.safe_set import WalkingSafeSet, with_commands
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.models import load_robot
from drake_safety.plants.physics import Scene
from drake_safety.plants.pushes import Push
from drake_safety.policies.policy import load_policy, network_file, read_policy_file, with_policy
from drake_safety.policies.policy_network import network_files
from drake_safety.simulation.capabilities import GoalWords
from drake_safety.simulation.closed_loop import Purpose
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.policy_controller import PolicyController
from drake_safety.systems.recovery_trigger import RecoveryTrigger

_NUM_OUTLOOK = 9  # Samples of the commands from now to the end, for the features.
_SETTLING_S = 1.0
_HELD_S = (2.0, 6.0)  # Shortest and longest time for which undisturbed motion holds a command.
_STANDING_SHARE = 0.1  # Share of zero commands in undisturbed motion.
_POSITION = "base_height"  # No sensor of a robot measures it.
_UNCOMMANDED = "action_change"


class Walking(LeggedLoop):
    """The diagram of the walking task, for any robot.yaml with feet and a policy.yaml.

    Plans are velocity profiles (v_x, v_y, ω_z) in the heading frame [m/s, rad/s]; a goal is a
    constant command.

    Args:
        disturbed: Whether some episodes begin with an offset of the state.
        command_s: Duration of a goal's command, then zero [s]; by default the episode's.
        guard: Whether a :class:`CommandGuard` passes on commands; requires an assessment.
        recovery: Whether to recover when Γ, or without an assessment the input port
            ``safety_probability``, falls below a threshold.
        starts_of: The scenario whose policy walks before the start, and whose commands and standing
            height count; by default this one.
    """

    Parameters = WalkingParameters
    angular_constraints = WalkingSafeSet.angular_names
    hand = None
    goal_words = GoalWords(
        goal="command", axes=("v_x", "v_y", "ω_z"), units=("m/s", "m/s", "rad/s")
    )

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
        disturbed: bool = True,
        command_s: float | None = None,
        guard: bool = False,
        recovery: bool = False,
        starts_of: Scenario | None = None,
    ):
        super().__init__(scenario, variation, assessment)
        self._starts_of = starts_of
        self._rehearsal: Walking | None = None
        if guard and assessment is None:
            raise ValueError("walking: guard=True needs an assessment; got none")
        parameters = scenario.parameters
        self._is_disturbed, self._command_s = disturbed, command_s
        self.named_targets, self.pushes = parameters.named_commands, parameters.pushes
        self.view = parameters.view
        path, network = policy_files(scenario)
        self.policy = load_policy(path, self.kinematics, network)
        # The servos' gains are part of the policy, and its default posture is how it stands.
        self.robot = with_policy(self.robot, self.policy, self.kinematics.joint_names)
        self.kinematics = RobotKinematics(self.robot, scenario.variation("nominal"))
        builder = DiagramBuilder()
        physics = self._add_robot(builder, Scene(), servos=True, meshcat=meshcat)
        measured = self._add_observers(builder, is_walking=True)
        planner = self._add_planner(
            builder, outlook_s=scenario.episode_duration_s, num_outlook=_NUM_OUTLOOK
        )
        names = ("desired_output", "desired_preview", "desired_outlook")
        desired = {name: planner.GetOutputPort(name) for name in names}
        standing = self if starts_of is None else self._rehearsing()
        safe_set = WalkingSafeSet(standing.kinematics, parameters.safe_set)
        self._guard: CommandGuard | None = None
        if guard and assessment is not None:
            read = assessment.feature_names
            if missing := [n for n in safe_set.command_features if n not in read]:
                raise ValueError(f"walking: a guard needs the features {missing}, which Γ lacks")
            self._guard = CommandGuard(
                assessment,
                partial(with_commands, read),
                self.policy.parameters.command,
                threshold=parameters.guard.threshold,
                period_s=parameters.guard.period_s,
                offset_s=self.tick_s,
                num_outlook=_NUM_OUTLOOK,
            )
            builder.AddNamedSystem("command_guard", self._guard)
            builder.Connect(desired["desired_output"], self._guard.GetInputPort("command"))
            desired = {name: self._guard.GetOutputPort(name) for name in names}
        trigger, command = None, desired["desired_output"]
        if recovery:
            trigger, command = self._add_recovery(builder, command)
        controller = self._controller = PolicyController(
            self.kinematics,
            self.policy,
            offset_s=2 * self.tick_s,  # After guard or trigger.
        )
        builder.AddNamedSystem("policy_controller", controller)
        builder.Connect(measured, controller.GetInputPort("plant_state"))
        builder.Connect(command, controller.GetInputPort("command"))
        joint_state = self._servo_command(builder, controller.GetOutputPort("desired_joint_state"))
        physics.connect_servos(builder, self.kinematics.joint_names, joint_state)
        self._add_push_source(builder)
        ports = {
            **desired,
            "controller_status": controller.GetOutputPort("status"),
            "controller_memory": controller.GetOutputPort("memory"),
            "num_controller_failures": controller.GetOutputPort("num_failures"),
        }
        if self._guard is not None:
            ports["guard_active"] = self._guard.GetOutputPort("is_changed")
        self._assess(
            builder,
            safe_set,
            ports,
            period_s=parameters.assessment_period_s,
            memory=(controller.GetOutputPort("action_state"), controller.action_names),
            recovery=trigger,
            guard=self._guard,
        )
        # Inputs of the policy: its last actions, its phase and the command.
        self.memory_features = controller.action_names
        self.memory_period_s = self.policy.parameters.period_s
        known = {*self.feature_names} - {_UNCOMMANDED}
        self.monitored = {
            "states": [name for name in self.state_names if name != _POSITION],
            "features": [n for n in self.memory_features if n in known],
        }
        builder.BuildInto(self)

    def _add_recovery(
        self, builder: DiagramBuilder, nominal: OutputPort
    ) -> tuple[RecoveryTrigger, OutputPort]:
        recovery = self.scenario.parameters.recovery
        trigger = RecoveryTrigger(
            threshold=recovery.threshold,
            initial_uncertainty=self.scenario.assessment.initial_uncertainty,
            persistence_s=recovery.persistence_s,
            period_s=self.scenario.control_period_s,
            offset_s=self.tick_s,
        )
        builder.AddNamedSystem("recovery_trigger", trigger)
        share = recovery.slower_share if recovery.branch == "slower" else 0.0
        slower = builder.AddNamedSystem("slower_command", Gain(share, nominal.size()))
        switch = builder.AddNamedSystem("command_switch", PortSwitch(nominal.size()))
        builder.Connect(nominal, slower.get_input_port())
        selector = switch.get_port_selector_input_port()
        builder.Connect(trigger.GetOutputPort("port_selector"), selector)
        builder.Connect(nominal, switch.DeclareInputPort("nominal"))
        builder.Connect(slower.get_output_port(), switch.DeclareInputPort("recovery"))
        return trigger, switch.GetOutputPort("value")

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """The files of the robot and of the policy."""
        of_robot = super().model_files(scenario)  # First, so that its package is asked for first.
        path, network = policy_files(scenario)
        named = network_file(read_policy_file(path, network), str(path.parent))
        return [*of_robot, path, *network_files(named)]

    @classmethod
    def options_for(cls, purpose: Purpose, scenario: Scenario, variation: str) -> dict[str, Any]:
        """No pushes in evaluation: commands are judged before the robot walks."""
        del scenario, variation
        return {"disturbed": False} if purpose == "evaluation" else {}

    @property
    def target_box(self) -> np.ndarray:
        """Lowest and highest command of training, (2, 3) [m/s, rad/s]."""
        limits = self.policy.parameters.command
        reach = self.scenario.parameters.commands.reach
        return reach * np.array([limits.lowest, limits.highest])

    def sample_push(self, rng: np.random.Generator) -> Push:
        """Samples a push, which no training episode has: they begin in the state after one."""
        return self.scenario.parameters.random_pushes.draw(rng, self.robot.base)

    def command_plan(self, command: np.ndarray) -> PiecewisePolynomial:
        """The plan of a constant command (3,) [m/s, rad/s]."""
        command = np.asarray(command, dtype=float)
        if command.shape != (3,) or not np.isfinite(command).all():
            raise ValueError(f"walking: a command is three finite numbers; got {command}")
        duration_s = self.scenario.episode_duration_s
        if self._command_s is None or self._command_s >= duration_s:
            return profile([command], [], duration_s)
        return profile([command, np.zeros(3)], [self._command_s], duration_s)

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Samples a start and a velocity profile; a goal is its command."""
        parameters = self.scenario.parameters
        starter = self if self._starts_of is None else self._rehearsing()
        sampling, limits = parameters.start, starter.policy.parameters.command
        plan = parameters.commands.sample(limits, rng, self.scenario.episode_duration_s)
        is_standing = rng.random() < sampling.standing_share
        before = parameters.commands.sample_command(limits, rng)
        walked_s = rng.uniform(*sampling.walked_s)
        is_offset = rng.random() < sampling.push_share
        offset_rng = rng.spawn(1)[0]
        if goal is not None:
            plan = self.command_plan(goal)
        start = starter.standing_start() if is_standing else self.rehearse(before, walked_s)
        if is_offset and self._is_disturbed:
            v = sampling.offset_velocities(start.v, offset_rng)
            q = self._above_ground(sampling.offset_positions(start.q, offset_rng))
            start = replace(start, q=q, v=v)
        self._begin(context, rng, replace(start, plan=plan))
        return 0

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts where the policy has settled at a command of zero, with a constant command."""
        start = replace(self._settled_start, plan=self.command_plan(goal))
        self._begin(context, rng, start, is_silent=True)

    def reset_undisturbed(
        self, context: Context, rng: np.random.Generator, duration_s: float
    ) -> None:
        """Starts from standing with random commands inside the policy's ranges, 2 to 6 s each."""
        commands, changes = [self.usual_command(rng)], [rng.uniform(*_HELD_S)]
        while changes[-1] < duration_s:
            commands.append(self.usual_command(rng))
            changes.append(changes[-1] + rng.uniform(*_HELD_S))
        plan = profile(commands, changes[:-1], duration_s)
        self.reset_to(context, rng, replace(self._settled_start, plan=plan))

    def usual_command(self, rng: np.random.Generator) -> np.ndarray:
        """Samples a command inside the policy's ranges, some of them zero, (3,) [m/s, rad/s]."""
        limits = self.policy.parameters.command
        drawn = rng.uniform(limits.lowest, limits.highest)
        return np.zeros(3) if rng.random() < _STANDING_SHARE else drawn

    def set_command(self, context: Context, command: np.ndarray) -> None:
        """Sets a constant command (v_x, v_y, ω_z) (3,) [m/s, rad/s] from now on."""
        self.set_plan(context, PiecewisePolynomial(np.asarray(command, dtype=float)[:, None]))

    def set_guarded(self, context: Context, is_guarded: bool) -> None:
        """Sets whether the guard acts."""
        if self._guard is None:
            raise ValueError("walking: the diagram was built without a guard: pass guard=True")
        self._guard.set_acting(self._guard.GetMyMutableContextFromRoot(context), is_guarded)

    def _above_ground(self, q: np.ndarray) -> np.ndarray:
        kinematics, q = self.kinematics, q.copy()
        lowest, highest = kinematics.position_limits.T
        q[NUM_BASE_POSITIONS:] = np.clip(q[NUM_BASE_POSITIONS:], lowest, highest)
        heights = kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii
        q[6] += max(0.0, -float(heights.min()))
        return q

    def start_of(self, context: Context) -> EpisodeStart:
        """State, plan and the controller's memory in a Context, as a start."""
        memory = self._controller.state_of(self._controller.GetMyContextFromRoot(context))
        return replace(super().start_of(context), controller_state=memory)

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        super()._set_state(context, start)
        if start.controller_state is not None:
            own_context = self._controller.GetMyMutableContextFromRoot(context)
            self._controller.set_state(own_context, start.controller_state)

    def rehearse(self, command: np.ndarray, duration_s: float) -> EpisodeStart:
        """Walks by a command (3,) from standing, undisturbed, for whole periods of the policy."""
        other, period_s = self._rehearsing(), self.policy.parameters.period_s
        if other._remembered() != self._remembered():
            raise ValueError(
                "walking: a policy cannot take over in mid-stride from one with other observations "
                "or joints, nor a recurrent one: set parameters.start.standing_share: 1"
            )
        simulator = Simulator(other)
        context = simulator.get_mutable_context()
        other.prepare(context)
        plan = PiecewisePolynomial(command[:, None])
        other.reset_to(context, None, replace(other.standing_start(), plan=plan))
        simulator.Initialize()
        simulator.AdvanceTo(max(round(duration_s / period_s), 0) * period_s)
        start = other.start_of(context)
        q = start.q.copy()
        q[:4] /= np.linalg.norm(q[:4])
        q[4:6] = 0.0
        return replace(start, q=q)

    def _remembered(self) -> tuple[Any, ...]:
        parameters = self.policy.parameters
        # The memory of a recurrent network is its own.
        network = parameters.network if len(self.policy.network.initial_memory) else ""
        return parameters.observation, parameters.history, self.policy.joint_names, network

    def _rehearsing(self) -> "Walking":
        if self._rehearsal is None:
            self._rehearsal = type(self)(self._starts_of or self.scenario)
        return self._rehearsal

    @cached_property
    def _settled_start(self) -> EpisodeStart:
        return self.rehearse(np.zeros(3), _SETTLING_S)

    def standing_start(self) -> EpisodeStart:
        """A start at rest in the standing posture, with a command of zero."""
        q = self.kinematics.standing_positions()
        v = np.zeros(self.kinematics.num_velocities)
        return EpisodeStart(q=q, v=v, plan=PiecewisePolynomial(np.zeros((3, 1))))

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        del start
        return np.zeros(3)  # Commands are in the heading frame, wherever the feet are.


def policy_files(scenario: Scenario) -> tuple[Path, str]:
    """The policy file of a scenario, and the network that replaces the file's network, or ""."""
    folder = Path(load_robot(scenario.robot).source_dir)
    named = folder / scenario.parameters.policy
    is_network = named.suffix not in (".yaml", ".yml")
    return (folder / "policy.yaml", str(named)) if is_network else (named, "")
