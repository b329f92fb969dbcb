"""Live sessions: clicks and sliders, as a browser sends them, and what comes of them."""

import dataclasses
import math
import time
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from drake_safety import load_scenario
from drake_safety.cli.console import open_viewer
from drake_safety.live import session as live
from drake_safety.live.session import GO, PUSH, START, STOP, TICK_S, LiveSession
from drake_safety.plants.pushes import Push
from live_scenarios import learned, quick
from reaching_targets import FAR, NEAR, SCENARIO, learned_targets
from toy_tasks import Gliding, gliding

train = pytest.mark.train
SHOWN_S = 1.5


class Pushed(Gliding):
    """A mass that can be pushed."""

    pushes: ClassVar[dict] = {}

    def sample_push(self, rng):
        return Push(force_n=[rng.uniform(2.0, 3.0), 0.0, 0.0])

    def set_push(self, context, push):
        x, _ = self.GetOutputPort("state").Eval(context)
        mass_context = self.mass.GetMyMutableContextFromRoot(context)
        mass_context.SetDiscreteState([x, push.force_n[0]])


@pytest.fixture(scope="module")
def meshcat():
    return Meshcat()


def session_of(name, threshold, learn=lambda one: learned(quick(one), 8), changes=None, **options):
    @cache
    def loop(meshcat):
        scenario = load_scenario(name, changes)
        return scenario.make_loop(assessment=learn(scenario), meshcat=meshcat, **options)

    @pytest.fixture
    def session(meshcat):
        return LiveSession(loop(meshcat), meshcat, threshold=threshold)

    return session


throws = session_of("laikago_balancing", 0.4, ball=True)
goals = session_of(SCENARIO, 0.4, lambda _: learned_targets())
commands = session_of("go2_walking", 0.5, guard=True)
ONE_MAP = {"assessment.ensemble_size": 1}
pendulum = session_of("pendulum", 0.5, lambda scenario: learned(scenario, 200), ONE_MAP)


def value_of(session, port):
    return session.loop.GetOutputPort(port).Eval(session.context).copy()


def move(session, goal):
    for name, value in zip(live.AXES, goal, strict=True):
        session.panel.set_value(name, value)


def set_pendulum(session, angle_rad, rate_rad_s):
    plant = session.loop.GetSubsystemByName("pendulum")
    plant_context = plant.GetMyMutableContextFromRoot(session.context)
    plant_context.SetContinuousState([math.pi + angle_rad, rate_rad_s])


def ticks(session, *clicks, num=1):
    for name in clicks:
        session.panel.click(name)
    for _ in range(num):
        assert session.tick()


@train
def test_a_click_throws_the_ball_of_the_sliders_once(throws):
    ticks(throws)
    assert np.linalg.norm(value_of(throws, "ball_state")[4:6]) > 5  # Far away.
    for name, value in ((live.MASS, 2.0), (live.SPEED, 4.0), (live.DIRECTION, 90.0)):
        throws.panel.set_value(name, value)
    ticks(throws, live.THROW)
    before = value_of(throws, "ball_state")
    assert before[-3:-1] == pytest.approx([0.0, 4.0], abs=1e-6)
    assert throws.panel.status.note == "ball of 2 kg at 4 m/s towards 90°"
    ticks(throws)
    after = value_of(throws, "ball_state")
    assert after[5] - before[5] == pytest.approx(4.0 * TICK_S, rel=0.05)


@train
def test_a_robot_that_has_fallen_is_stood_up_again_after_a_while(throws):
    plant, robot = throws.loop.plant, throws.loop.robot_instance
    plant_context = plant.GetMyMutableContextFromRoot(throws.context)
    state = plant.GetPositionsAndVelocities(plant_context, robot)
    state[6] = 0.12  # The base, on the ground.
    plant.SetPositionsAndVelocities(plant_context, robot, state)
    throws.tick()
    assert throws.has_fallen
    assert throws.panel.status.state == "fallen"
    for _ in range(round(SHOWN_S / TICK_S) + 1):
        throws.tick()
    assert not throws.has_fallen
    assert throws.context.get_time() <= 2 * TICK_S


