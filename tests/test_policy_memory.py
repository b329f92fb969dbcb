"""Recurrent policies: what they remember is in the Context, and nowhere else."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from cart_episodes import assert_identical
from drake_safety import load_scenario, run_episode, run_episodes
from drake_safety.learning.segments import Episodes
from drake_safety.policies.policy_network import load_network
from drake_safety.simulation.feedback import AddFeedbackRecorder, pair_windows, window_start
from legged_robots import edited
from policy_networks import recurrent_module, save_onnx, save_script, walker
from system_doubles import begun

pytestmark = pytest.mark.train
torch = pytest.importorskip("torch")

N_IN, N_OUT, SIZE = 5, 2, 4
LSTM = [("h_in", "h_out"), ("c_in", "c_out")]
OTHER = [("h0", "hn"), ("c0", "cn")]


def script(batch=None, **options):
    module = recurrent_module(N_IN, N_OUT, size=SIZE, **options)
    return lambda path: save_script(path / "p.pt", module, batch)


def onnx(**options):
    return lambda path: save_onnx(path / "p.onnx", N_IN, N_OUT, size=SIZE, **options)


def checked(path):
    network = load_network(path)
    network.check("policy", N_IN, N_OUT, "terms")
    return network


@pytest.mark.parametrize(
    ("save", "num_memories"),
    [
        (script(), 2),
        (script(batch=torch.ones(1, N_IN)), 2),
        (script(is_replaced=True), 2),
        (onnx(), 0),
        (onnx(memory=LSTM), 2),
        (onnx(memory=OTHER, shape=[1, "time", N_IN]), 2),
    ],
)
def test_a_network_remembers_only_what_it_is_given(tmp_path, save, num_memories):
    network = checked(save(tmp_path))
    start = network.initial_memory
    np.testing.assert_array_equal(start, np.zeros(num_memories * SIZE))
    observation = np.linspace(-1, 1, N_IN)
    first, memory = network(observation, start)
    second, _ = network(observation, memory)
    assert np.array_equal(first, second) == (num_memories == 0)
    for _ in range(2):  # From any memory, in any order.
        np.testing.assert_array_equal(network(observation, memory)[0], second)
        np.testing.assert_array_equal(network(observation, start)[0], first)
    np.testing.assert_array_equal(checked(network.path)(observation, start)[0], first)


def test_actions_are_those_of_torch_and_onnxruntime(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    observations = np.random.default_rng(0).normal(size=(3, N_IN)).astype(np.float32)
    scripted, network = checked(script()(tmp_path)), checked(onnx(memory=LSTM)(tmp_path))
    module = recurrent_module(N_IN, N_OUT, size=SIZE).eval()
    session = onnxruntime.InferenceSession(str(network.path))
    memory, own = scripted.initial_memory, network.initial_memory
    h = c = np.zeros((1, 1, SIZE), dtype=np.float32)
    for row in observations:
        action, memory = scripted(row, memory)
        with torch.inference_mode():
            expected = module(torch.from_numpy(row[None])).numpy()[0]
        np.testing.assert_allclose(action, expected, rtol=1e-6)
        action, own = network(row, own)
        expected, h, c = session.run(None, {"obs": row[None], "h_in": h, "c_in": c})
        np.testing.assert_allclose(action, expected[0], rtol=1e-6)


class Hidden(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.sums = [0.0]  # Its memory is no buffer.

    def forward(self, x):
        self.sums[0] += float(x.abs().sum())
        return self.sums[0] * x[:, :2]


class Draws(torch.nn.Module):
    def forward(self, x):
        return torch.randn_like(x[:, :2])


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (Hidden, "has a memory that is not read"),
        (Draws, "it draws random numbers"),
        (onnx(memory=[("state", "next")]), r"inputs .*'state \[1, 1, 4\].* pairs .* as h_in and"),
    ],
)
def test_a_memory_of_another_kind_is_refused(tmp_path, network, message):
    is_module = isinstance(network, type)
    path = save_script(tmp_path / "p.pt", network()) if is_module else network(tmp_path)
    with pytest.raises(ValueError, match=message) as refusal:
        checked(path)
    assert "\n" not in str(refusal.value)


@pytest.fixture(scope="module")
def walking(tmp_path_factory):
    """A hexapod that stands by a policy of random weights with a memory."""
    folder = tmp_path_factory.mktemp("walking")
    file = walker(folder, save_script(folder / "policy.pt", recurrent_module(42, 18)))
    edited(file.with_name("policy.yaml"), action_scale={".*": 0.1})
    changes = {"episode_duration_s": 0.4, "assessment": {"horizon": 3}}
    return load_scenario(file, changes | {"parameters.start": {"walked_s": [0.0, 0.2]}})


def test_episodes_are_the_same_for_any_number_of_workers_and_in_any_order(walking):
    episodes = run_episodes(walking, 5, num_workers=2)
    loop = walking.make_loop()
    backwards = [run_episode(loop, index) for index in reversed(range(5))]
    assert_identical(Episodes(episodes.info, backwards[::-1]), episodes)


def windows(scenario):
    """Windows of a robot that walks on, and its recorder."""
    builder = DiagramBuilder()
    loop = builder.AddSystem(scenario.make_loop())
    recorder = AddFeedbackRecorder(builder, loop)
    command = np.array([0.3, 0.0, 0.2])
    simulator, root = begun(builder.Build(), loop.reset_standing, command)
    simulator.AdvanceTo(2.1 * scenario.episode_duration_s)
    return recorder, recorder.take_windows(recorder.GetMyMutableContextFromRoot(root))


def test_a_twin_of_a_window_begins_in_mid_stride_with_the_memory_that_the_policy_has(walking):
    recorder, pieces = windows(walking)
    assert len(pieces) == 2
    loop = walking.make_loop()
    for window in pieces:
        twin = run_episode(loop, start=window_start(loop, window))
        np.testing.assert_allclose(twin.true_state, window.episode.true_state, atol=1e-3)
    assert len(pair_windows(walking, recorder, pieces)) == 2
    bad = replace(pieces[1], controller_memory=np.zeros(3))
    with mock.patch("drake_safety.simulation.feedback.run_episode", side_effect=AssertionError):
        with pytest.raises(ValueError, match="entries of the controller's memory, expected"):
            pair_windows(walking, recorder, [pieces[0], bad])
