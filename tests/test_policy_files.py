"""Policies described in the forms of other projects: read, overridden, or refused with a reason."""

import copy
import math
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from drake_safety.control.policy import Policy
from drake_safety.control.policy_files import load_policy, read_policy_file
from policy_networks import save_network

pytestmark = pytest.mark.train

JOINTS = ["tail", "hip", "knee"]  # The robot's.

# The network's joints are hip and knee; the robot's motors are knee, tail, hip.
DEPLOY = {
    "joint_ids_map": [2, 0],
    "step_dt": 0.02,
    "stiffness": [30.0, 0.0, 20.0],
    "damping": [3.0, 0.0, 2.0],
    "default_joint_pos": [0.1, -0.2],
    "commands": {
        "base_velocity": {
            "ranges": {
                "lin_vel_x": [-0.5, 1.0],
                "lin_vel_y": [-0.3, 0.3],
                "ang_vel_z": [-0.2, 0.2],
                "heading": None,
            }
        }
    },
    "actions": {
        "JointPositionAction": {
            "clip": None,
            "joint_names": [".*"],
            "scale": [0.25, 0.5],
            "offset": [0.1, -0.2],
            "joint_ids": None,
        }
    },
    "observations": {
        "base_ang_vel": {"params": {}, "clip": [-10.0, 10.0], "scale": [0.2] * 3},
        "velocity_commands": {"params": {"command_name": "base_velocity"}, "scale": [1, 1, 2]},
        "joint_pos_rel": {"clip": None, "scale": None, "history_length": 2},
    },
}

CONFIG = {
    "beast/lab": {
        "model_name": "walk.pt",
        "num_observations": 8,
        "observations": ["commands", "dof_pos", "gravity_vec"],
        "observations_history": [0, 1],
        "clip_obs": 50.0,
        "clip_actions_lower": [-8, -8],
        "clip_actions_upper": [8, 8],
        "rl_kp": [20, 30],
        "rl_kd": [0.5, 0.7],
        "fixed_kp": [80, 80],
        "action_scale": 0.25,
        "hip_scale_reduction": 0.5,
        "hip_scale_reduction_indices": [0],
        "commands_scale": [2.0, 2.0, 0.25],
        "dof_pos_scale": 1.0,
        "wheel_indices": [],
    }
}
BASE = {
    "beast": {
        "dt": 0.005,
        "decimation": 4,
        "num_of_dofs": 2,
        "default_dof_pos": [0.1, -0.2],
        "joint_names": ["knee", "hip"],
        "joint_mapping": [1, 0],
    }
}


