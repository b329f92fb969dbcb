"""Live sessions: clicks and sliders, as a browser sends them, and what comes of them."""

import math
import shutil
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from drake_safety import SafetyAssessment, load_scenario, run_episodes
from drake_safety.cli import main
from drake_safety.cli.console import LOOPBACK, open_viewer
from drake_safety.live.panel import UNSAFE_RGB, LivePanel, picture_board, text_picture
from drake_safety.live.session import (
    PROBABILITY,
    STOP,
    TICK_S,
    LiveGoals,
    LiveSession,
    LiveThrows,
    Pace,
)
from drake_safety.simulation.legged_loop import View
from live_pages import click, quick
from reaching_targets import NEAR, made_up_episodes

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
FAR = ("0.95", "0.5", "1.05")


def move(session, values):
    for name, value in zip(session.AXES, values, strict=True):
        session.meshcat.SetSliderValue(name, float(value))


@pytest.fixture(scope="module")
def meshcat():
    return Meshcat()


@pytest.fixture(scope="module")
def balancing():
    scenario = quick(load_scenario("laikago_balancing"))
    return scenario, SafetyAssessment(scenario.assessment).fit(
        run_episodes(scenario, 8, num_workers=1)
    )


@pytest.fixture(scope="module")
def throws_loop(balancing, meshcat):
    scenario, assessment = balancing
    return scenario.make_loop("nominal", assessment=assessment, meshcat=meshcat, ball=True)


@pytest.fixture
def throws(throws_loop, meshcat):
    meshcat.DeleteAddedControls()
    return LiveThrows(throws_loop, meshcat, threshold=0.4)


@pytest.fixture(scope="module")
def goals_loop(meshcat):
    scenario = quick(load_scenario("atlas_reaching"))
    scenario.assessment.epochs = 40
    assessment = SafetyAssessment(scenario.assessment).fit(made_up_episodes(scenario.make_loop()))
    return scenario.make_loop("nominal", assessment=assessment, meshcat=meshcat)


@pytest.fixture
def goals(goals_loop, meshcat):
    meshcat.DeleteAddedControls()
    return LiveGoals(goals_loop, meshcat, threshold=0.4)


def test_a_tick_goes_on_by_its_time_and_the_slider_shows_the_gamma_of_the_loop(throws):
    assert throws.tick()
    assert throws.context.get_time() == pytest.approx(TICK_S)
    gamma = throws.loop.GetOutputPort(throws.loop.trigger_port).Eval(throws.context)[0]
    assert throws.probability == gamma
    assert throws.meshcat.GetSliderValue(PROBABILITY) == pytest.approx(gamma, abs=0.0051)


def test_a_click_throws_the_ball_of_the_sliders_once(throws):
    ball = throws.loop.GetOutputPort("ball_state")
    throws.tick()
    assert np.linalg.norm(ball.Eval(throws.context)[4:6]) > 5  # Far away.
    for name, value in ((throws.MASS, 2.0), (throws.SPEED, 4.0), (throws.DIRECTION, 90.0)):
        throws.meshcat.SetSliderValue(name, value)
    click(throws, throws.THROW)
    throws.tick()
    state = ball.Eval(throws.context)
    assert state[-3:-1] == pytest.approx([0.0, 4.0], abs=1e-6)
    assert throws.panel.text[1] == "ball of 2 kg at 4 m/s towards 90°"
    was = state[4:7]
    throws.tick()
    assert ball.Eval(throws.context)[5] - was[1] == pytest.approx(4.0 * TICK_S, rel=0.05)


def test_a_robot_that_has_fallen_is_stood_up_again_after_a_while(throws):
    context = throws.context
    plant = throws.loop.plant
    plant_context = plant.GetMyMutableContextFromRoot(context)
    state = plant.GetPositionsAndVelocities(plant_context, throws.loop.robot_instance)
    state[6] = 0.12  # The base, on the ground.
    plant.SetPositionsAndVelocities(plant_context, throws.loop.robot_instance, state)
    throws.tick()
    assert throws.has_fallen
    assert throws.panel.text[0] == "fell"
    for _ in range(round(1.5 / TICK_S) + 1):
        throws.tick()
    assert not throws.has_fallen
    assert context.get_time() <= 2 * TICK_S


