import numpy as np

from drake_safety.evaluation.roc_figure import roc_figure


def test_the_roc_runs_from_corner_to_corner_and_bounds_its_own_area():
    rng = np.random.default_rng(0)
    label = rng.random(500) < 0.4
    (curve,) = (
        roc_figure({"scorer": np.round(rng.normal(size=500) + label, 1)}, label).axes[0].lines
    )
    x, y = curve.get_data()
    assert (x[0], y[0], x[-1], y[-1]) == (0.0, 0.0, 1.0, 1.0)
    assert np.all(np.diff(x) >= 0.0) and np.all(np.diff(y) >= 0.0)
    assert curve.get_label() == f"scorer   {np.trapezoid(y, x):.3f}"