def dump(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def deploy(folder, change=None, **stated):
    """A policy.yaml that reads a deploy.yaml, in which ``change`` edits a copy of the example."""
    content = copy.deepcopy(DEPLOY)
    if change is not None:
        change(content)
    dump(folder / "params" / "deploy.yaml", content)
    (folder / "exported").mkdir(exist_ok=True)
    save_network(folder / "exported" / "policy.pt", 10, 2)
    stated = {"read": "params/deploy.yaml", "motors": ["knee", "tail", "hip"]} | stated
    return dump(folder / "policy.yaml", stated)


def rl_sar(folder, change=None, lab="lab"):
    """A config.yaml beside its network, with the base.yaml of its robot in a folder above."""
    content = copy.deepcopy(CONFIG)
    if change is not None:
        change(content["beast/lab"])
    dump(folder / "beast" / "base.yaml", BASE)
    config = dump(folder / "beast" / lab / "config.yaml", content)
    save_network(config.parent / "walk.pt", 16, 2)
    return config


def loaded(path):
    robot = SimpleNamespace(joint_names=JOINTS, robot=SimpleNamespace(name="beast"))
    return load_policy(path, robot)


def inputs(policy, action=(0.0, 0.0)):
    """The network's input in a state: joints tail, hip, knee at 9, .4 and .3 rad."""
    q = np.array([1.0, 0, 0, 0, 0, 0, 0.5, 9.0, 0.4, 0.3])
    v = np.array([1.0, 2.0, 300.0, *np.zeros(6)])
    seen = policy.see(q, v, np.array([0.5, 0.1, 0.2]), np.array(action), policy.initial_phases)
    return policy.observe(seen, np.full(sum(policy.sizes), np.nan))


def test_a_deploy_yaml_says_all_but_the_names_of_the_motors(tmp_path):
    policy = loaded(deploy(tmp_path))
    assert isinstance(policy, Policy)
    assert policy.joint_names == ["hip", "knee"]
    gains = [(policy.gains[name].stiffness, policy.gains[name].damping) for name in ("hip", "knee")]
    assert gains == [(20.0, 2.0), (30.0, 3.0)]  # In the motors' order, unlike the rest.
    np.testing.assert_allclose(policy.targets(np.array([1.0, 1.0])), [0.0, 0.35, 0.3])
    # The clip is of values before scaling.
    expected = [0.2, 0.4, 2.0, 0.5, 0.1, 0.4, 0.3, 0.5, 0.3, 0.5]
    np.testing.assert_allclose(inputs(policy), expected)
    assert policy.parameters.period_s == 0.02
    assert policy.parameters.command.lowest == [-0.5, -0.3, -0.2]
    assert policy.parameters.command.highest == [1.0, 0.3, 0.2]
    assert policy.parameters.action_clip == math.inf


def test_what_policy_yaml_states_wins(tmp_path):
    stated = {
        "gains": {".*": {"stiffness": 7.0, "damping": 0.7}},
        "period_s": 0.01,
        "command": {"change": [0.1, 0.1, 0.1]},
        "default_positions": {"hip": 1.0},
    }
    policy = loaded(deploy(tmp_path, lambda content: content.pop("stiffness"), **stated))
    assert {gains.stiffness for gains in policy.gains.values()} == {7.0}
    assert policy.parameters.period_s == 0.01
    assert policy.parameters.command.change == [0.1, 0.1, 0.1]
    assert policy.parameters.command.highest == [1.0, 0.3, 0.2]
    np.testing.assert_allclose(policy.default_positions, [0.0, 1.0, 0.0])


def test_names_may_be_those_of_the_network_in_its_order(tmp_path):
    policy = loaded(deploy(tmp_path, motors=[], joints=["hip", "knee"]))
    assert policy.gains["knee"].stiffness == 30.0


def test_history_of_whole_observations_is_the_oldest_first(tmp_path):
    def change(content):
        content["observations"] = {
            "obs": {
                "use_gym_history": True,
                "joint_pos_rel": {"scale": None, "history_length": 2},
                "last_action": {"scale": None, "history_length": 2},
                "gait_phase": {"params": {"period": 0.8}, "history_length": 2},
            }
        }

    path = deploy(tmp_path, change)
    save_network(tmp_path / "exported" / "policy.pt", 12, 2)
    policy = loaded(path)
    assert policy.parameters.history.ages == [1, 0]
    assert policy.parameters.gait.period_s == 0.8
    sample = [0.3, 0.5, 5.0, 6.0, 0.0, 1.0]
    np.testing.assert_allclose(inputs(policy, (5.0, 6.0)), 2 * sample)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["observations"].update(lidar={}), "unknown observation 'lidar'; registered"),
        (lambda c: c.update(stiffness=[1.0]), "'stiffness' must have an entry for each motor, up"),
        (lambda c: c.update(default_joint_pos=[0.0] * 3), "must have 2 entries; got 3"),
        (lambda c: c.update(camera={}), r"unknown keys \['camera'\]; known are"),
        (lambda c: c.pop("step_dt"), r"has no 'step_dt'; it has \['joint_ids_map'"),
        (lambda c: c.update(joint_ids_map=[0, 0]), "must be different integers"),
        (lambda c: c.update(actions={"JointVelocityAction": {}}), "unknown keys"),
        (
            lambda c: c["actions"]["JointPositionAction"].update(offset=[0.0, 0.0]),
            "offset must equal default_joint_pos",
        ),
        (
            lambda c: c["actions"]["JointPositionAction"].update(clip=[[-1, 1], [-1, 1]]),
            "clip of joint positions must be null",
        ),
        (
            lambda c: c["actions"]["JointPositionAction"].update(joint_ids=[0]),
            "joint_ids must be all 2 joints",
        ),
        (
            lambda c: c["observations"]["base_ang_vel"].update(clip=[-1.0, 2.0]),
            "clip must be symmetric",
        ),
        (
            lambda c: c["observations"]["base_ang_vel"].update(scale=[1.0] * 4),
            "'scale' must have 3 entries; got 4",
        ),
        (
            lambda c: c["observations"].update(use_gym_history=True),
            r"needs terms of one history_length; got \[1, 2\]",
        ),
    ],
)
def test_what_a_deploy_yaml_cannot_say_here_is_refused(tmp_path, change, message):
    path = deploy(tmp_path, change)
    with pytest.raises(ValueError, match=message) as error:
        read_policy_file(path)
    assert "deploy.yaml" in str(error.value)


def test_joints_without_names_are_asked_for_with_those_of_the_robot(tmp_path):
    path = deploy(tmp_path, motors=[])
    with pytest.raises(ValueError, match=r"State in policy.yaml 'motors'.*the robot has \['tail'"):
        loaded(path)
    # Named directly, the file has no policy.yaml that could state them.
    with pytest.raises(ValueError, match="does not name its joints"):
        loaded(tmp_path / "params" / "deploy.yaml")


def test_slices_that_an_exporter_writes_are_read(tmp_path):
    path = deploy(tmp_path)
    file = tmp_path / "params" / "deploy.yaml"
    text = file.read_text()
    for ends, is_all in (("[null, null, null]", True), ("[0, 1, null]", False)):
        tag = "joint_ids: !!python/object/apply:builtins.slice"
        file.write_text(text.replace("joint_ids: null", f"{tag} {ends}"))
        if is_all:
            assert loaded(path).joint_names == ["hip", "knee"]
        else:
            with pytest.raises(ValueError, match="joint_ids must be all 2 joints"):
                loaded(path)
    file.write_text(text.replace("joint_ids: null", "joint_ids: !!python/name:os.system ''"))
    with pytest.raises(ValueError, match="is not YAML"):
        loaded(path)


