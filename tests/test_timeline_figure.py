from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.timeline_figure import timeline_figure


@pytest.fixture
def run():
    time_s = np.arange(0.0, 2.0, 0.02)
    gamma = np.where(time_s < 1.0, 0.9, 0.2)
    belief = np.column_stack([0.7 * gamma, 0.7 * (1 - gamma), np.full(len(gamma), 0.3)])
    margins = np.column_stack([0.1 - 0.1 * time_s, np.full(len(time_s), 0.05)])
    return {
        "time_s": time_s,
        "probability": gamma,
        "threshold": 0.6,
        "throws": [SimpleNamespace(time_s=0.98, mass_kg=3.0, speed_m_s=8.0)],
        "trigger_times_s": [1.0],
        "recovery_intervals_s": [(1.0, 1.6)],
        "stills": [(0.5, np.zeros((6, 8, 3), np.uint8)), (1.2, np.full((6, 8, 3), 255, np.uint8))],
        "belief": belief,
        "margins": margins,
        "constraint_names": ["support_polygon", "height"],
    }


def test_names_of_events_are_above_the_curve_and_cover_neither_another_nor_its_instant(run):
    throws = [SimpleNamespace(time_s=at_s, mass_kg=3.0, speed_m_s=8.0) for at_s in (0.3, 1.9)]
    events = {"trigger_times_s": [1.96], "recovery_intervals_s": [(1.97, 2.0)]}
    fig = timeline_figure(**run | {"throws": throws} | events)
    fig.draw_without_rendering()
    gamma = fig.axes[2]
    to_data = gamma.transData.inverted()
    names = [one for one in gamma.texts if not one.get_text().startswith("threshold")]
    boxes = [one.get_window_extent().transformed(to_data) for one in names]
    assert len(boxes) == 4
    lines = np.concatenate([one.get_segments() for one in gamma.collections if one.get_segments()])
    assert sorted(lines[:, 0, 0]) == [0.3, 1.9, 1.96, 1.97]
    for i, box in enumerate(boxes):
        assert box.y0 > 1.0
        assert box.y1 < gamma.get_ylim()[1]
        assert fig.bbox.x0 < gamma.transData.transform((box.x1, 0.0))[0] < fig.bbox.x1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
        # No line crosses it.
        crosses = (box.x0 <= lines[:, 0, 0]) & (lines[:, 0, 0] <= box.x1)
        assert not (crosses & (lines[:, 1, 1] >= box.y0)).any()


def test_the_timeline_s_belief_is_stacked_to_one_and_margins_are_in_centimetres(run):
    *_, belief, margins = timeline_figure(**run, angular_constraints=["height"]).axes
    tops = [c.get_paths()[0].vertices[:, 1].max() for c in belief.collections]
    np.testing.assert_allclose(tops, [0.63, 0.93, 1.0])
    drawn = {line.get_label(): line.get_ydata() for line in margins.lines}
    np.testing.assert_allclose(drawn["support polygon"][0], 10.0)
    np.testing.assert_allclose(drawn["height [°]"], np.degrees(0.05))
