import pytest

from drake_safety.simulation.legged_loop import View


def test_a_view_mirrored_twice_is_itself():
    view = View(azimuth_rad=0.7, elevation_rad=0.2, room=1.5)
    assert view.mirrored().azimuth_rad == -0.7
    assert view.mirrored() != view
    assert view.mirrored().mirrored() == view


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elevation_rad": 1.6}, "within a right angle; got 1.6"),
        ({"room": 0.0}, "room must be positive; got 0.0"),
    ],
)
def test_a_view_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        View(**change)
