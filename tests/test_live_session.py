"""Live sessions: clicks and sliders, as a browser sends them, and what comes of them."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from command_line import call
from drake_safety import load_scenario
from drake_safety.cli.console import LOOPBACK, open_viewer
from drake_safety.live.session import (
    AXES,
    DIRECTION,
    FORCE,
    GO,
    MASS,
    SPEED,
    START,
    STOP,
    THROW,
    TICK_S,
    LiveSession,
)
from live_scenarios import learned, quick
from reaching_targets import NEAR, SCENARIO, learned_targets

FAR = ("0.95", "0.5", "1.05")


def move(session, values):
    for name, value in zip(AXES, values, strict=True):
        session.panel.set_value(name, float(value))


@pytest.fixture(scope="module")
def meshcat():
    return Meshcat()


@pytest.fixture(scope="module")
def throws_loop(meshcat):
    scenario = quick(load_scenario("laikago_balancing"))
    options = {"meshcat": meshcat, "ball": True}
    return scenario.make_loop("nominal", assessment=learned(scenario, 8), **options)


@pytest.fixture
def throws(throws_loop, meshcat):
    return LiveSession(throws_loop, meshcat, threshold=0.4)


@pytest.fixture(scope="module")
def goals_loop(meshcat):
    return load_scenario(SCENARIO).make_loop(assessment=learned_targets(), meshcat=meshcat)


@pytest.fixture
def goals(goals_loop, meshcat):
    return LiveSession(goals_loop, meshcat, threshold=0.4)


@pytest.mark.train
def test_a_click_throws_the_ball_of_the_sliders_once(throws):
    ball = throws.loop.GetOutputPort("ball_state")
    throws.tick()
    assert np.linalg.norm(ball.Eval(throws.context)[4:6]) > 5  # Far away.
    for name, value in ((MASS, 2.0), (SPEED, 4.0), (DIRECTION, 90.0)):
        throws.panel.set_value(name, value)
    throws.panel.click(THROW)
    throws.tick()
    state = ball.Eval(throws.context)
    assert state[-3:-1] == pytest.approx([0.0, 4.0], abs=1e-6)
    assert throws.panel.status.note == "ball of 2 kg at 4 m/s towards 90°"
    was = state[4:7]
    throws.tick()
    assert ball.Eval(throws.context)[5] - was[1] == pytest.approx(4.0 * TICK_S, rel=0.05)


@pytest.mark.train
def test_a_robot_that_has_fallen_is_stood_up_again_after_a_while(throws):
    context = throws.context
    plant = throws.loop.plant
    plant_context = plant.GetMyMutableContextFromRoot(context)
    state = plant.GetPositionsAndVelocities(plant_context, throws.loop.robot_instance)
    state[6] = 0.12  # The base, on the ground.
    plant.SetPositionsAndVelocities(plant_context, throws.loop.robot_instance, state)
    throws.tick()
    assert throws.has_fallen
    assert throws.panel.status.state == "fallen"
    for _ in range(round(1.5 / TICK_S) + 1):
        throws.tick()
    assert not throws.has_fallen
    assert throws.context.get_time() <= 2 * TICK_S


@pytest.mark.train
def test_stop_ends_a_session_and_its_pace_is_what_was_simulated(throws, monkeypatch):
    tick, ticks = throws.tick, []

    def stopped_after_ten():
        ticks.append(tick())
        if len(ticks) == 10:
            throws.panel.click(STOP)
        return ticks[-1]

    monkeypatch.setattr(throws, "tick", stopped_after_ten)
    throws.run()
    assert len(ticks) == 10
    assert throws.panel.is_stopped
    pace = throws.pace
    assert pace.simulated_s == pytest.approx(throws.context.get_time())
    assert 0 < pace.busy_s <= pace.elapsed_s
    # Paced by the clock, but for what is caught up with.
    assert pace.simulated_s / pace.elapsed_s <= 1.3


@pytest.mark.train
def test_moving_the_target_changes_the_verdict_and_moves_nothing_else(goals):
    move(goals, NEAR)
    assert not goals.tick()
    assert goals.verdict.is_accepted
    assert goals.panel.status.state == f"accepted: probability {goals.verdict.probability:.2f}"
    move(goals, FAR)
    assert not goals.tick()
    assert not goals.verdict.is_accepted
    assert goals.panel.status.state.startswith("refused")
    assert goals.context.get_time() == 0.0


@pytest.mark.train
def test_go_is_refused_where_gamma_refuses_and_an_accepted_target_nearby_is_told(goals):
    move(goals, FAR)
    goals.panel.click(GO)
    assert not goals.tick()
    assert goals.context.get_time() == 0.0
    assert goals.nearest is not None
    distance_cm = 100 * np.linalg.norm(goals.nearest.goal - goals.verdict.goal)
    assert f"accepted {distance_cm:.0f} cm away" in goals.panel.status.note


@pytest.mark.train
@pytest.mark.parametrize(("target", "button"), [(NEAR, GO), (FAR, FORCE)])
def test_the_robot_goes_where_it_may_or_is_forced_to(goals, target, button):
    move(goals, target)
    goals.panel.click(button)
    assert goals.tick()
    assert goals.context.get_time() == pytest.approx(TICK_S)
    before = goals.loop.GetOutputPort("output").Eval(goals.context).copy()
    for _ in range(30):
        assert goals.tick()
    wanted = np.array(target, dtype=float)
    after = goals.loop.GetOutputPort("output").Eval(goals.context)
    assert np.linalg.norm(after - wanted) < np.linalg.norm(before - wanted) - 0.02
    goals.panel.click(START)
    assert not goals.tick()
    assert goals.context.get_time() == 0.0


def test_a_loop_without_gamma_cannot_be_played_with(meshcat):
    loop = load_scenario("laikago_balancing").make_loop()
    with pytest.raises(ValueError, match="without an assessment"):
        LiveSession(loop, meshcat, threshold=0.4)


def test_play_without_an_assessment_or_a_library_for_pages_says_what_to_do_first(
    monkeypatch, capsys, tmp_path
):
    play = ("play", "laikago_balancing", "--assessment", tmp_path)
    assert call(monkeypatch, *play) == 2
    assert "run `drake-safety train` first" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "nicegui", None)
    monkeypatch.delitem(sys.modules, "drake_safety.live.page", raising=False)
    assert call(monkeypatch, *play[:2]) == 2
    assert "pip install 'drake_safety[live]'" in capsys.readouterr().out


@pytest.mark.train
def test_the_robot_stays_in_the_middle_of_the_picture(throws, monkeypatch):
    moved, camera, context = {}, throws._camera, throws.context
    spy = SimpleNamespace(
        SetTransform=lambda path, X, time_s: moved.update({path: X.translation()})
    )
    monkeypatch.setattr(camera, "meshcat", spy)
    camera._target = camera._target + [1.3, -0.7]  # As after a step.
    base = throws.loop.GetOutputPort("plant_state").Eval(context)[4:6]
    camera.follow(context)
    assert np.linalg.norm(base + moved["/drake"][:2]) > 1
    for _ in range(20):
        camera._time_s -= TICK_S  # As if the simulation had gone on.
        camera.follow(context)
    assert base + moved["/drake"][:2] == pytest.approx([0, 0], abs=0.02)
    assert np.abs(moved["/drake/grid"][:2] - base).max() <= 0.3


def test_only_this_machine_reaches_a_page_unless_it_is_asked_for(capsys):
    here, everywhere = open_viewer(LOOPBACK), open_viewer("0.0.0.0")
    lines = Path("/proc/net/tcp").read_text().splitlines()
    listening = {line.split()[1] for line in lines if " 0A " in line}
    assert f"0100007F:{here.port():04X}" in listening
    assert f"00000000:{everywhere.port():04X}" in listening
    assert f"00000000:{here.port():04X}" not in listening
    with pytest.raises(ValueError, match=rf"no page can be served at {LOOPBACK}:{here.port()}"):
        open_viewer(LOOPBACK, here.port())
