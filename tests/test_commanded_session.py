"""A live session with a walking robot: keys change its command, push it, and switch its guard."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from drake_safety import load_scenario
from drake_safety.live.session import GUARD, HALT, PUSH, START, LiveSession
from live_scenarios import learned, quick

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def session():
    scenario = quick(load_scenario("go2_walking"))
    assessment, meshcat = learned(scenario, 8), Meshcat()
    loop = scenario.make_loop("nominal", assessment=assessment, meshcat=meshcat, guard=True)
    return LiveSession(loop, meshcat, threshold=0.5)


def ticks(session, *names, num=1):
    for name in names:
        session.panel.click(name)
    for _ in range(num):
        assert session.tick()


def test_keys_change_the_command_within_the_range_of_training(session):
    ticks(session, START)
    np.testing.assert_array_equal(session.command, np.zeros(3))
    ticks(session, "Faster", "Turn left")
    high = session.loop.target_box[1]
    np.testing.assert_allclose(session.command, high * [1 / 8, 0.0, 1 / 8])
    preview = session.loop.GetOutputPort("desired_preview")
    for _ in range(10):
        ticks(session, "Faster")
    assert session.command[0] == high[0]
    ticks(session, HALT, num=4)
    np.testing.assert_array_equal(session.command, np.zeros(3))
    np.testing.assert_allclose(preview.Eval(session.context), 0.0, atol=1e-9)


def test_without_the_guard_what_is_asked_is_passed_on(session):
    ticks(session, START, GUARD)
    assert not session.is_guarded
    ticks(session, *["Faster"], num=4)
    asked = session.loop.GetOutputPort("desired_output").Eval(session.context)
    np.testing.assert_allclose(asked, session.command)
    assert session.loop.GetOutputPort("guard_active").Eval(session.context)[0] == 0.0
    ticks(session, GUARD)
    assert session.is_guarded


def test_a_push_moves_the_robot_and_a_fall_is_followed_by_standing(session):
    ticks(session, START, num=3)
    before = session.loop.GetOutputPort("output").Eval(session.context).copy()
    ticks(session, PUSH, num=5)
    after = session.loop.GetOutputPort("output").Eval(session.context)
    assert np.linalg.norm((after - before)[:2]) > 0.5
    assert "pushed with" in session.panel.status.note
    session._end_s = session.context.get_time()
    ticks(session)
    assert session.context.get_time() < 0.1
