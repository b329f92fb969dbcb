from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from cart_episodes import make_info
from drake_safety import load_assessment, load_scenario, run_episode
from drake_safety.learning.assessment import AdaptationParameters
from drake_safety.simulation import online_adaptation
from drake_safety.simulation.feedback import AddFeedbackRecorder
from drake_safety.simulation.online_adaptation import OnlineAdaptation
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.systems.feedback_recorder import FeedbackRecorder

pytestmark = pytest.mark.train

STEP_S, NUM_STEPS = 0.1, 4
INFO = make_info(step_s=STEP_S, constraint_names=["edge"], state_names=["x"], feature_names=[])
PORTS = {"state": 1, "output": 1, "desired_output": 1, "desired_preview": 2, "plant_state": 2}


class Prior:
    """An assessment whose adaptations say how many pairs of episodes they are of."""

    detector_ = SimpleNamespace(step_s=0.05)

    def __init__(self, **settings):
        self.parameters = SimpleNamespace(adaptation=AdaptationParameters(**settings))
        self.motions = []

    def adapt(self, feedback, *, motions=None):
        self.motions.append(motions)
        return len(feedback)


class Watching:
    """A change monitor that waits, and sees NaN, for a while."""

    def GetMyContextFromRoot(self, root):
        return root

    def is_held(self, context):
        return 0.58 < context.get_time() < 0.72

    def row(self, context):
        time_s = context.get_time()
        return np.array([np.nan if 1.08 < time_s < 1.12 else time_s])


def run(duration_s, capacity=400, prior=None, watching=None, **settings):
    builder = DiagramBuilder()
    recorder = builder.AddSystem(
        FeedbackRecorder(INFO, num_steps=NUM_STEPS, plant_state_size=2, watch_period_s=STEP_S)
    )
    for name, size in (PORTS | {"safe": 1, "margins": 1, "features": 0}).items():
        source = builder.AddSystem(ConstantVectorSource(np.ones(size)))
        builder.Connect(source.get_output_port(), recorder.GetInputPort(name))
    diagram = builder.Build()
    adopted = []
    assessor = SimpleNamespace(
        monitor=watching,
        GetMyMutableContextFromRoot=lambda root: root,
        adopt=lambda context, adapted: adopted.append((context.get_time(), adapted)),
    )

    prior = prior or Prior(**settings)
    adaptation = OnlineAdaptation(None, prior, recorder, assessor, capacity=capacity)
    simulator = Simulator(diagram)
    with pytest.MonkeyPatch.context() as patched:

        def pairs(_, recorder, windows):
            return [SimpleNamespace(actual=window.episode) for window in windows]

        patched.setattr(online_adaptation, "pair_windows", pairs)
        adaptation.advance(simulator, duration_s)
    return adaptation, adopted


@pytest.mark.parametrize(("interval", "duration_s", "numbers"), [(2, 2.05, [2, 4]), (1, 0.35, [])])
def test_every_k_u_sets_the_assessor_adopts_what_all_feedback_has_shown(
    interval, duration_s, numbers
):
    # Windows of four steps.
    adaptation, adopted = run(duration_s, update_interval=interval)
    assert len(adaptation.feedback) == duration_s // 0.4
    assert [adapted for _, adapted in adopted] == adaptation.adapted == numbers
    # At the last row of a window, and not within a step of the simulator.
    times = [0.4 * number for number in numbers]
    assert [time_s for time_s, _ in adopted] == pytest.approx(times)


def test_the_monitor_learns_of_the_motion_that_it_saw():
    prior = Prior(update_interval=4)
    run(1.65, prior=prior, watching=Watching())
    (motions,) = prior.motions
    expected = [np.arange(1, 12), np.arange(15, 22), np.arange(23, 33)]
    for found, steps in zip(motions, expected, strict=True):
        np.testing.assert_allclose(found[:, 0], 0.05 * steps, atol=1e-9)


def test_the_newest_feedback_is_kept_so_that_a_long_simulation_needs_no_more_memory():
    adaptation, adopted = run(4.05, capacity=3, update_interval=1)
    # Ten windows, the last three of which are kept.
    assert len(adopted) == 10
    assert [one.actual.index for one in adaptation.feedback] == [7, 8, 9]
    assert adaptation.adapted == [3] * 8  # Of the newest updates.
    assert adaptation.num_updates == 10


def test_laikago_adapts_while_it_moves_as_it_would_from_the_same_feedback_afterwards(monkeypatch):
    scenario = load_scenario("laikago_balancing")
    prior = load_assessment("laikago_balancing", "paper")
    prior.parameters.adaptation.update_interval = 2
    builder = DiagramBuilder()
    loop = builder.AddSystem(
        scenario.make_loop("payload", assessment=prior, recovery=False, ball=False)
    )
    recorder = AddFeedbackRecorder(builder, loop)
    simulator = Simulator(builder.Build())
    assessor = loop.GetSubsystemByName("safety_assessor")
    adapt = mock.Mock(side_effect=prior.adapt)
    monkeypatch.setattr(prior, "adapt", adapt)
    online = OnlineAdaptation(scenario, prior, recorder, assessor)
    root = simulator.get_mutable_context()
    for index in range(3):
        loop.reset(root, episode_rng(7, index))
        simulator.Initialize()
        online.advance(simulator, scenario.episode_duration_s + 0.5 * scenario.control_period_s)
    alone = scenario.make_loop("payload", ball=False)
    for index in range(3):
        # A loop in a diagram begins and moves as it does alone. One that falls may come back into
        # the safe set, where another window begins.
        episode = run_episode(alone, index, seed=7)
        start = episode.true_state[0]
        (same,) = (
            one.actual for one in online.feedback if np.allclose(one.actual.true_state[0], start)
        )
        rows = len(same.true_state) - 1
        np.testing.assert_allclose(same.true_state[:-1], episode.true_state[:rows], atol=1e-9)
        assert same.is_safe == episode.is_safe
        motions = adapt.call_args.kwargs["motions"]
        if index < len(motions):
            # Some of the monitor's rows are those of an episode, which may end between two.
            every = round(scenario.step_s / prior.detector_.step_s)
            seen = motions[index][every - 1 :: every, : episode.state.shape[1]]
            rows = min(len(seen), len(episode.state) - 2)
            np.testing.assert_allclose(seen[:rows], episode.state[1 : rows + 1], atol=1e-9)
    assert len(online.adapted) == len(online.feedback) // 2 > 0
    expected = adapt(online.feedback[: 2 * len(online.adapted)])
    np.testing.assert_array_equal(online.adapted[-1].beliefs_, expected.beliefs_)
    context = assessor.assessor.GetMyContextFromRoot(root)
    learned = assessor.assessor.GetOutputPort("learned").Eval(context)
    np.testing.assert_array_equal(learned["beliefs"], expected.beliefs_)
    assert not np.array_equal(expected.beliefs_, prior.beliefs_)
