"""Laikago from single parts: plant, observer, planner, recovery switch, controller, safe set, Γ."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_safety import AddSafetyAssessor, RecoverySwitch, load_assessment, load_scenario
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.models import load_robot
from drake_safety.plants.physics import Scene, add_physics
from drake_safety.systems.assessor_inputs import AssessorInputs
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.state_observer import StateObserver
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate

GAMMA, SCENARIO = load_assessment("laikago_balancing"), load_scenario("laikago_balancing")
LIMITS, RECOVERY = SCENARIO.parameters.safe_set, SCENARIO.parameters.recovery
ROBOT = RobotKinematics(load_robot("laikago"), SCENARIO.variation("nominal"))
STEP_S, TICK_S = 0.0025, 0.0025 / 4  # What reads another's new state updates a tick later.
BASE = np.append(ROBOT.nominal_base_offset, ROBOT.standing_height)  # Over the feet [m].
SAMPLES = {"horizon": GAMMA.info_.horizon, "num_outlook": 5}  # Of a plan.
TIMES = {"step_s": GAMMA.info_.preview_step_s, "outlook_s": SCENARIO.episode_duration_s}


def add_plant(builder):  # Returns the port of its state, and what connects a command to its servos.
    options = {"time_step_s": STEP_S, "servos": True}
    physics = add_physics(builder, ROBOT.robot, SCENARIO.variation("actual"), Scene(), **options)
    physics.plant.SetDefaultPositions(physics.instance, ROBOT.standing_positions())
    return physics.state, lambda port: physics.connect_servos(builder, ROBOT.joint_names, port)


def compose(add_plant=add_plant, planner=None, controller=None, gamma=GAMMA, **trigger):
    def connect(one, names, other, prefix=""):
        for name in names:
            if other.HasInputPort(prefix + name):  # A part of your own reads what it needs.
                builder.Connect(one.GetOutputPort(name), other.GetInputPort(prefix + name))

    builder = DiagramBuilder()
    add, plan = builder.AddNamedSystem, interpolate(BASE, BASE + [0.02, 0.0, -0.03], duration_s=1.0)
    state, connect_servos = add_plant(builder)
    observer = add("observer", StateObserver(ROBOT))
    planner = add("planner", planner or TrajectoryPlanner(plan=plan, **SAMPLES, **TIMES))
    times = {"period_s": 0.01, "offset_s": TICK_S, "threshold": RECOVERY.threshold}
    switch = add("switch", RecoverySwitch(ROBOT, RECOVERY.step, **(times | trigger), **SAMPLES))
    times = {"period_s": 0.01, "offset_s": 3 * TICK_S}
    controller = add("controller", controller or InverseKinematicsController(ROBOT, **times))
    options = {"gravity": [0.0, 0.0, -9.81], "servo_loads": True}
    inputs = add("inputs", AssessorInputs(ROBOT, BalanceSafeSet(ROBOT, LIMITS), **options))
    seen = {name: inputs.GetOutputPort(name) for name in ("state", "features", "margins")}
    seen["desired_preview"] = switch.GetOutputPort("desired_preview")
    times = {"period_s": 0.02, "hold": switch.GetOutputPort("recovery_active")}
    assessor = AddSafetyAssessor(builder, gamma, **seen, **times, on_alarm="report")
    builder.Connect(state, observer.GetInputPort("plant_state"))
    measured = observer.GetOutputPort("measured_plant_state")
    for system in (switch, controller, inputs):
        builder.Connect(measured, system.GetInputPort("plant_state"))
    connect(planner, ["desired_output", "desired_preview", "desired_outlook"], switch, "nominal_")
    connect(switch, ["stance_pose"], planner)
    connect(switch, ["desired_output", "desired_foot_positions", "desired_yaw"], controller)
    connect_servos(controller.GetOutputPort("desired_joint_state"))
    connect(switch, ["desired_outlook"], inputs)
    connect(controller, ["desired_joint_state"], inputs)
    connect(assessor, ["safety_probability", "belief"], switch)
    one, other = assessor.GetOutputPort("safety_probability"), observer.GetOutputPort("output")
    for name, port in {"safety_probability": one, "output": other, **seen}.items():
        builder.ExportOutput(port, name)
    return builder.Build()


if __name__ == "__main__":
    diagram = compose()
    simulator, plant = Simulator(diagram), diagram.GetSubsystemByName("plant")
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetVelocities(own, np.eye(18)[4])  # The base begins at 1 m/s to the left.
    for time_s in np.arange(0.0, 3.1, 0.2):
        simulator.AdvanceTo(time_s)
        (gamma,) = diagram.GetOutputPort("safety_probability").Eval(simulator.get_context())
        margin = diagram.GetOutputPort("margins").Eval(simulator.get_context()).min()
        print(f"{time_s:.2f} s  Γ {gamma:.2f}  nearest limit {100 * margin:+.1f} cm")