def test_stop_ends_a_session_and_its_pace_is_what_was_simulated(throws, monkeypatch):
    tick, ticks = throws.tick, []

    def stopped_after_ten():
        ticks.append(tick())
        if len(ticks) == 10:
            click(throws, STOP)
        return ticks[-1]

    monkeypatch.setattr(throws, "tick", stopped_after_ten)
    throws.run()
    assert len(ticks) == 10
    pace = throws.pace
    assert pace.simulated_s == pytest.approx(throws.context.get_time())
    assert 0 < pace.busy_s <= pace.elapsed_s
    assert pace.realtime_factor <= 1.3  # Paced by the clock, but for what is caught up with.


def test_factors_are_simulated_by_real_time():
    pace = Pace(simulated_s=6.0, busy_s=2.0, elapsed_s=5.0)
    assert (pace.realtime_factor, pace.possible_factor) == (1.2, 3.0)
    assert np.isnan(Pace().realtime_factor)


def test_moving_the_target_changes_the_verdict_and_moves_nothing_else(goals):
    move(goals, NEAR)
    assert not goals.tick()
    assert goals.verdict.is_accepted
    assert goals.panel.text[0] == f"accepted: Γ {goals.verdict.safety_probability:.2f}"
    move(goals, FAR)
    assert not goals.tick()
    assert not goals.verdict.is_accepted
    assert goals.panel.text[0].startswith("refused")
    assert goals.context.get_time() == 0.0


def test_go_is_refused_where_gamma_refuses_and_an_accepted_target_nearby_is_told(goals):
    move(goals, FAR)
    click(goals, goals.GO)
    assert not goals.tick()
    assert goals.context.get_time() == 0.0
    assert goals.nearest is not None
    distance_cm = 100 * np.linalg.norm(goals.nearest.goal - goals.verdict.goal)
    assert f"accepted {distance_cm:.0f} cm away" in goals.panel.text[1]


@pytest.mark.parametrize(("target", "button"), [(NEAR, "GO"), (FAR, "FORCE")])
def test_the_robot_goes_where_it_may_or_is_forced_to(goals, target, button):
    move(goals, target)
    click(goals, getattr(goals, button))
    assert goals.tick()
    assert goals.context.get_time() == pytest.approx(TICK_S)
    before = goals.loop.GetOutputPort("output").Eval(goals.context).copy()
    for _ in range(30):
        assert goals.tick()
    wanted = np.array(target, dtype=float)
    after = goals.loop.GetOutputPort("output").Eval(goals.context)
    assert np.linalg.norm(after - wanted) < np.linalg.norm(before - wanted) - 0.02
    click(goals, goals.STAND)
    assert not goals.tick()
    assert goals.context.get_time() == 0.0


def test_a_loop_without_gamma_cannot_be_played_with(meshcat):
    loop = load_scenario("laikago_balancing").make_loop()
    with pytest.raises(ValueError, match="without an assessment"):
        LiveThrows(loop, meshcat, threshold=0.4)