@train
def test_stop_ends_a_session_that_runs_in_real_time(throws, monkeypatch):
    tick, results = throws.tick, []

    def tick_and_stop_after_ten():
        results.append(tick())
        if len(results) == 10:
            throws.panel.click(STOP)
        return results[-1]

    monkeypatch.setattr(throws, "tick", tick_and_stop_after_ten)
    begin_s = time.perf_counter()
    throws.run()
    assert len(results) == 10
    assert throws.panel.is_stopped
    # Paced by the clock.
    assert time.perf_counter() - begin_s >= 0.9 * throws.context.get_time()


@train
def test_the_robot_stays_in_the_middle_of_the_picture(throws, monkeypatch):
    moved, camera, context = {}, throws._camera, throws.context
    spy = SimpleNamespace(
        SetTransform=lambda path, X, time_s: moved.update({path: X.translation()})
    )
    monkeypatch.setattr(camera, "meshcat", spy)
    camera._target = camera._target + [1.3, -0.7]  # As after a step.
    base = value_of(throws, "plant_state")[4:6]
    camera.follow(context)
    assert np.linalg.norm(base + moved["/drake"][:2]) > 1
    for _ in range(20):
        camera._time_s -= TICK_S  # As if the simulation had gone on.
        camera.follow(context)
    assert base + moved["/drake"][:2] == pytest.approx([0, 0], abs=0.02)
    assert np.abs(moved["/Grid"][:2]).max() <= 0.3


@train
def test_a_goal_is_judged_where_it_is_moved_and_go_names_an_accepted_one_nearby(goals):
    move(goals, NEAR)
    assert not goals.tick()
    assert goals.verdict.is_accepted
    assert goals.panel.status.state == "accepted"
    move(goals, FAR)
    assert not goals.tick()
    assert goals.panel.status.state.startswith("refused")
    goals.panel.click(GO)
    assert not goals.tick()
    distance_cm = 100 * np.linalg.norm(goals.nearest.goal - goals.verdict.goal)
    assert f"accepted {distance_cm:.0f} cm away" in goals.panel.status.note
    assert goals.context.get_time() == 0.0


@train
@pytest.mark.parametrize(("goal", "button"), [(NEAR, GO), (FAR, live.FORCE)])
def test_the_robot_goes_to_an_accepted_goal_or_by_force_to_any(goals, goal, button):
    move(goals, goal)
    ticks(goals, button)
    assert goals.context.get_time() == pytest.approx(TICK_S)
    before = np.linalg.norm(value_of(goals, "output") - goal)
    ticks(goals, num=30)
    assert np.linalg.norm(value_of(goals, "output") - goal) < before - 0.02
    goals.panel.click(START)
    assert not goals.tick()
    assert goals.context.get_time() == 0.0


@train
def test_keys_change_the_command_within_the_range_of_training(commands):
    ticks(commands, "Faster", "Turn left")
    high = commands.loop.target_box[1]
    np.testing.assert_allclose(commands.command, high * [1 / 8, 0.0, 1 / 8])
    for _ in range(8):
        ticks(commands, "Faster")
    assert commands.command[0] == high[0]
    ticks(commands, live.HALT, num=4)
    np.testing.assert_array_equal(commands.command, np.zeros(3))
    np.testing.assert_allclose(value_of(commands, "desired_preview"), 0.0, atol=1e-9)


@train
def test_a_push_moves_the_robot(commands):
    ticks(commands, num=3)
    before = value_of(commands, "output")
    ticks(commands, PUSH, num=5)
    assert np.linalg.norm((value_of(commands, "output") - before)[:2]) > 0.5
    assert "pushed with" in commands.panel.status.note


