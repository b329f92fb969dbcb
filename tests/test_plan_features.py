import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.safe_sets import BalanceLimits, BalanceSafeSet
from drake_safety.systems.plan_features import PlanFeatures
from legged_robots import robot_kinematics


class SumFeatures:
    """Features whose values tell which argument they came from."""

    feature_names = ("q", "v", "first", "last")

    def features(self, q, v, preview):
        return np.array([q.sum(), v.sum(), preview[0].sum(), preview[-1].sum()])


def features_of(plan_features, state, preview):
    context = plan_features.CreateDefaultContext()
    plan_features.GetInputPort("plant_state").FixValue(context, state)
    plan_features.GetInputPort("desired_preview").FixValue(context, np.ravel(preview))
    return plan_features.GetOutputPort("features").Eval(context)


def test_the_state_is_split_and_the_preview_is_row_major_in_time():
    plan_features = PlanFeatures(SumFeatures(), 3, 2, horizon=2)
    preview = np.array([[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]])
    values = features_of(plan_features, [1.0, 1.0, 1.0, 5.0, 6.0], preview)
    np.testing.assert_array_equal(values, [3.0, 11.0, 6.0, 60.0])
    assert plan_features.feature_names == list(SumFeatures.feature_names)


def test_a_safe_sets_features_come_out_as_it_computes_them():
    kinematics = robot_kinematics("hexapod")
    height = kinematics.standing_height
    limits = BalanceLimits(height_m=[0.8 * height, 1.2 * height], fall_height_m=0.5 * height)
    safe_set = BalanceSafeSet(kinematics, limits)
    n_q, n_v = kinematics.num_positions, kinematics.num_velocities
    q = kinematics.positions_at(RigidTransform([0.0, 0.01, height]), kinematics.posture)
    v = np.linspace(-1, 1, n_v)
    preview = np.tile([0.01, 0.0, height], (6, 1))
    plan_features = PlanFeatures(safe_set, n_q, n_v, horizon=6)
    values = features_of(plan_features, np.concatenate([q, v]), preview)
    np.testing.assert_array_equal(values, safe_set.features(q, v, preview))
