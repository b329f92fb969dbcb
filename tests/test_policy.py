"""Policies as data: observation, action, gait clock, and networks that do not fit."""

import math
import re
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.policies.policy import (
    CommandLimits,
    GaitClock,
    ObservationTerm,
    Policy,
    PolicyParameters,
    WholeHistory,
    observation_term,
    with_policy,
)
from drake_safety.policies.policy_network import (
    PolicyNetwork,
    load_network,
    network_files,
    read_metadata,
)
from drake_safety.robots.robot_model import JointGains, RobotModel, by_pattern
from policy_networks import save_network, save_onnx, save_script

try:
    import torch
except ImportError:
    torch = None

JOINTS = ["hip", "knee", "tail"]  # The robot's; the policy moves two, in another order.
TERMS = ["base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos_rel", "last_action"]


def terms(*names, **options):
    return [ObservationTerm(name=name, **options) for name in names]


def saved(tmp_path, num_inputs=13, num_outputs=2):
    return save_network(tmp_path / f"net_{num_inputs}_{num_outputs}.pt", num_inputs, num_outputs)


def parameters(tmp_path, **changed):
    given = {
        "network": str(saved(tmp_path)),
        "joints": ["knee", "hip"],
        "default_positions": {"knee": 0.5},
        "action_scale": {".*": 0.25},
        "gains": {".*": JointGains(stiffness=20.0, damping=0.5)},
        "observation": terms(*TERMS),
    }
    return PolicyParameters(**(given | changed))


def policy(tmp_path, **changed):
    return Policy(parameters(tmp_path, **changed), JOINTS, robot="r")


def see(made, q=None, v=None, command=(0.1, 0.2, 0.3)):
    q = np.array([1.0, 0, 0, 0, 0, 0, 0.4, 0.1, 0.9, 2.0]) if q is None else q
    v = np.arange(9.0) if v is None else v
    return made.see(q, v, np.array(command), np.array([3.0, 4.0]), made.initial_phases)


@pytest.mark.train
def test_joints_are_in_the_policys_order_relative_to_zero_action(tmp_path):
    made = policy(tmp_path)
    seen = see(made)
    np.testing.assert_allclose(seen.positions, [0.9 - 0.5, 0.1])
    np.testing.assert_allclose(seen.rates, [7.0, 6.0])
    np.testing.assert_allclose(made.targets(np.array([1.0, 2.0])), [0.5, 0.5 + 0.25, 0.0])


@pytest.mark.train
def test_the_observation_has_its_terms_in_order_scaled_and_clipped(tmp_path):
    observed = terms(*TERMS)
    observed[0].scale, observed[4].clip = [0.25], 3.5
    made = policy(tmp_path, observation=observed)
    observation = made.observe(see(made), np.full(13, np.nan))
    expected = [0, 0.25, 0.5, 0, 0, -1, 0.1, 0.2, 0.3, 0.4, 0.1, 3.0, 3.5]
    np.testing.assert_allclose(observation, expected)


WHOLE, DOWN = terms("last_action", "projected_gravity"), [0, 0, -1]


@pytest.mark.train
@pytest.mark.parametrize(
    ("observed", "history", "first", "second"),
    [
        (terms("last_action", history=3), None, [3] * 3, [3, 3, 5]),
        (WHOLE, {"ages": [2, 1, 0]}, [3, *DOWN] * 3, [3, *DOWN] * 2 + [5, *DOWN]),
        (WHOLE, {"ages": [0, 1, 2]}, [3, *DOWN] * 3, [5, *DOWN] + [3, *DOWN] * 2),
        (WHOLE, {"ages": [0, 1, 2], "by": "term"}, [3] * 3 + DOWN * 3, [5, 3, 3] + DOWN * 3),
    ],
)
def test_a_history_begins_with_what_is_seen_first_and_is_laid_out_as_stated(
    tmp_path, observed, history, first, second
):
    options = {} if history is None else {"history": WholeHistory(**history)}
    network = str(saved(tmp_path, len(first), 1))
    made = policy(tmp_path, joints=["knee"], network=network, observation=observed, **options)
    seen, last = see(made), np.full(len(first), np.nan)
    for action, expected in ((3.0, first), (5.0, second)):
        seen.action = np.array([action])
        last = made.observe(seen, last)
        np.testing.assert_allclose(last, expected)


