import pytest

from drake_safety.diagrams.reaching_parameters import ReachingParameters


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plan_duration_s": 0.0}, "plan_duration_s must be positive; got 0.0"),
        ({"monitor_period_s": -1.0}, "monitor_period_s must be positive"),
        (
            {"clearance_range_m": 0.01},
            "start.clearance_m must not exceed clearance_range_m.*0.01; got 0.02",
        ),
        (
            {"named_targets": {"can": [0.5, 0.1]}},
            r"named target 'can' must be three numbers \[m\]; got \[0.5, 0.1\]",
        ),
    ],
)
def test_parameters_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ReachingParameters(**change)
