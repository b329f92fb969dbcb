import numpy as np
import pytest

from drake_safety.evaluation.throws_figure import throws_figure


@pytest.mark.train
def test_every_throw_is_drawn_once_and_counted_by_its_outcome():
    speed = np.array([3.0, 5.0, 9.0, 10.0])
    direction = np.array([0.0, 1.0, 2.0, -2.0])
    fig = throws_figure(
        speed,
        direction,
        {
            "alone": ["survived", "survived", "fell", "fell"],
            "recovery": ["survived", "false trigger", "recovered", "fell"],
        },
        mass_kg=np.array([2.0, 2.0, 3.0, 4.0]),
    )
    alone, recovery = fig.axes
    assert [t.get_text() for t in alone.get_legend().get_texts()] == ["survived 2", "fell 2"]
    drawn = np.vstack([marks.get_offsets() for marks in recovery.collections])
    np.testing.assert_allclose(np.sort(drawn[:, 1]), speed)
    fell = next(m for m in recovery.collections if m.get_label() == "fell 1")
    np.testing.assert_allclose(fell.get_offsets(), [[-2.0, 10.0]])


def test_unknown_and_missing_outcomes_are_refused():
    one = np.ones(1)
    with pytest.raises(ValueError, match=r"unknown outcomes \['tripped'\]; the outcomes are"):
        throws_figure(one, one, {"alone": ["tripped"]})
    with pytest.raises(ValueError, match="'alone' has 2 outcomes for 1 throws"):
        throws_figure(one, one, {"alone": ["fell", "fell"]})
