import itertools

import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate
from toy_tasks import evaluated

START, GOAL = np.array([0.0, 0.1, 0.4]), np.array([0.2, -0.1, 0.5])


def planner_at(time, plan, stance_pose=None, **options):
    planner = TrajectoryPlanner(**{"horizon": 4, "step_s": 0.25} | options)
    context = planner.CreateDefaultContext()
    planner.set_plan(context, plan, stance_pose)
    context.SetTime(time)
    return planner, context


def ramp(rate=(1.0, 2.0, 0.0), duration_s=1.0):
    knots = np.array([np.zeros(3), duration_s * np.array(rate)]).T
    return PiecewisePolynomial.FirstOrderHold([0.0, duration_s], knots)


@pytest.mark.parametrize("detour", [None, np.zeros(3), np.array([-0.5, 0.25, 0.1])])
def test_the_interpolation_starts_and_ends_at_rest_and_a_detour_moves_its_middle_alone(detour):
    plan = interpolate(START, GOAL, 0.8, start_time_s=0.3, detour=detour)
    middle = 0.5 * (START + GOAL) + (0.0 if detour is None else detour)
    for time, position in ((0.3, START), (0.7, middle), (1.1, GOAL)):
        np.testing.assert_allclose(plan.value(time)[:, 0], position, atol=1e-12)
    for time, order in itertools.product((0.3, 1.1), (1, 2)):
        if order == 1 or detour is None or not detour.any():
            derivative = plan.MakeDerivative(order).value(time)
            np.testing.assert_allclose(derivative, 0.0, atol=1e-9)
    # The peak speed is fifteen eighths of the mean.
    plan = interpolate(np.zeros(1), np.ones(1), 2.0)
    assert plan.MakeDerivative().value(1.0)[0, 0] == pytest.approx(15 / 8 / 2.0)


def test_without_a_plan_it_says_so_and_one_may_be_given_to_the_constructor():
    options = {"horizon": 2, "step_s": 0.1}
    planner = TrajectoryPlanner(**options)
    with pytest.raises(ValueError, match="no plan; give one by plan="):
        evaluated(planner, planner.CreateDefaultContext(), "desired_output")
    planner = TrajectoryPlanner(**options, plan=interpolate(START, GOAL, 1.0))
    output = evaluated(planner, planner.CreateDefaultContext(), "desired_output")
    np.testing.assert_array_equal(output, START)
    with pytest.raises(ValueError, match="must have 3 rows and one column"):
        planner.set_plan(planner.CreateDefaultContext(), PiecewisePolynomial(np.zeros((2, 1))))


def test_the_rate_is_the_derivative_of_the_desired_output():
    planner, context = planner_at(0.4, interpolate(START, GOAL, 1.0), np.array([2.0, 1.0, 0.8]))
    rate = evaluated(planner, context, "desired_output_rate")
    step, values = 1e-6, []
    for time in (0.4 - step, 0.4 + step):
        context.SetTime(time)
        values.append(evaluated(planner, context, "desired_output"))
    np.testing.assert_allclose(rate, (values[1] - values[0]) / (2 * step), atol=1e-8)


def test_the_preview_is_the_plan_at_now_and_the_next_samples_in_the_stance_frame():
    planner, context = planner_at(0.5, ramp(), np.array([9.0, 9.0, 1.0]), horizon=3, step_s=0.125)
    preview = evaluated(planner, context, "desired_preview").reshape(3, 3)
    np.testing.assert_allclose(preview[:, 0], [0.5, 0.625, 0.75])
    np.testing.assert_allclose(preview[:, 1], [1.0, 1.25, 1.5])
    context.SetTime(0.9)
    held = evaluated(planner, context, "desired_preview").reshape(3, 3)
    np.testing.assert_allclose(held[:, 0], [0.9, 1.0, 1.0])


@pytest.mark.parametrize("time", [-1.0, 2.0])
def test_outside_its_time_the_plan_holds_still(time):
    planner, context = planner_at(time, ramp())
    end = ramp().value(min(max(time, 0.0), 1.0))[:, 0]
    np.testing.assert_array_equal(evaluated(planner, context, "desired_output"), end)
    np.testing.assert_array_equal(evaluated(planner, context, "desired_output_rate"), np.zeros(3))
    preview = evaluated(planner, context, "desired_preview").reshape(4, 3)
    np.testing.assert_array_equal(preview[0], end)


def test_a_connected_stance_pose_overrides_the_parameter():
    planner, context = planner_at(0.5, ramp(), np.array([1.0, 0.0, 0.0]))
    planner.GetInputPort("stance_pose").FixValue(context, [5.0, 6.0, 0.0])
    np.testing.assert_allclose(evaluated(planner, context, "desired_output"), [5.5, 7.0, 0.0])
