"""TrajectoryPlanner: a desired trajectory with a preview."""

import copy
import math
from functools import partial

import numpy as np
from pydrake.common.value import Value
from pydrake.polynomial import Polynomial
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.files.schema import check_times


def interpolate(
    start: np.ndarray,
    goal: np.ndarray,
    duration_s: float,
    start_time_s: float = 0.0,
    *,
    detour: np.ndarray | None = None,
) -> PiecewisePolynomial:
    """The minimum-jerk motion from rest at ``start`` to rest at ``goal``, (n_z,) [m] each.

    With progress s, ``z*(s) = start + s (goal - start) + 4 s (1 - s) detour``.
    """
    check_times("plan", duration_s=duration_s)
    progress = np.array([0, 0, 0, 10 / duration_s**3, -15 / duration_s**4, 6 / duration_s**5])
    coefficients = np.outer(np.subtract(goal, start), progress)
    if detour is not None:
        bump = -4 * np.convolve(progress, progress)
        bump[: len(progress)] += 4 * progress
        coefficients = np.pad(coefficients, ((0, 0), (0, len(bump) - len(progress))))
        coefficients += np.outer(detour, bump)
    coefficients[:, 0] += start
    segment = np.array([[Polynomial(row)] for row in coefficients])
    return PiecewisePolynomial([segment], [start_time_s, start_time_s + duration_s])


def to_world(stance_pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transforms points (..., 3) [m] from the stance frame ``[x, y, yaw]`` to the world."""
    x, y, yaw = stance_pose.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (x, y, 0.0)


def _checked(plan: PiecewisePolynomial) -> PiecewisePolynomial:
    if (size := (plan.rows(), plan.cols())) != (3, 1):
        raise ValueError(f"planner: the plan must have 3 rows and one column; got {size}")
    return plan


class TrajectoryPlanner(LeafSystem):
    """Evaluates a plan z*(t) and its next H samples.

    .. pydrake_system::

        name: TrajectoryPlanner
        input_ports: [stance_pose: 3 (optional)]
        output_ports: [desired_output: n_z, desired_output_rate: n_z, desired_preview: H n_z,
          desired_outlook: M n_z]

    The plan is a trajectory of 3-D positions in the stance frame S, and a parameter of the Context
    (:meth:`set_plan`). Before its start and after its end it is constant. ``desired_output`` and
    its rate are in the world, preview and outlook in S, row-major in time. The stance pose
    [x, y, yaw] is the input if it is connected, else a parameter.

    Args:
        horizon, step_s: H, and the time between two samples of the preview [s].
        outlook_s, num_outlook: Time until the last sample of the outlook [s], and M.
        plan: The default, (n_z, 1) [m].
    """

    def __init__(
        self,
        *,
        horizon: int,
        step_s: float,
        outlook_s: float | None = None,
        num_outlook: int = 5,
        plan: PiecewisePolynomial | None = None,
    ):
        super().__init__()
        outlook_s = step_s * (horizon - 1) if outlook_s is None else outlook_s
        check_times("planner", or_zero=["outlook_s"], step_s=step_s, outlook_s=outlook_s)
        checked = None if plan is None else _checked(plan)
        # In a tuple, as Drake 1.58 makes no Value of None.
        self._plan_index = self.DeclareAbstractParameter(Value((checked,)))
        self._stance_index = self.DeclareNumericParameter(BasicVector(np.zeros(3)))
        self._stance_port = self.DeclareVectorInputPort("stance_pose", 3)
        self.DeclareVectorOutputPort("desired_output", 3, self._calc_output)
        self.DeclareVectorOutputPort("desired_output_rate", 3, self._calc_rate)
        ticket = {self.time_ticket(), self.all_parameters_ticket()}
        for name, offsets in (
            ("desired_preview", step_s * np.arange(horizon)),
            ("desired_outlook", np.linspace(0.0, outlook_s, num_outlook)),
        ):
            calc = partial(self._calc_samples, offsets)
            self.DeclareVectorOutputPort(name, 3 * len(offsets), calc, ticket)

    def _calc_samples(self, offsets: np.ndarray, context: Context, output: BasicVector) -> None:
        values = self.get_plan(context).vector_values(context.get_time() + offsets)
        output.SetFromVector(values.ravel(order="F"))

    def set_plan(
        self, context: Context, plan: PiecewisePolynomial, stance_pose: np.ndarray | None = None
    ) -> None:
        """Sets the plan, (n_z, 1) [m], and for an unconnected input the stance pose (3,)."""
        context.get_mutable_abstract_parameter(self._plan_index).set_value((_checked(plan),))
        if stance_pose is not None:
            context.get_mutable_numeric_parameter(self._stance_index).SetFromVector(stance_pose)

    def get_plan(self, context: Context) -> PiecewisePolynomial:
        """Returns the plan in a Context, in the stance frame."""
        (plan,) = context.get_abstract_parameter(self._plan_index).get_value()
        if plan is None:
            raise ValueError("planner: no plan; give one by plan= or set_plan(context, plan)")
        return plan

    def plan_from_now(self, context: Context) -> PiecewisePolynomial:
        """Returns the plan in a Context over the time since now, in the stance frame."""
        plan = copy.copy(self.get_plan(context))
        plan.shiftRight(-context.get_time())
        return plan

    def _stance_pose(self, context: Context) -> np.ndarray:
        if self._stance_port.HasValue(context):
            return self._stance_port.Eval(context)
        return context.get_numeric_parameter(self._stance_index).get_value()

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        z = self.get_plan(context).value(context.get_time())
        output.SetFromVector(to_world(self._stance_pose(context), z.T).ravel())

    def _calc_rate(self, context: Context, output: BasicVector) -> None:
        plan = self.get_plan(context)
        time, rate = context.get_time(), np.zeros((3, 1))
        if plan.start_time() <= time <= plan.end_time():
            rate = plan.EvalDerivative(time, derivative_order=1)
        yaw = self._stance_pose(context)[2]
        output.SetFromVector(to_world(np.array([0.0, 0.0, yaw]), rate.T).ravel())
