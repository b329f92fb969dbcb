import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_safety.systems import feedback_recorder
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from system_doubles import INFO, STEP_S
from toy_tasks import declare_outputs

WATCH_S, NUM_STEPS = 0.01, 5


class Drift(LeafSystem):
    """x of a mass at constant speed; it is safe while |x| < 1."""

    def __init__(self):
        super().__init__()
        self.DeclareContinuousState(2)
        ports = {
            "state": lambda x, v: [x],
            "true_state": lambda x, v: [x + 10.0],
            "output": lambda x, v: [x, 0.0, 0.0],
            "desired_output": lambda x, v: [0.0, 0.0, 0.0],
            "desired_preview": lambda x, v: np.zeros(9),
            "features": lambda x, v: [1.0 - x],
            "margins": lambda x, v: [1.0 - x, 1.0 + x],
            "safe": lambda x, v: [float(abs(x) < 1.0)],
            "plant_state": lambda x, v: [x, v],
            "recovery_active": lambda x, v: [float(0.2 < x < 0.3)],
        }
        sized = {name: (len(calc(0.0, 0.0)), calc) for name, calc in ports.items()}
        declare_outputs(
            self, sized, lambda context: context.get_continuous_state_vector().CopyToVector()
        )

    def DoCalcTimeDerivatives(self, context, derivatives):
        v = context.get_continuous_state_vector()[1]
        derivatives.get_mutable_vector().SetFromVector([v, 0.0])


class Running:
    """A drift with a recorder beside it."""

    def __init__(self, x, v, without=("recovery_active",), **options):
        builder = DiagramBuilder()
        self.drift = builder.AddSystem(Drift())
        options = {"num_steps": NUM_STEPS, "plant_state_size": 2, **options}
        self.recorder = builder.AddSystem(FeedbackRecorder(INFO, watch_period_s=WATCH_S, **options))
        for i in range(self.recorder.num_input_ports()):
            port = self.recorder.get_input_port(i)
            if port.get_name() not in without:
                builder.Connect(self.drift.GetOutputPort(port.get_name()), port)
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.set(x, v)

    def set(self, x, v):
        self.drift.GetMyMutableContextFromRoot(self.root).SetContinuousState([x, v])

    def advance(self, time_s):
        self.simulator.AdvanceTo(time_s)
        return self

    @property
    def context(self):
        return self.recorder.GetMyMutableContextFromRoot(self.root)

    def take(self):
        return self.recorder.take_windows(self.context)


def test_a_window_is_safe_after_its_steps_and_the_next_begins_with_its_last_row():
    first, second = Running(0.0, 0.5).advance(2 * NUM_STEPS * STEP_S + 0.001).take()
    for window, start in ((first, 0.0), (second, NUM_STEPS * STEP_S)):
        episode = window.episode
        assert episode.is_safe
        assert window.start_time_s == pytest.approx(start)
        np.testing.assert_allclose(episode.time_s, STEP_S * np.arange(NUM_STEPS + 1))
        np.testing.assert_allclose(episode.state[:, 0], 0.5 * (start + episode.time_s))
        np.testing.assert_allclose(episode.true_state, episode.state + 10.0)
        np.testing.assert_allclose(window.plant_state, [0.5 * start, 0.5], atol=1e-12)
    assert [first.episode.index, second.episode.index] == [0, 1]


def test_a_window_ends_unsafe_where_the_safe_set_is_left_and_names_why():
    running = Running(0.9, 1.0).advance(0.2)
    (window,) = running.take()
    episode = window.episode
    assert not episode.is_safe
    assert episode.cause == "right"
    # x = 1 at 0.1 s: seen there, recorded at the next row.
    np.testing.assert_allclose(episode.time_s, [0.0, 0.04, 0.08, 0.12])
    assert episode.margins[-1, 0] < 0.0
    # No new window begins outside the safe set.
    assert running.advance(2.0).take() == []
    running.set(0.0, 0.0)
    (window,) = running.advance(2.3).take()
    assert window.start_time_s == pytest.approx(2.04, abs=1e-6)
    assert window.episode.is_safe


def test_leaving_for_less_than_a_step_is_noticed():
    running = Running(0.985, 1.0).advance(0.025)
    running.set(0.5, 0.0)
    (window,) = running.advance(0.2).take()
    assert not window.episode.is_safe
    np.testing.assert_allclose(window.episode.time_s, [0.0, 0.04])
    assert window.episode.margins[-1, 0] == pytest.approx(-0.005, abs=0.006)


def test_windows_with_recovery_are_dropped_as_their_twins_have_none():
    # x = 0.5 t: recovery from 0.4 s to 0.6 s.
    windows = Running(0.0, 0.5, without=()).advance(1.05).take()
    starts = [window.start_time_s for window in windows]
    np.testing.assert_allclose(starts, [0.0, 0.2, 0.6, 0.8], atol=1e-6)
    assert all(len(window.episode.time_s) == NUM_STEPS + 1 for window in windows)
    without = Running(0.0, 0.5).advance(1.05).take()
    assert [window.start_time_s for window in without] != pytest.approx(starts)


@pytest.mark.parametrize(("x", "v", "until_s"), [(0.0, 0.0, 0.1), (0.985, 1.0, 0.03)])
def test_a_jump_in_time_drops_the_open_window_and_forgets_what_was_left(x, v, until_s):
    running = Running(x, v).advance(until_s)  # The second leaves at 0.02 s, seen by no row.
    running.set(0.0, 0.0)
    running.root.SetTime(0.0)
    running.simulator.Initialize()
    (window,) = running.advance(NUM_STEPS * STEP_S + 0.001).take()
    assert window.start_time_s == 0.0
    assert len(window.episode.time_s) == NUM_STEPS + 1
    assert window.episode.is_safe


def test_taking_empties_and_of_what_nobody_takes_the_newest_are_kept(monkeypatch):
    monkeypatch.setattr(feedback_recorder, "_MOST_WINDOWS", 2)
    running = Running(0.0, 0.0).advance(4 * NUM_STEPS * STEP_S + 0.001)
    assert running.recorder.GetOutputPort("num_finished").Eval(running.context)[0] == 4
    assert [window.episode.index for window in running.take()] == [2, 3]
    assert running.take() == []
    (window,) = running.advance(5 * NUM_STEPS * STEP_S + 0.001).take()
    assert window.episode.index == 4


def test_contexts_do_not_share_what_they_record():
    running = Running(0.1, 0.0, without=["true_state", "recovery_active"]).advance(0.1)
    clone = running.root.Clone()
    (window,) = running.advance(0.201).take()
    np.testing.assert_array_equal(window.episode.true_state, window.episode.state)
    other = running.recorder.GetMyContextFromRoot(clone)
    assert len(running.recorder.recording(other).rows) == 3
