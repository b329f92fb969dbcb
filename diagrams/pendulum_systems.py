"""The pendulum's safe set, and what it is observed and controlled by."""

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.diagrams.pendulum_parameters import GRAVITY, PendulumParameters


class PendulumSafeSet:
    """The pendulum leans less than its largest angle to the front and to the back.

    Args:
        parameters: The task's numbers.
        preview_step_s: Time between two points that the features are given of a plan [s].
    """

    names = ("front", "back")

    def __init__(self, parameters: PendulumParameters, preview_step_s: float):
        self._step_s = preview_step_s
        self._largest = parameters.largest_angle_rad
        self._hold = parameters.hold_angle_rad
        self._effort_share = parameters.effort_share
        self._time_s = math.sqrt(parameters.length_m / GRAVITY)
        self.feature_names = [
            f"{point}_{limit}_{side}"
            for point, limit in (
                ("now", "margin"),
                ("capture", "reserve"),
                ("goal", "reserve"),
                ("plan", "reserve"),
                ("plan_capture", "reserve"),
                ("plan_effort", "reserve"),
            )
            for side in self.names
        ] + ["tracking_error", "goal_from_capture"]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Angle left to either side, (2,) [rad].

        Args:
            q: The angle, (1,) [rad].
            v: Its rate, unused by these constraints.
        """
        del v
        return np.array([self._largest - q[0], self._largest + q[0]])

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """The margins now, and what the motor has in reserve along the plan.

        The capture angle φ + φ̇ √(l/g) is where a small pendulum that is left alone goes to;
        beyond the angle that the motor can hold there is no way back. Following the plan takes the
        torque (l/g) φ̈ - sin φ, in units of what holds the pendulum when it is horizontal.

        Args:
            q: The angle, (1,) [rad].
            v: Its rate, (1,) [rad/s].
            preview: Points that are to be followed, from now to the end, (M, 3) [m].

        Returns:
            Features, in the order of :attr:`feature_names` [rad], those of the effort in its unit.
        """
        angle = q[0]
        capture = angle + self._time_s * v[0]
        planned = np.arctan2(preview[:, 0], preview[:, 2])
        goal = planned[-1]
        rate = np.gradient(planned, self._step_s)
        plan_capture = planned + self._time_s * rate
        effort = self._time_s**2 * np.gradient(rate, self._step_s) - np.sin(planned)
        return np.array(
            [
                *self.margins(q, v),
                self._hold - capture,
                self._hold + capture,
                self._hold - goal,
                self._hold + goal,
                self._hold - planned.max(),
                self._hold + planned.min(),
                self._hold - plan_capture.max(),
                self._hold + plan_capture.min(),
                # What keeps it from falling to the front pulls it to the back.
                self._effort_share + effort.min(),
                self._effort_share - effort.max(),
                planned[0] - angle,
                goal - capture,
            ]
        )


class PendulumObserver(LeafSystem):
    """Tells the pendulum's state from upright, and where the bob is.

    .. pydrake_system::

        name: PendulumObserver
        input_ports:
        - pendulum_state
        output_ports:
        - plant_state
        - output

    ``pendulum_state`` is Drake's, from hanging; ``plant_state`` is [φ, φ̇] from upright [rad,
    rad/s], and ``output`` the bob over the hinge, (3,) [m].

    Args:
        length_m: From the hinge to the bob.
    """

    def __init__(self, length_m: float):
        super().__init__()
        port = self.DeclareVectorInputPort("pendulum_state", 2)

        def calc_state(context: Context, output: BasicVector) -> None:
            theta, rate = port.Eval(context)
            output.SetFromVector([theta - math.pi, rate])

        def calc_output(context: Context, output: BasicVector) -> None:
            output.SetFromVector(bob_position(port.Eval(context)[0] - math.pi, length_m))

        self.DeclareVectorOutputPort("plant_state", BasicVector(2), calc_state)
        self.DeclareVectorOutputPort("output", BasicVector(3), calc_output)


class PendulumController(LeafSystem):
    """A PD controller on the angle, with the weight compensated; its torque knows no limit.

    .. pydrake_system::

        name: PendulumController
        input_ports:
        - plant_state
        - desired_output
        - desired_output_rate
        output_ports:
        - torque

    Args:
        parameters: The task's numbers.
    """

    def __init__(self, parameters: PendulumParameters):
        super().__init__()
        weight = parameters.mass_kg * GRAVITY * parameters.length_m
        state_port = self.DeclareVectorInputPort("plant_state", 2)
        point_port = self.DeclareVectorInputPort("desired_output", 3)
        velocity_port = self.DeclareVectorInputPort("desired_output_rate", 3)

        def calc_torque(context: Context, output: BasicVector) -> None:
            angle, rate = state_port.Eval(context)
            x, _, z = point_port.Eval(context)
            vx, _, vz = velocity_port.Eval(context)
            desired_rate = (vx * z - vz * x) / (x * x + z * z)
            torque = (
                parameters.stiffness * (math.atan2(x, z) - angle)
                + parameters.rate_gain * (desired_rate - rate)
                - weight * math.sin(angle)
            )
            output.SetAtIndex(0, torque)

        self.DeclareVectorOutputPort("torque", BasicVector(1), calc_torque)


def bob_position(angle: float, length_m: float) -> np.ndarray:
    """The bob over the hinge, (3,) [m]; an angle to the front is positive."""
    return length_m * np.array([math.sin(angle), 0.0, math.cos(angle)])