@train
def test_the_verdict_is_that_of_the_probability(pendulum):
    states = set()
    for tick in range(150):
        if tick % 50 == 20:
            set_pendulum(pendulum, 0.4, 0.8)  # Beyond what the motor holds.
        assert pendulum.tick()
        assert pendulum.panel.probability == value_of(pendulum, "safety_probability")[0]
        last = pytest.approx(pendulum.panel.probability, abs=0.001)
        assert pendulum.panel.curve()[-1] == (0.0, last)
        status = pendulum.panel.status
        if not pendulum.cause:
            is_known = pendulum.panel.belief[2] <= 0.65  # Half of it is from empty cells.
            refused = "unsafe" if is_known else "don't know"
            assert status.state == ("safe" if pendulum.panel.probability >= 0.5 else refused)
            assert status.tone == (status.state if is_known else "plain")
            states.add(status.state)
    assert {"safe", "unsafe"} <= states


@train
def test_an_alarm_of_the_monitor_is_shown_with_its_cause(pendulum):
    ticks(pendulum, num=10)
    assert "monitor" not in pendulum.panel.status.note
    monitor = pendulum.loop.GetSubsystemByName("safety_assessor").monitor
    always = dataclasses.replace(pendulum.assessment.detector_, alarm_level=-1.0)
    monitor_context = monitor.GetMyMutableContextFromRoot(pendulum.context)
    monitor.adopt(monitor_context, SimpleNamespace(detector_=always))
    ticks(pendulum, num=10)
    cause = pendulum.loop.GetOutputPort("alarm_cause").Eval(pendulum.context)
    assert cause
    assert pendulum.panel.status.note == f"monitor: {cause}"


@train
@pytest.mark.parametrize(
    ("state", "shown_after_s", "cause"), [((0.0, 0.0), 2.0, ""), ((0.59, 10.0), TICK_S, "front")]
)
def test_the_end_of_an_episode_is_shown_until_the_next_start(pendulum, state, shown_after_s, cause):
    set_pendulum(pendulum, *state)
    ticks(pendulum, num=round(shown_after_s / TICK_S))
    for _ in range(round(SHOWN_S / TICK_S) - 1):
        assert pendulum.cause == cause
        pendulum.tick()
    ticks(pendulum, num=3)
    assert pendulum.context.get_time() < 4 * TICK_S
    assert not pendulum.cause


@train
@pytest.mark.parametrize(("failure", "why"), [("raise", "the solver failed"), ("nan", "finite")])
def test_a_simulation_that_fails_is_shown_and_the_next_begins(meshcat, failure, why):
    scenario = quick(gliding(failure=failure, speed_m_s=4.0))
    loop = scenario.make_loop(assessment=learned(scenario), meshcat=meshcat)
    session = LiveSession(loop, meshcat, threshold=0.5)
    while session.tick():
        pass
    num_waits = 1
    while not session.tick():
        assert session.panel.status.state == "the simulation failed"
        assert why in session.panel.status.note
        num_waits += 1
    assert num_waits * live.BREAK_S == pytest.approx(SHOWN_S, abs=2 * live.BREAK_S)
    assert session.context.get_time() == pytest.approx(TICK_S)
    loop.mass.parameters.fails_at_start = True
    session = LiveSession(loop, meshcat, threshold=0.5)
    assert session.panel.status.note == "no start"
    loop.mass.parameters.fails_at_start = False
    ticks(session, START)


@train
def test_a_task_is_pushed_by_a_button(meshcat):
    scenario = quick(gliding())
    loop = Pushed(scenario, assessment=learned(scenario))
    session = LiveSession(loop, meshcat, threshold=0.5)
    ticks(session, PUSH)
    assert value_of(session, "state")[1] >= 2.0


def test_only_this_machine_reaches_a_viewer():
    viewer = open_viewer()
    lines = Path("/proc/net/tcp").read_text().splitlines()
    listening = {line.split()[1] for line in lines if " 0A " in line}
    assert f"0100007F:{viewer.port():04X}" in listening
    assert f"00000000:{viewer.port():04X}" not in listening