@pytest.mark.train
def test_the_gait_clock_runs_once_a_period_and_commands_change_slowly(tmp_path):
    limits = CommandLimits(change=[0.05, 0.04, 0.1])
    made = policy(tmp_path, gait=GaitClock(period_s=1.0), command=limits)
    next_command = made.next_command(np.zeros(3), np.array([1.0, -1.0, 0.02]))
    np.testing.assert_allclose(next_command, [0.05, -0.04, 0.02])
    walking, standing = np.array([0.5, 0, 0]), np.zeros(3)
    phases = made.initial_phases
    np.testing.assert_allclose(np.abs(phases), [0, math.pi])
    for _ in range(50):
        phases = made.next_phases(phases, walking)
    np.testing.assert_allclose(np.cos(phases), [1, -1], atol=1e-9)
    np.testing.assert_allclose(made.next_phases(phases, standing), [math.pi, math.pi])


@pytest.mark.train
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"joints": ["knee", "elbow"]}, r"lacks \['elbow'\]; it has \['hip', 'knee', 'tail'\]"),
        ({"joints": ["knee"]}, r"takes no observation of 11 entries .*joint_pos_rel 1"),
        ({"gains": {}, "observation": []}, r"'gains' \[N·m/rad\] of joints .*; 'observation', the"),
        ({"observation": terms("lidar")}, r"unknown term 'lidar'; registered"),
        ({"observation": terms("last_action", scale=[1.0] * 3)}, "has 2 entries; got 3 scales"),
        ({"observation": terms("joint_pos_rel", joints=["ear"])}, r"has joints \['ear'\]"),
        ({"default_positions": {"hip": 0.1, "ear": 0.1}}, "yaml's default_positions pattern 'ear'"),
        ({"action_scale": {".*": 0.1, "ear": 0.1}}, "yaml's action_scale pattern 'ear'; it has"),
        ({"gains": {".*": JointGains(), "ear": JointGains()}}, "yaml's gains pattern 'ear'; it"),
        ({"rotor_inertia": {"ear": 0.01}}, r"yaml's rotor_inertia pattern 'ear'; it has \['hip'"),
    ],
)
def test_policy_that_does_not_fit_its_robot_is_refused(tmp_path, changed, message):
    with pytest.raises(ValueError, match=message):
        policy(tmp_path, **changed)


WEIGHTS = ["policy.onnx.data", "weights/W", "weights/more/R"]


@pytest.mark.train
def test_external_weights_are_files_of_the_network_below_its_folder(tmp_path):
    path = save_onnx(tmp_path / "policy.onnx", 4, 2, memory=[("h_in", "h_out")], files=WEIGHTS)
    assert set(network_files(path)) == {path, *(tmp_path / name for name in WEIGHTS)}
    load_network(path)
    (tmp_path / WEIGHTS[1]).unlink()
    for read in (network_files, load_network):
        with pytest.raises(ValueError, match=r"are in .*'weights/W', .* there is no weights/W$"):
            read(path)
    (tmp_path / "inner").mkdir()
    path = save_onnx(tmp_path / "inner" / "p.onnx", 4, 2, files=["data"])
    path.write_bytes(path.read_bytes().replace(b"\x04data", b"\x04../x"))
    (tmp_path / "x").write_bytes(b"0" * 100)
    with pytest.raises(ValueError, match=r"there is no \.\./x"):
        network_files(path)


