"""RecoverySwitch: a diagram of recovery trigger, step planner and PortSwitches."""

from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PortSwitch

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from drake_safety.systems.recovery_trigger import RecoveryTrigger


class RecoverySwitch(Diagram):
    """Passes the nominal set point until the probability is below a threshold, then recovery steps.

    .. pydrake_system::

        name: RecoverySwitch
        input_ports: [safety_probability: 1, belief: 3 (optional), plant_state: n_q + n_v,
          nominal_desired_output: n_z, nominal_desired_preview: H n_z,
          nominal_desired_outlook: M n_z]
        output_ports: [desired_output: n_z, desired_preview: H n_z, desired_outlook: M n_z,
          desired_foot_positions: 3 n_p, desired_yaw: 1, stance_pose: 3, recovery_active: 1]

    Connect ``stance_pose`` to the TrajectoryPlanner, so that the plan continues over the new
    footholds.

    Args:
        threshold: Probability below which, for ``persistence_s`` [s], recovery starts.
        initial_uncertainty: The assessment's μ_ini, which marks "don't know".
        period_s, offset_s: Timing of the trigger [s], after the assessor and before the planner:
            updates at one time do not see each other.
        horizon, num_outlook: H and M, samples of preview and outlook.

    Example: ``switch = RecoverySwitch(legged_loop.kinematics, steps, threshold=0.2, **timing)``
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        parameters: RecoveryStepParameters,
        *,
        threshold: float,
        persistence_s: float = 0.0,
        initial_uncertainty: float = 0.3,
        period_s: float,
        offset_s: float,
        horizon: int,
        num_outlook: int,
    ):
        super().__init__()
        builder = DiagramBuilder()
        trigger = RecoveryTrigger(
            threshold=threshold,
            persistence_s=persistence_s,
            initial_uncertainty=initial_uncertainty,
            period_s=period_s,
            offset_s=offset_s,
        )
        planner = self.step_planner = RecoveryStepPlanner(
            kinematics,
            parameters,
            period_s=period_s,
            offset_s=2 * offset_s,
            horizon=horizon,
            num_outlook=num_outlook,
        )
        builder.AddNamedSystem("recovery_trigger", trigger)
        builder.AddNamedSystem("recovery_step_planner", planner)
        active, done = trigger.GetOutputPort("recovery_active"), "recovery_done"
        builder.Connect(active, planner.GetInputPort("recovery_active"))
        builder.Connect(planner.GetOutputPort(done), trigger.GetInputPort(done))
        for name in ("safety_probability", "belief"):
            builder.ExportInput(trigger.GetInputPort(name), name)
        for name in ("plant_state", "nominal_desired_output"):
            builder.ExportInput(planner.GetInputPort(name), name)
        sizes = {"output": 3, "preview": 3 * horizon, "outlook": 3 * num_outlook}
        for part, size in sizes.items():
            name = f"desired_{part}"
            switch = builder.AddNamedSystem(f"{name}_switch", PortSwitch(size))
            selector = trigger.GetOutputPort("port_selector")
            builder.Connect(selector, switch.get_port_selector_input_port())
            nominal = switch.DeclareInputPort("nominal")
            if part == "output":
                builder.ConnectInput(f"nominal_{name}", nominal)
            else:
                builder.ExportInput(nominal, f"nominal_{name}")
            builder.Connect(planner.GetOutputPort(name), switch.DeclareInputPort("recovery"))
            builder.ExportOutput(switch.GetOutputPort("value"), name)
        for name in ("desired_foot_positions", "desired_yaw", "stance_pose"):
            builder.ExportOutput(planner.GetOutputPort(name), name)
        builder.ExportOutput(active, "recovery_active")
        builder.BuildInto(self)
