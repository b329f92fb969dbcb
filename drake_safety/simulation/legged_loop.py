"""LeggedLoop: base of the tasks of legged robots."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import MatrixGain
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    RobotKinematics,
)
from drake_safety.files.schema import Positive, schema
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.models import load_robot, robot_files
from drake_safety.plants.obstacles import remove_visuals
from drake_safety.plants.physics import Physics, Scene, add_physics
from drake_safety.plants.pushes import Push
from drake_safety.robots.robot import ObservationNoise
from drake_safety.robots.shift import Fault, Shift
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.observers import Observers, add_faults
from drake_safety.simulation.planned_loop import PlannedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.assessor_inputs import AssessorInputs
from drake_safety.systems.motor_curves import MotorCurves
from drake_safety.systems.push_source import PushSource

# Drake's discrete updates at one time see the state before any of them. So a system whose input is
# another's new state updates a tick later, a share of the plant's step. Assessor, trigger, step
# planner and controller are the longest chain, done within the plant's step in which it began.
_UPDATE_TICK = 0.25


@schema(kw_only=True)
class View:
    """A camera that follows a robot's base over the ground."""

    azimuth_rad: float = math.radians(-42.0)  # From the world's x axis.
    elevation_rad: Annotated[float, Field(gt=-0.5 * math.pi, lt=0.5 * math.pi)] = math.radians(15.0)
    room: Positive = 0.95  # Free space in a picture, by the robot's extent.

    def direction(self) -> np.ndarray:
        """Unit vector from the robot to the camera in the world, (3,)."""
        level = np.array([math.cos(self.azimuth_rad), math.sin(self.azimuth_rad)])
        return np.append(math.cos(self.elevation_rad) * level, math.sin(self.elevation_rad))

    def mirrored(self) -> "View":
        """The view mirrored at the x-z plane."""
        return replace(self, azimuth_rad=-self.azimuth_rad)