@pytest.mark.train
def test_a_term_of_ones_own_is_one_function(tmp_path):
    observation_term("test_twice_the_height")(lambda seen: 2.0 * seen.action)
    observed = terms("test_twice_the_height")
    made = policy(tmp_path, network=str(saved(tmp_path, 2)), observation=observed)
    np.testing.assert_allclose(made.observe(see(made), np.full(2, np.nan)), [6.0, 8.0])
    with pytest.raises(ValueError, match="already registered"):
        observation_term("last_action")(lambda seen: seen.action)


NAMES = "observation_names"
TWO = {"joint_names": "a,b"}


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        # Isaac Lab and mjlab: words and numbers between commas, Holosoma: JSON; one for all.
        (TWO | {"joint_stiffness": "20.0,30.0"}, {"stiffness": {"a": 20.0, "b": 30.0}}),
        ({"dof_names": '["a+b"]', "kp": "[1.5]"}, {"joints": ["a+b"], "stiffness": {r"a\+b": 1.5}}),
        (TWO | {"joint_damping": "{'a.*': 0.5}"}, {"damping": {"a.*": 0.5}}),
        (
            {NAMES: "command,height_scan"}
            | {"observation_terms_scale": "2.000;0.500,4.000"}
            | {"observation_terms_history_length": "0.000,3.000"}
            | {"observation_terms_clip": "-inf;inf,-5.000;5.000"},
            {
                "observation": [
                    {"name": "velocity_commands", "scale": [2.0, 0.5]}
                    | {"clip": math.inf, "history": 1},
                    {"name": "height_scan", "scale": [4.0], "clip": 20.0, "history": 3},
                ]
            },
        ),
    ],
)
def test_metadata_are_read_as_exporters_write_them(raw, expected):
    metadata = read_metadata(raw)
    assert {name: getattr(metadata, name) for name in expected} == expected
    assert metadata.unread == []


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"dof_names": '["a"]', "kp": "[1, 2]"}, r"'stiffness' do not fit the joints \['a'\]"),
        ({NAMES: "x", "observation_terms_clip": "-1;2"}, r"'clip' .* got \['-1;2'\]"),
    ],
)
def test_metadata_that_do_not_fit_are_named_and_left_out(raw, message):
    metadata = read_metadata(raw)
    assert re.search(message, *metadata.unread)
    assert not metadata.action_scale and not metadata.stiffness
    assert all(term.keys() == {"name"} for term in metadata.observation)


@pytest.mark.train
def test_what_the_metadata_say_is_used_where_nothing_is_stated(tmp_path):
    said = {"joint_names": "knee,hip", "action_scale": "0.25", "joint_stiffness": "20,30"}
    said |= {"joint_damping": "0.5", "default_joint_pos": "{'knee': 0.5}"}
    network = save_onnx(tmp_path / "p.onnx", 13, 2, metadata=said)
    unstated = {"joints": [], "default_positions": {}, "action_scale": {}, "gains": {}}
    made = policy(tmp_path, network=str(network), **unstated)
    assert made.joint_names == ["knee", "hip"]
    np.testing.assert_allclose(made.action_scale, [0.25, 0.25])
    np.testing.assert_allclose(made.default_positions, [0.0, 0.5, 0.0])
    assert made.gains["hip"] == JointGains(stiffness=30.0, damping=0.5)
    # An entry that does not fit is an error only where nothing else is stated.
    network = save_onnx(tmp_path / "q.onnx", 13, 2, metadata=said | {"action_scale": "1,2,3"})
    with pytest.raises(ValueError, match=r"'action_scale' \[rad\] of joints .* got \[1, 2, 3\]"):
        policy(tmp_path, network=str(network), **unstated)
    network = save_onnx(tmp_path / "r.onnx", 13, 2, metadata=said | {"joint_damping": "-1"})
    with pytest.raises(ValueError, match=r"gains of joint 'knee' in its metadata: 'damping' must"):
        policy(tmp_path, network=str(network), **unstated)


