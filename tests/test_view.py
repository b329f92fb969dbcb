from drake_safety.simulation.legged_loop import View


def test_a_view_mirrored_twice_is_itself():
    view = View(azimuth_rad=0.7, elevation_rad=0.2, room=1.5)
    assert view.mirrored().azimuth_rad == -0.7
    assert view.mirrored() != view
    assert view.mirrored().mirrored() == view
