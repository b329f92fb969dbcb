import math

import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate
from gliding_task import evaluated

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


@pytest.mark.parametrize("detour", [None, np.zeros(3)])
def test_the_interpolation_starts_and_ends_at_rest(detour):
    plan = interpolate(START, GOAL, 0.8, start_time_s=0.3, detour=detour)
    for time, position in ((0.3, START), (1.1, GOAL)):
        np.testing.assert_allclose(plan.value(time)[:, 0], position, atol=1e-12)
        for order in (1, 2):
            derivative = plan.MakeDerivative(order).value(time)
            np.testing.assert_allclose(derivative, 0.0, atol=1e-9)
    np.testing.assert_allclose(plan.value(0.7)[:, 0], 0.5 * (START + GOAL), atol=1e-12)


def test_the_peak_speed_of_a_minimum_jerk_motion_is_fifteen_eighths_of_the_mean():
    plan = interpolate(np.zeros(1), np.ones(1), 2.0)
    assert plan.MakeDerivative().value(1.0)[0, 0] == pytest.approx(15 / 8 / 2.0)


def test_a_detour_moves_the_middle_and_neither_end():
    start, goal, detour = np.array([[0.0, 1.0], [2.0, 1.0], [-0.5, 0.25]])
    plan = interpolate(start, goal, 2.0, 1.0, detour=detour)
    for time, expected in ((1.0, start), (2.0, (start + goal) / 2 + detour), (3.0, goal)):
        np.testing.assert_allclose(plan.value(time).ravel(), expected, atol=1e-12)
    rate = plan.MakeDerivative()
    for time in (1.0, 3.0):
        np.testing.assert_allclose(rate.value(time).ravel(), np.zeros(2), atol=1e-12)


@pytest.mark.parametrize("duration_s", [0.0, -1.0, math.nan])
def test_an_interpolation_takes_time(duration_s):
    with pytest.raises(ValueError, match="duration_s must be positive"):
        interpolate(START, GOAL, duration_s)


def test_the_desired_output_is_the_plan_at_the_stance():
    plan = interpolate(START, GOAL, 1.0)
    planner, context = planner_at(0.4, plan, np.array([2.0, 1.0, math.pi / 2]))
    x, y, z = plan.value(0.4)[:, 0]
    np.testing.assert_allclose(evaluated(planner, context, "desired_output"), [2 - y, 1 + x, z])


def test_the_rate_is_the_derivative_of_the_desired_output():
    planner, context = planner_at(0.4, interpolate(START, GOAL, 1.0), np.array([2.0, 1.0, 0.8]))
    rate = evaluated(planner, context, "desired_output_rate")
    step, values = 1e-6, []
    for time in (0.4 - step, 0.4 + step):
        context.SetTime(time)
        values.append(evaluated(planner, context, "desired_output"))
    np.testing.assert_allclose(rate, (values[1] - values[0]) / (2 * step), atol=1e-8)


def test_without_a_stance_the_plan_is_in_the_world():
    planner, context = planner_at(0.5, ramp())
    np.testing.assert_allclose(evaluated(planner, context, "desired_output"), [0.5, 1.0, 0.0])


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


def test_a_new_plan_keeps_the_stance_and_renews_every_output():
    planner, context = planner_at(0.5, ramp(), np.array([1.0, 0.0, 0.0]))
    names = ("desired_output", "desired_output_rate", "desired_preview")
    before = [evaluated(planner, context, name).copy() for name in names]
    planner.set_plan(context, ramp((-3.0, 0.0, 0.0)))
    np.testing.assert_allclose(evaluated(planner, context, "desired_output"), [-0.5, 0.0, 0.0])
    for old, name in zip(before, names, strict=True):
        assert not np.allclose(old, evaluated(planner, context, name))


def test_a_plan_lives_in_the_context_not_in_the_planner():
    planner, context = planner_at(0.5, ramp())
    other = planner.CreateDefaultContext()
    np.testing.assert_array_equal(evaluated(planner, other, "desired_output"), np.zeros(3))
    assert planner.get_plan(context).end_time() == 1.0


def test_six_outputs_are_two_points_of_one_stance():
    plan = PiecewisePolynomial(np.array([[1.0], [0.0], [0.1], [0.0], [1.0], [0.2]]))
    planner, context = planner_at(
        0.0, plan, np.array([0.0, 0.0, math.pi / 2]), num_outputs=6, horizon=1
    )
    np.testing.assert_allclose(
        evaluated(planner, context, "desired_output"), [0, 1, 0.1, -1, 0, 0.2], atol=1e-12
    )
    np.testing.assert_array_equal(
        evaluated(planner, context, "desired_preview"), [1, 0, 0.1, 0, 1, 0.2]
    )


def test_a_plan_of_another_size_is_refused():
    planner = TrajectoryPlanner(horizon=2, step_s=0.1)
    with pytest.raises(ValueError, match="must have 3 rows and one column; got 2 x 1"):
        planner.set_plan(planner.CreateDefaultContext(), PiecewisePolynomial(np.zeros((2, 1))))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0, "step_s": 0.1}, "horizon and step_s must be positive; got 0, 0.1"),
        ({"horizon": 2, "step_s": 0.0}, "horizon and step_s must be positive"),
        ({"horizon": 2, "step_s": 0.1, "num_outputs": 4}, "multiple of 3; got 4"),
    ],
)
def test_impossible_sizes_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TrajectoryPlanner(**options)