def test_play_without_an_assessment_says_what_to_do_first(monkeypatch, capsys, tmp_path):
    line = ["drake-safety", "play", "laikago_balancing", "--assessment", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "run `drake-safety train` first" in capsys.readouterr().out


def test_play_tells_the_real_time_factor_when_it_is_interrupted(
    monkeypatch, capsys, tmp_path, balancing
):
    balancing[1].save(tmp_path / "sharpened.safetensors")

    def run(session):
        for _ in range(3):
            session.tick()
        session.pace.simulated_s, session.pace.busy_s, session.pace.elapsed_s = 3.0, 1.0, 3.0
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveSession, "run", run)
    line = ["drake-safety", "play", "laikago_balancing", "--assessment", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    told = capsys.readouterr().out
    assert "live at http://" in told
    assert "real-time factor 1.00 over 3.0 s simulated; this machine could run it at 3.00" in told


def test_the_parts_of_the_belief_fill_the_bar_in_proportion(meshcat):
    panel = LivePanel(meshcat, View(), threshold=0.5, width_m=1.0)
    moved = {}

    class Spy:
        def SetTransform(self, path, X):
            moved[path.split("/")[-1]] = X

    panel._meshcat = Spy()
    panel.show_belief(np.array([0.5, 0.2, 0.3]))
    widths = {name: X[0, 0] for name, X in moved.items()}
    assert widths["safe"] / widths["unsafe"] == pytest.approx(2.5)
    ends = [moved[name][0, 3] + np.array([-0.5, 0.5]) * widths[name] for name in moved]
    assert np.concatenate(ends)[1:-1].reshape(-1, 2) == pytest.approx(
        np.repeat([ends[0][1], ends[1][1]], 2).reshape(-1, 2)
    )
    moved.clear()
    panel.show_belief(np.full(3, np.nan))
    assert moved["unknown"][0, 0] > 100 * moved["safe"][0, 0]


def test_long_words_are_made_to_fit_their_board():
    from io import BytesIO

    from matplotlib.image import imread

    size = {"width": 1.0, "height": 0.17, "rgb": (1, 1, 1), "ground": UNSAFE_RGB}
    picture = imread(BytesIO(text_picture("fell", "a very long remark " * 8, **size)))
    edges = picture[:, [0, 1, -2, -1], :3]
    assert edges == pytest.approx(np.broadcast_to(UNSAFE_RGB, edges.shape), abs=0.01)
    assert np.ptp(picture[..., 0]) > 0.1
    assert picture_board(b"", 1.0, 0.17).mesh_file.extension() == ".gltf"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=f"no browser on the path: none of {NAMES}")
def test_a_browser_shows_the_board_and_its_button_throws_the_ball(throws, tmp_path):
    from matplotlib.image import imread

    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1000, "height": 640})
        complaints = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(throws.meshcat.web_url())
        page.get_by_text("Open Controls").first.click()
        throws.tick()
        page.get_by_text(throws.THROW, exact=True).click()
        end = time.monotonic() + 20
        while throws.meshcat.GetButtonClicks(throws.THROW) == 0 and time.monotonic() < end:
            page.wait_for_timeout(100)
        throws.tick()
        assert throws.panel.text[1].startswith("ball of 3 kg at 8 m/s")
        throws.meshcat.Flush()
        share, end = 0.0, time.monotonic() + 30
        while not 0.004 < share < 0.2 and time.monotonic() < end:
            page.wait_for_timeout(500)
            page.screenshot(path=tmp_path / "play.png")
            picture = imread(tmp_path / "play.png")[..., :3]
            red, _, blue = np.moveaxis(picture[:, :740], -1, 0)  # Without the controls.
            # The board's words stand on blue; the ground and the sky are grey.
            share = (blue - red > 0.4).mean()
        browser.close()
    assert complaints == []
    assert 0.004 < share < 0.2


def test_only_this_machine_reaches_a_page_unless_it_is_asked_for(capsys):
    here, everywhere = open_viewer(LOOPBACK), open_viewer("0.0.0.0")
    listening = {
        line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines() if " 0A " in line
    }
    assert f"0100007F:{here.port():04X}" in listening
    assert f"00000000:{everywhere.port():04X}" in listening
    assert f"00000000:{here.port():04X}" not in listening
    with pytest.raises(ValueError, match=rf"no page can be served at {LOOPBACK}:{here.port()}"):
        open_viewer(LOOPBACK, here.port())


@pytest.mark.parametrize("sent", [-1.0, math.nan, math.inf, 1e308])
def test_what_a_page_sends_stays_within_the_range_of_its_slider(throws, sent):
    low, high = throws._ranges[throws.MASS]
    throws.meshcat.SetSliderValue(throws.MASS, 3.0)
    assert throws._slider(throws.MASS) == 3.0
    throws.meshcat = SimpleNamespace(GetSliderValue=lambda name: sent)
    assert low <= throws._slider(throws.MASS) <= high
