import numpy as np

from drake_safety.systems.plan_features import PlanFeatures


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
