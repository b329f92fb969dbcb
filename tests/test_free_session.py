import contextlib
import dataclasses
import json
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar
from unittest import mock

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from cart_pole_task import SCENARIO, CartPole
from command_line import call
from drake_safety import AddSafetyAssessor, load_scenario
from drake_safety.cli.training_folder import assessment_file
from drake_safety.live.session import BREAK_S, FORCE, PUSH, START, STOP, TICK_S, LiveSession
from drake_safety.plants.pushes import Push
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import Gliding, gliding
from live_scenarios import learned, quick
from shuttle_task import shuttling

pytestmark = pytest.mark.train

SHOWN_S = 1.5


class BareCartPole(CartPole):
    """A task whose constructor takes no Meshcat."""

    def __init__(self, scenario, variation="nominal", *, assessment=None):
        super().__init__(scenario, variation, assessment=assessment)


class Pushed(Gliding):
    """One that can be pushed."""

    pushes: ClassVar[dict] = {}

    def sample_push(self, rng):
        return Push(force_n=[rng.uniform(2.0, 3.0), 0.0, 0.0])

    def set_push(self, context, push):
        x, _ = self.GetOutputPort("state").Eval(context)
        mass_context = self.mass.GetMyMutableContextFromRoot(context)
        mass_context.SetDiscreteState([x, push.force_n[0]])


class FewPorts(Gliding):
    """A task that exports no more of its assessor than it has to."""

    def export(self, builder, ports, *, period_s):
        seen = {name: ports[name] for name in ("state", "desired_preview", "features", "margins")}
        assessor = AddSafetyAssessor(builder, self.assessment, period_s=period_s, **seen)
        ports |= {name: assessor.GetOutputPort(name) for name in ASSESSMENT_PORTS}
        for name, port in ports.items():
            builder.ExportOutput(port, name)


@pytest.fixture(scope="module")
def meshcat():
    return Meshcat()


@pytest.fixture(scope="module")
def cart_loop(meshcat):
    scenario = parse_scenario(SCENARIO, name="cart_pole", folder=Path())
    return scenario.make_loop(assessment=learned(scenario, 200), meshcat=meshcat)


@pytest.fixture(scope="module")
def shuttle_loop():
    scenario = quick(shuttling())
    return scenario.make_loop(assessment=learned(scenario))


@pytest.fixture
def session(cart_loop, meshcat):
    return LiveSession(cart_loop, meshcat, threshold=0.5)


def set_state(session, *state):
    cart = session.loop.cart
    cart.SetPositionsAndVelocities(cart.GetMyMutableContextFromRoot(session.context), state)


def ticks(session, seconds):
    for _ in range(round(seconds / TICK_S)):
        assert session.tick()


def test_the_verdict_is_that_of_the_probability(session):
    gamma = session.loop.GetOutputPort("safety_probability")
    seen = set()
    for tick in range(300):
        if tick % 50 == 20:
            set_state(session, 0.6, 0.0, 1.5, 0.0)  # On its way to the end of the rail.
        assert session.tick()
        assert session.panel.probability == gamma.Eval(session.context)[0]
        last = pytest.approx(session.panel.probability, abs=0.001)
        assert session.panel.curve()[-1] == (0.0, last)
        status = session.panel.status
        if not session.cause:
            is_known = session.panel.belief[2] <= 0.65  # Half of it is from empty cells.
            refused = "unsafe" if is_known else "don't know"
            assert status.state == ("safe" if session.panel.probability >= 0.5 else refused)
            assert status.tone == (status.state if is_known else "plain")
            seen.add(status.state)
    assert {"safe", "unsafe"} <= seen


def test_a_state_unlike_training_is_not_called_unsafe_but_unknown(session):
    set_state(session, 0.0, 0.0, 15.0, 0.0)
    assert session.tick()
    assert session.panel.belief == (0.0, 0.0, 1.0)
    assert (session.panel.status.state, session.panel.status.cause) == ("don't know", "")


def test_an_alarm_of_the_monitor_is_told_with_its_cause(session):
    ticks(session, 0.4)
    assert "monitor" not in session.panel.status.note
    monitor = session.loop.GetSubsystemByName("safety_assessor").monitor
    always = dataclasses.replace(session.assessment.detector_, alarm_level=-1.0)
    own = monitor.GetMyMutableContextFromRoot(session.context)
    monitor.adopt(own, SimpleNamespace(detector_=always))
    ticks(session, 0.4)
    cause = session.loop.GetOutputPort("alarm_cause").Eval(session.context)
    assert cause
    assert session.panel.status.note == f"R starts anew; monitor: {cause}"


def test_starts_are_those_of_the_seed_and_a_click_begins_the_next(cart_loop, meshcat):
    state = cart_loop.GetOutputPort("state")
    starts = []
    for _ in range(2):
        session = LiveSession(cart_loop, meshcat, threshold=0.5, seed=3)
        starts.append(state.Eval(session.context).copy())
        ticks(session, 0.4)
        session.panel.click(START)
        session.tick()
        assert session.context.get_time() == pytest.approx(TICK_S)
        starts.append(state.Eval(session.context).copy())
    np.testing.assert_array_equal(starts[:2], starts[2:])
    assert np.abs(starts[0] - starts[1]).max() > 0.1
    assert session.panel.buttons == {STOP: "Escape", START: "KeyR"}