def test_a_network_is_looked_for_beside_the_file(tmp_path):
    path = deploy(tmp_path)
    (tmp_path / "exported" / "policy.pt").unlink()
    with pytest.raises(ValueError, match="no network beside it, expected one of"):
        read_policy_file(path)
    assert read_policy_file(deploy(tmp_path)).network.name == "policy.pt"


def test_a_config_of_rl_sar_needs_no_policy_yaml(tmp_path):
    config = rl_sar(tmp_path)
    policy = loaded(config)
    assert policy.joint_names == ["hip", "knee"]
    assert policy.gains["knee"].stiffness == 30.0
    np.testing.assert_allclose(policy.action_scale, [0.125, 0.25])
    np.testing.assert_allclose(policy.default_positions, [0.0, 0.1, -0.2])
    assert policy.parameters.action_clip == 8.0
    assert policy.parameters.period_s == pytest.approx(0.02)
    # The whole observation twice, the newest first.
    sample = [1.0, 0.2, 0.05, 0.3, 0.5, 0.0, 0.0, -1.0]
    np.testing.assert_allclose(inputs(policy), 2 * sample)
    assert policy.parameters.history.ages == [0, 1]
    files = read_policy_file(config).files
    assert [path.name for path in files] == ["config.yaml", "base.yaml"]


def test_the_robots_file_may_be_two_folders_up(tmp_path):
    assert loaded(rl_sar(tmp_path, lab="lab/walk")).joint_names == ["hip", "knee"]


def test_history_by_term_is_read_too(tmp_path):
    policy = loaded(rl_sar(tmp_path, lambda c: c.update(observations_history_priority="term")))
    expected = [1.0, 0.2, 0.05] * 2 + [0.3, 0.5] * 2 + [0.0, 0.0, -1.0] * 2
    np.testing.assert_allclose(inputs(policy), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(num_observations=45), "num_observations is 45, but its .* 8 entries"),
        (lambda c: c["observations"].append("phase"), "unknown observation 'phase'; known are"),
        (lambda c: c.update(wheel_indices=[1]), r"wheels are not supported; got .*\[1\]"),
        (lambda c: c.update(rl_kp=[1, 2, 3]), "'rl_kp' must have 2 entries; got 3"),
        (lambda c: c.update(clip_actions_upper=[8, 9]), "State action_clip in policy.yaml"),
        (lambda c: c.update(observations_history=[0, 2]), "newest 2 samples once"),
        (lambda c: c.update(terrain=1), r"unknown keys \['terrain'\]"),
        (lambda c: c.update(rows=1, framework="isaacsim"), "rows and cols of old files"),
        (lambda c: c.update(model_name="gone.pt"), r"no network beside it.*\['gone.pt'\]"),
        (
            lambda c: (
                c.update(observations=["commands", "dof_pos", "beast_phase"])
                or c.update(num_observations=7)
            ),
            "a gait clock without a period",
        ),
    ],
)
def test_what_a_config_of_rl_sar_cannot_say_here_is_refused(tmp_path, change, message):
    config = rl_sar(tmp_path, change)
    with pytest.raises(ValueError, match=message) as error:
        read_policy_file(config)
    assert "config.yaml" in str(error.value)


def test_a_phase_whose_period_policy_yaml_states_is_a_clock(tmp_path):
    def change(content):
        content.update(observations=["commands", "dof_pos", "beast_phase"], num_observations=7)

    config = rl_sar(tmp_path, change)
    save_network(config.parent / "walk.pt", 14, 2)
    path = dump(tmp_path / "policy.yaml", {"read": str(config), "gait": {"period_s": 0.8}})
    policy = loaded(path)
    np.testing.assert_allclose(inputs(policy)[5:7], [0.0, 1.0])
    # It runs while the robot stands, too.
    assert policy.next_phases(policy.initial_phases, np.zeros(3))[0] == pytest.approx(
        2 * math.pi * 0.02 / 0.8
    )


def test_files_of_other_forms_are_told_apart(tmp_path):
    dump(tmp_path / "odd.yaml", {"a": 1})
    path = dump(tmp_path / "policy.yaml", {"read": "odd.yaml"})
    with pytest.raises(ValueError, match=r"odd.yaml' is neither a deploy.yaml .*keys are \['a'\]"):
        read_policy_file(path)
    with pytest.raises(ValueError, match="unknown key 'a'"):
        read_policy_file(tmp_path / "odd.yaml")
    with pytest.raises(ValueError, match="does not exist"):
        read_policy_file(dump(tmp_path / "policy.yaml", {"read": "gone.yaml"}))
    two = dump(tmp_path / "two.yaml", {"a": CONFIG["beast/lab"], "b": CONFIG["beast/lab"]})
    with pytest.raises(ValueError, match=r"one policy in a file is expected; got \['a', 'b'\]"):
        read_policy_file(two)
