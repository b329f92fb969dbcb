import numpy as np
import pytest

from drake_safety.systems.trajectory_planner import interpolate, plan_shape, points_of_plan

START, GOAL = np.array([0.1, 0.2, 0.9]), np.array([0.7, -0.2, 1.3])
DETOUR = np.array([-0.1, 0.15, 0.05])
STEP_S, DURATION_S = 0.1, 3.0


def preview_of(num_samples, detour=None):
    plan = interpolate(START, GOAL, DURATION_S, detour=detour)
    return plan.vector_values(STEP_S * np.arange(num_samples)).T


@pytest.mark.parametrize("num_samples", [12, 31, 40])
@pytest.mark.parametrize("detour", [None, DETOUR], ids=["straight", "detour"])
def test_start_goal_and_detour_are_found_though_the_preview_ends_before_or_after_the_plan(
    num_samples, detour
):
    found = plan_shape(preview_of(num_samples, detour), STEP_S, DURATION_S)
    expected = [START, GOAL, np.zeros(3) if detour is None else detour]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_preview_of_another_frame_is_the_shape_of_that_frame():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shape = plan_shape(preview_of(20, DETOUR), STEP_S, DURATION_S)
    turned = plan_shape(preview_of(20, DETOUR) @ turn.T + [1, 2, 3], STEP_S, DURATION_S)
    np.testing.assert_allclose(turned[:2], shape[:2] @ turn.T + [1, 2, 3], atol=1e-9)
    # A detour is a direction: it turns and does not move.
    np.testing.assert_allclose(turned[2], shape[2] @ turn.T, atol=1e-9)


def test_points_of_a_shape_begin_at_its_start_pass_by_its_detour_and_end_at_its_goal():
    points = points_of_plan(np.array([START, GOAL, DETOUR]), 5)
    np.testing.assert_allclose(points[[0, -1]], [START, GOAL], atol=1e-12)
    np.testing.assert_allclose(points[2], 0.5 * (START + GOAL) + DETOUR, atol=1e-12)
    np.testing.assert_allclose(points[1], 0.75 * START + 0.25 * GOAL + 0.75 * DETOUR, atol=1e-12)