def test_an_episode_whose_duration_has_passed_is_followed_by_the_next(session):
    set_state(session, 0.0, 0.0, 0.0, 0.0)
    ticks(session, 2.0)
    assert session.panel.status.note == "the episode's 2 s have passed; the next start follows"
    ticks(session, 1.6)
    assert session.context.get_time() < 3 * TICK_S
    assert session.panel.status.note == "R starts anew"


def test_that_it_left_the_safe_set_is_shown_until_the_next_start(session):
    set_state(session, 0.95, 0.0, 10.0, 0.0)
    for _ in range(round(SHOWN_S / TICK_S)):
        session.tick()
        assert session.panel.status.state == "left the safe set: rail"
    ticks(session, 3 * TICK_S)
    assert session.context.get_time() < 4 * TICK_S
    assert not session.cause


@pytest.mark.parametrize(("failure", "told"), [("raise", "the solver failed"), ("nan", "finite")])
def test_a_simulation_that_fails_is_shown_and_the_next_begins(meshcat, failure, told):
    scenario = quick(gliding(failure=failure, speed_m_s=4.0))
    loop = scenario.make_loop(assessment=learned(scenario), meshcat=meshcat)
    session = LiveSession(loop, meshcat, threshold=0.5)
    while session.tick():
        pass
    num_waits = 1
    while not session.tick():
        assert session.panel.status.state == "the simulation failed"
        assert told in session.panel.status.note
        num_waits += 1
    assert num_waits * BREAK_S == pytest.approx(SHOWN_S, abs=2 * BREAK_S)
    assert session.context.get_time() == pytest.approx(TICK_S)
    loop.mass.parameters.fails_at_start = True
    session = LiveSession(loop, meshcat, threshold=0.5)
    assert session.panel.status.note == "no start"
    loop.mass.parameters.fails_at_start = False
    session.panel.click(START)
    assert session.tick()


def test_what_can_be_pushed_has_a_button_for_it(meshcat):
    scenario = quick(gliding())
    loop = Pushed(scenario, assessment=learned(scenario))
    session = LiveSession(loop, meshcat, threshold=0.5)
    session.panel.click(PUSH)
    ticks(session, 0.04)
    assert loop.GetOutputPort("state").Eval(session.context)[1] >= 2.0
    assert session.panel.status.note.startswith("pushed with")


def test_goals_need_no_legs(shuttle_loop, meshcat):
    session = LiveSession(shuttle_loop, meshcat, threshold=0.5)
    assert not session.tick()
    session.panel.click(FORCE)
    ticks(session, 0.4)
    assert not session.has_fallen


def test_ports_that_are_not_exported_are_named(meshcat):
    scenario = quick(gliding())
    loop = FewPorts(scenario, assessment=learned(scenario))
    message = r"'FewPorts' exports no port \['cause_probability'"
    with pytest.raises(ValueError, match=message):
        LiveSession(loop, meshcat, threshold=0.5)
    with pytest.raises(ValueError, match=message):
        simulate(loop, lambda context: None, ["cause_probability"], End(duration_s=0.4))


def trained(folder, task):
    """Trains on a task of a module; returns the scenario and the folder for a command line."""
    file = folder / "cart_pole.yaml"
    file.write_text(SCENARIO.replace("cart_pole_task:CartPole", task))
    learned(quick(load_scenario(file))).save(assessment_file(folder, "sharpened"))
    return file, "--assessment", folder


@pytest.mark.slow
@pytest.mark.parametrize("task", ["cart_pole_task:CartPole", "test_free_session:BareCartPole"])
def test_such_a_task_can_be_played_and_run_and_an_empty_scene_is_warned_of(
    monkeypatch, capsys, tmp_path, task
):
    page = pytest.importorskip("drake_safety.live.page")
    shown = []

    @contextlib.contextmanager
    def serve_page(panel, **_):
        timer = threading.Timer(0.5, panel.click, [STOP])
        timer.start()
        yield
        timer.join()
        shown.append(panel)

    monkeypatch.setattr(page, "serve_page", serve_page)
    arguments = trained(tmp_path, task)
    warning = f"warning: task '{task}' draws nothing in Meshcat"
    for command in ("play", "run"):
        assert call(monkeypatch, command, *arguments) in (0, None)
        told = capsys.readouterr().out
        assert (warning in told) == ("draws nothing" in told) == ("Bare" in task)
        assert command == "run" or "real-time factor" in told
    assert shown[0].status.state == "stopped"
    run = tmp_path / "run"
    names = {path.name for path in run.iterdir()}
    assert names == {"recording.html", "run.json", "timeline.png", "timeline.svg"}
    rows = json.loads((run / "run.json").read_text())["rows"]
    assert rows[0][:2] == ["0.00", "the episode starts"]
    assert "end" in rows[-1][1] or "left" in rows[-1][1]
    assert "meshcat" in (run / "recording.html").read_text()[:200_000].lower()
    assert "the episode starts" in told
    for file in run.iterdir():
        file.unlink()
    broken = {"side_effect": RuntimeError("no picture")}
    with mock.patch("drake_safety.cli.run.timeline_figure", **broken), pytest.raises(RuntimeError):
        call(monkeypatch, "run", *arguments)
    # Its pictures come last.
    assert {path.name for path in run.iterdir()} == {"recording.html", "run.json"}
    capsys.readouterr()
    for options, message in (
        (["--push", "ball"], f"run: --push: task '{task.split(':')[1]}' has no ball to throw"),
        (["--target", "1 2 3"], "has no plans with a goal"),
    ):
        assert call(monkeypatch, "run", *arguments, *options) == 2
        assert message in " ".join(capsys.readouterr().out.split())
