import numpy as np
import pytest

from drake_safety.evaluation.roc_figure import roc_figure


def test_the_roc_runs_from_corner_to_corner_and_bounds_its_own_area():
    rng = np.random.default_rng(0)
    label = rng.random(500) < 0.4
    score = np.round(rng.normal(size=500) + label, 1)
    score[:5] = np.nan
    whole = roc_figure({"scorer": (score, label)}, thresholds={"scorer": 0.5}).axes[0]
    curve, point = whole.lines[:2]
    x, y = curve.get_data()
    assert (x[0], y[0], x[-1], y[-1]) == (0.0, 0.0, 1.0, 1.0)
    assert np.all(np.diff(x) >= 0.0) and np.all(np.diff(y) >= 0.0)
    area = np.trapezoid(y, x)
    assert curve.get_label() == f"scorer   {area:.3f}"
    # NaN counts among the alarms.
    is_alarm = (score > 0.5) | np.isnan(score)
    assert point.get_xdata()[0] == pytest.approx(is_alarm[~label].mean())
    assert point.get_ydata()[0] == pytest.approx(is_alarm[label].mean())