class LeggedLoop(PlannedLoop):
    """A legged robot that follows a plan and is observed with noise.

    A subclass calls in this order: :meth:`_add_robot`, :meth:`_add_observers`,
    :meth:`_add_planner`, adds its controller, :meth:`_assess`, and ``builder.BuildInto(self)``. It
    extends :meth:`_set_state` by the controller's initial state. ``plant`` is a MultibodyPlant, to
    be read only.
    """

    # Features that depend on what the controller did before, which a log of the plant lacks.
    memory_features: Sequence[str] = ()
    view: View = View()

    def __init__(self, scenario: Scenario, variation: str, assessment: SafetyAssessment | None):
        super().__init__(scenario, variation, assessment)
        self.robot = load_robot(scenario.robot)
        self.kinematics = RobotKinematics(self.robot, scenario.variation("nominal"))
        self.tick_s = _UPDATE_TICK * scenario.time_step_s
        self._push_source: PushSource | None = None

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """The robot's YAML and model file."""
        return robot_files(scenario.robot)

    def _add_robot(
        self, builder: DiagramBuilder, scene: Scene, *, servos: bool, meshcat: Meshcat | None
    ) -> Physics:
        if self._plant_variation.motors and not servos:
            raise ValueError(f"variation '{self.variation}': motors: dc needs position servos")
        physics = self._physics = add_physics(
            builder,
            self.robot,
            self._plant_variation,
            scene,
            time_step_s=self.scenario.time_step_s,
            servos=servos,
        )
        self.plant, self.robot_instance = physics.plant, physics.instance
        self.scene_graph, self._is_shown = physics.scene_graph, meshcat is not None
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, self.scene_graph, meshcat)
        return physics

    def _add_observers(self, builder: DiagramBuilder, **options: Any) -> OutputPort:
        """Adds observers, with options of `StateObserver`; returns the controller's state."""
        variation, period_s = self._plant_variation, self.scenario.control_period_s
        noise, state = variation.observation_noise, self._physics.state
        self._observers = Observers(builder, self.kinematics, state, period_s, **options)
        observer = self._observers.add("observer", noise)
        # The sum of two independent sources.
        assessor_noise = ObservationNoise(
            position=math.hypot(noise.position, variation.input_noise.position),
            velocity=math.hypot(noise.velocity, variation.input_noise.velocity),
        )
        faults = (variation.shift or Shift()).sensor_faults
        assessor_observer = self._observers.add("assessor_observer", assessor_noise, faults)
        true_observer = self._observers.add("true_observer", ObservationNoise())
        self.output_names = observer.output_names
        self._assessor_options = {key: options[key] for key in options if key != "hand"}
        self._assessed_state = assessor_observer.GetOutputPort("measured_plant_state")
        self._observed = {
            "true_state": true_observer.GetOutputPort("state"),
            "output": observer.GetOutputPort("output"),
        }
        return observer.GetOutputPort("measured_plant_state")

    def _as_received(
        self,
        builder: DiagramBuilder,
        command: OutputPort,
        names: Sequence[str],
        is_servo: bool = False,
    ) -> OutputPort:
        """Adds the variation's delay and faults of the command between controller and robot."""
        shift = self._plant_variation.shift or Shift()
        faults = list(shift.command_faults)
        if shift.command_delay_s:
            faults.append(Fault(kind="delay", value=shift.command_delay_s))
        if not faults:
            return command
        # A servo without torque wants the joint where it is.
        rest = self._joint_state(builder, "joint_state") if is_servo else None
        period_s = self.scenario.time_step_s
        return add_faults(builder, "command_faults", command, faults, names, period_s, rest)

    def _joint_state(self, builder: DiagramBuilder, name: str) -> OutputPort:
        num_q, num_states = self.kinematics.num_positions, self.kinematics.num_states
        joints = np.r_[NUM_BASE_POSITIONS:num_q, num_q + NUM_BASE_VELOCITIES : num_states]
        gain = builder.AddNamedSystem(name, MatrixGain(D=np.eye(num_states)[joints]))
        builder.Connect(self._physics.state, gain.get_input_port())
        return gain.get_output_port()

    def _servo_command(self, builder: DiagramBuilder, command: OutputPort) -> OutputPort:
        names = self.kinematics.joint_names
        entries = [*names, *(f"{name}_rate" for name in names)]
        received = self._as_received(builder, command, entries, is_servo=True)
        if self._plant_variation.motors is None:
            return received
        curves = MotorCurves(self.plant, self.robot_instance, names)
        builder.AddNamedSystem("motor_curves", curves)
        builder.Connect(received, curves.GetInputPort("desired_joint_state"))
        state = self._joint_state(builder, "motor_state")
        builder.Connect(state, curves.GetInputPort("joint_state"))
        return curves.get_output_port()

    def _assess(
        self,
        builder: DiagramBuilder,
        safe_set: Any,
        ports: Mapping[str, OutputPort],
        *,
        period_s: float,
        command: OutputPort | None = None,
        has_gravity: bool = False,
        memory: tuple[OutputPort, list[str]] | None = None,
        recovery: System | None = None,
        hold: OutputPort | None = None,
        guard: System | None = None,
    ) -> None:
        """Adds monitor, assessor's inputs and assessor, connects them, and exports all ports.

        ``command``, desired joint states (2 n_j,), adds features of the servos' loads, ``memory`` a
        port with the names of its entries. ``recovery`` reads the assessor, or an input port.
        """
        self.fall_name = safe_set.fall_name
        self.watched_features = safe_set.watched_features
        ports, kinematics = dict(ports), self.kinematics
        given = {
            "plant_state": self._assessed_state,
            "desired_outlook": ports.pop("desired_outlook"),
            "desired_joint_state": command,
            "controller_memory": memory and memory[0],
        }
        inputs = AssessorInputs(
            kinematics,
            safe_set,
            num_outlook=given["desired_outlook"].size() // 3,
            gravity=self.plant.gravity_field().gravity_vector() if has_gravity else None,
            servo_loads=command is not None,
            memory=memory[1] if memory else (),
            without=self.scenario.without_features,
            **self._assessor_options,
        )
        builder.AddNamedSystem("assessor_inputs", inputs)
        for name, port in given.items():
            if port is not None:
                builder.Connect(port, inputs.GetInputPort(name))
        self.state_names, self.feature_names = inputs.state_names, inputs.feature_names
        read = {name: inputs.GetOutputPort(name) for name in ("state", "features")}
        of_robot = {"plant_state": self._physics.state, **self._observed, **read}
        of_robot["measured_plant_state"] = self._assessed_state
        if self._physics.ball_state is not None:
            of_robot["ball_state"] = self._physics.ball_state
        assessor = self._finish(
            builder,
            safe_set,
            of_robot | ports,
            sizes=(kinematics.num_positions, kinematics.num_velocities),
            period_s=period_s,
            margins=inputs.GetOutputPort("margins"),
            hold=hold,
        )
        self._change_monitor = assessor and assessor.monitor
        if guard is not None and assessor is not None:
            for name, port in {**read, "learned": assessor.GetOutputPort("learned")}.items():
                builder.Connect(port, guard.GetInputPort(name))
        if recovery is not None:
            builder.ExportOutput(recovery.GetOutputPort("recovery_active"), "recovery_active")
            if assessor is not None:
                assessor.connect_recovery(builder, recovery)
            else:
                probability = recovery.GetInputPort("safety_probability")
                builder.ExportInput(probability, "safety_probability")

    def _add_push_source(self, builder: DiagramBuilder) -> None:
        period_s = self.scenario.control_period_s
        source = PushSource(self.plant, self.robot_instance, period_s=period_s)
        self._push_source = builder.AddNamedSystem("push_source", source)
        builder.Connect(source.get_output_port(), self._physics.applied_spatial_force)

    def set_push(self, context: Context, push: Push) -> None:
        """Sets a push, in place of an earlier one; the monitor waits while it acts."""
        if self._push_source is None:
            raise ValueError(f"task '{type(self).__name__}' has no pushes on its robot")
        self._push_source.set_push(self._push_source.GetMyMutableContextFromRoot(context), push)
        self.expect_disturbance(context, push.time_s, push.time_s + push.duration_s)

    def disturbances(self, context: Context) -> dict[str, np.ndarray]:
        """Returns the ball's mass and state, and the push."""
        acting = {}
        if self._physics.ball is not None:
            mass = self._physics.ball.mass(self.plant.GetMyContextFromRoot(context))
            acting["ball"] = np.append(mass, self.GetOutputPort("ball_state").Eval(context))
        if self._push_source is not None:
            acting["push"] = self._push_source.push(self._push_source.GetMyContextFromRoot(context))
        return acting

    def expect_disturbance(self, context: Context, begin_s: float, end_s: float) -> None:
        """Lets the monitor, if there is one, wait while a disturbance acts; see `ChangeMonitor`."""
        if self._change_monitor is not None:
            own_context = self._change_monitor.GetMyMutableContextFromRoot(context)
            self._change_monitor.expect_disturbance(own_context, begin_s, end_s)

    def prepare(self, context: Context) -> None:
        """Removes the visual shapes, unless the diagram has a visualiser."""
        if not self._is_shown:
            remove_visuals(self.plant, self.scene_graph, context)

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Sets the robot's state and plan; see `CanStartAnywhere`."""
        self._begin(context, rng, start.of_robot(self.kinematics), is_silent=rng is None)

    def _begin(
        self,
        context: Context,
        rng: np.random.Generator | None,
        start: EpisodeStart,
        *,
        is_silent: bool = False,
    ) -> None:
        self._enter(context, start)
        self._observers.reseed(context, rng)
        if is_silent:
            self._observers.silence(context)
        self.start_control(context)

    def standing_start(self) -> EpisodeStart:
        """A start at rest in the standing posture, with a constant plan."""
        q = self.kinematics.standing_positions()
        output = self._output_of(q).copy()
        # The plan is in the stance frame.
        output[:2] += self.kinematics.nominal_base_offset
        v = np.zeros(self.kinematics.num_velocities)
        return EpisodeStart(q=q, v=v, plan=PiecewisePolynomial(output[:, None]))

    def _output_of(self, q: np.ndarray) -> np.ndarray:
        """The planned output at positions (n_q,), in the world, (n_z,) [m]."""
        raise TypeError(f"task '{type(self).__name__}' must override _output_of")

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        return start.stance_pose(self.kinematics)

    def start_control(self, context: Context) -> None:
        """Sets the command for a start in the present state; a controller may hold none."""

    def advance_control(self, context: Context, time_s: float) -> None:
        """Moves a Context to a later time, with the command that the controller holds then."""
        context.SetTime(time_s)

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        with self._physics.edited(context) as plant_context:
            self.plant.SetPositionsAndVelocities(
                plant_context, self.robot_instance, np.concatenate([start.q, start.v])
            )
            if self._physics.ball is not None:
                self._physics.ball.park(plant_context)
        if self._push_source is not None:
            self._push_source.clear_push(self._push_source.GetMyMutableContextFromRoot(context))