@pytest.mark.parametrize("names", [["leg.hip", "legxhip"], ["(l)", "l"], ["a|b", "a"]])
def test_names_of_joints_are_no_patterns(names):
    made = SimpleNamespace(
        default_positions=np.array([0.1, 0.2]),
        gains={name: JointGains(stiffness=k) for k, name in enumerate(names, 1)},
        parameters=PolicyParameters(),
    )
    robot = with_policy(RobotModel(), made, names)
    assert [by_pattern(robot.posture, name, "posture", "r") for name in names] == [0.1, 0.2]
    assert [robot.gains_of(name).stiffness for name in names] == [1, 2]


def test_a_network_whose_actions_are_not_finite_for_some_observations_is_refused():
    def evaluate(batch, parts):
        return np.where(np.abs(batch[:, :1]) > 0.5, np.nan, batch[:, :2]), {}

    with pytest.raises(ValueError, match="p: the network returns 2 of 2 actions that are not"):
        PolicyNetwork(None, evaluate, (9, 2)).check("p", 9, 2, "terms")


@pytest.mark.train
def test_a_term_has_the_joints_that_it_names_also_those_that_are_not_moved(tmp_path):
    observed = terms("joint_pos_rel", "joint_vel_rel", joints=["tail", "hip"])
    made = policy(tmp_path, network=str(saved(tmp_path, 4)), observation=observed)
    observation = made.observe(see(made), np.full(4, np.nan))
    np.testing.assert_allclose(observation, [2.0, 0.1, 8.0, 6.0])


class Last(torch.nn.Module if torch else object):
    def forward(self, x):
        return x[:, -1, :2]


@pytest.mark.train
@pytest.mark.parametrize(
    ("shape", "width"),
    [([1, 5, 9], 45), (["batch", "time", 9], None), ("script", None)],
)
def test_a_history_may_be_an_axis_of_its_own(tmp_path, shape, width):
    if shape == "script":
        path = save_script(tmp_path / "p.pt", Last())
    else:
        path = save_onnx(tmp_path / "p.onnx", 45, 2, shape=shape)
    network = load_network(path)
    assert network.widths[0] == width
    network.check("p", 45, 2, "terms", 5)
    action, _ = network(np.arange(45.0), network.initial_memory)
    assert action.shape == (2,)
    if shape == "script":
        np.testing.assert_array_equal(action, [36.0, 37.0])


class Two(torch.nn.Module if torch else object):
    def forward(self, x):
        return x[:, :2] / 3, x[:, :3]


class OnGpu(torch.nn.Module if torch else object):
    def forward(self, x):
        return x[:, :2] + torch.zeros([1], device=torch.device("cuda:0"))


@pytest.mark.train
def test_the_first_of_two_outputs_is_the_action_in_double_precision(tmp_path):
    module = Two().double()
    module.register_parameter("unused", torch.nn.Parameter(torch.zeros(1, dtype=torch.double)))
    network = load_network(save_script(tmp_path / "p.pt", module))
    network.check("p", 9, 2, "terms")
    assert network.outputs == ["[1, 2]", "[1, 3]"]
    action, _ = network(np.ones(9), np.zeros(0))
    np.testing.assert_array_equal(action, [1 / 3, 1 / 3])
    with pytest.raises(ValueError, match=r"returns 2 actions, .*'\[1, 3\]'\], the first"):
        network.check("p", 9, 3, "terms")
    lost = load_network(save_script(tmp_path / "q.pt", OnGpu()))
    with pytest.raises(ValueError, match=r"\): \w+Error: .*(cuda|CUDA)"):
        lost.check("p", 9, 2, "terms")


@pytest.mark.train
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.onnx", b"no network", "a.onnx: not an ONNX network: "),
        ("a.pt", None, "a.pt: .* does not exist"),
        ("a.pt", "zip", "but a pickle, such as a training checkpoint: export .* TorchScript"),
        ("a.pth", b"\x80\x02}.", r"got '\.pth', but a pickle"),
    ],
)
def test_a_file_that_is_no_network_is_called_what_it_is(tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("model/data.pkl", "")
    with pytest.raises(ValueError, match=message):
        load_network(path)
