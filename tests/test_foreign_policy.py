"""Policies described in the forms of other projects: converted, or refused with a reason."""

import copy
import math
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from drake_safety.importing.foreign_policy import converted_policy
from drake_safety.importing.policy_template import survey_policy
from drake_safety.policies.policy import load_policy
from policy_networks import save_network

pytestmark = pytest.mark.train

JOINTS = ["tail", "hip", "knee"]  # The robot's.
MOTORS = ["knee", "tail", "hip"]

RANGES = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.3, 0.3], "ang_vel_z": [-0.2, 0.2]}
# The network's joints are hip and knee.
DEPLOY = {
    "joint_ids_map": [2, 0],
    "step_dt": 0.02,
    "stiffness": [30.0, 0.0, 20.0],
    "damping": {"hip": 2.0, "tail|knee": 3.0},
    "default_joint_pos": [0.1, -0.2],
    "commands": {"base_velocity": {"ranges": RANGES | {"heading": None}}},
    "actions": {"JointPositionAction": {"scale": [0.25, 0.5], "clip": None, "joint_ids": None}},
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
    "beast": {"dt": 0.005, "decimation": 4, "num_of_dofs": 2, "default_dof_pos": [0.1, -0.2]}
    | {"joint_names": ["knee", "hip"], "joint_mapping": [1, 0]}
}


def rl_sar(folder, **changes):
    """A config.yaml beside its network, with the base.yaml of its robot two folders above."""
    content = copy.deepcopy(CONFIG)
    content["beast/lab"].update(changes)
    config = folder / "beast" / "lab" / "walk" / "config.yaml"
    config.parent.mkdir(parents=True)
    (folder / "beast" / "base.yaml").write_text(yaml.safe_dump(BASE))
    config.write_text(yaml.safe_dump(content))
    save_network(config.parent / "walk.pt", 16, 2)
    return config


def deploy(folder, inputs=10, **changes):
    """A deploy.yaml with its network."""
    for name in ("params", "exported"):
        (folder / name).mkdir(exist_ok=True)
    save_network(folder / "exported" / "policy.pt", inputs, 2)
    path = folder / "params" / "deploy.yaml"
    path.write_text(yaml.safe_dump(DEPLOY | changes, sort_keys=False))
    return path


def loaded(path, motors=()):
    """The policy of what `new` writes."""
    robot = SimpleNamespace(joint_names=JOINTS, robot=SimpleNamespace(name="beast"))
    (path.parent / "robot").mkdir(exist_ok=True)
    (_, file), _ = survey_policy(path, motors).write(path.parent / "robot", JOINTS, {})
    return load_policy(file, robot)


def inputs(policy, action=(0.0, 0.0)):
    """The network's input in a state: joints tail, hip, knee at 9, .4 and .3 rad."""
    q = np.array([1.0, 0, 0, 0, 0, 0, 0.5, 9.0, 0.4, 0.3])
    v = np.array([1.0, 2.0, 300.0, *np.zeros(6)])
    seen = policy.see(q, v, np.array([0.5, 0.1, 0.2]), np.array(action), policy.initial_phases)
    return policy.observe(seen, np.full(policy.num_inputs, np.nan))


def test_a_deploy_yaml_says_all_but_the_names_of_the_motors(tmp_path):
    policy = loaded(deploy(tmp_path), MOTORS)
    assert policy.joint_names == ["hip", "knee"]
    gains = [(policy.gains[name].stiffness, policy.gains[name].damping) for name in ("hip", "knee")]
    assert gains == [(20.0, 2.0), (30.0, 3.0)]  # In the motors' order, unlike the rest.
    np.testing.assert_allclose(policy.targets(np.array([1.0, 1.0])), [0.0, 0.35, 0.3])
    # The clip is of values before scaling.
    expected = [0.2, 0.4, 2.0, 0.5, 0.1, 0.4, 0.3, 0.5, 0.3, 0.5]
    np.testing.assert_allclose(inputs(policy), expected)
    assert (policy.parameters.period_s, policy.parameters.action_clip) == (0.02, math.inf)
    assert policy.parameters.command.lowest == [-0.5, -0.3, -0.2]


def test_history_of_whole_observations_is_the_oldest_first(tmp_path):
    terms = {"joint_pos_rel": {}, "last_action": {}, "gait_phase": {"params": {"period": 0.8}}}
    terms = {name: {**term, "history_length": 2} for name, term in terms.items()}
    path = deploy(tmp_path, 12, observations={"obs": {"use_gym_history": True, **terms}})
    policy = loaded(path, MOTORS)
    assert (policy.parameters.history.ages, policy.parameters.gait.period_s) == ([1, 0], 0.8)
    np.testing.assert_allclose(inputs(policy, (5.0, 6.0)), 2 * [0.3, 0.5, 5.0, 6.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("joint_ids: null", "joint_ids: !!python/object/apply:builtins.slice [0]", "all 2 joints"),
        ("joint_ids: null", "joint_ids: !!python/name:os.system ''", "is not YAML"),
        ("clip: null", "offset: [0.0, 0.0]", "offset must equal default_joint_pos"),
        ("- 10.0", "- 5.0", "clip must be symmetric"),
        ("JointPosition", "JointVelocity", "unknown keys"),
    ],
)
def test_what_a_deploy_yaml_cannot_say_here_is_refused(tmp_path, old, new, message):
    path = deploy(tmp_path)
    with pytest.raises(ValueError, match="by --motors"):
        converted_policy(path)
    text = path.read_text()
    slices = "joint_ids: !!python/object/apply:builtins.slice [null, null, null]"
    path.write_text(text.replace("joint_ids: null", slices))
    assert converted_policy(path, MOTORS)["joints"] == ["hip", "knee"]
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        converted_policy(path, MOTORS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": 1}, r"unknown keys \['camera'\]"),
        ({"num_observations": 45}, "num_observations is 45, .* 8 entries"),
        ({"rl_kp": [1, 2, 3]}, "'rl_kp' must have 2 entries; got 3"),
        ({"clip_actions_upper": [8, 9]}, "must be the same for all joints"),
        ({"observations_history": [0, 2]}, "newest 2 samples once"),
        ({"model_name": "gone.pt"}, "expected a network beside it, one of .*gone.pt"),
    ],
)
def test_what_a_file_cannot_say_here_is_refused(tmp_path, changes, message):
    path = rl_sar(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as error:
        converted_policy(path)
    assert path.name in str(error.value)


def test_terms_that_nobody_has_registered_are_asked_for(tmp_path):
    changes = {"observations": ["commands", "lidar"], "observations_history": []}
    path = rl_sar(tmp_path, num_observations=9, **changes)
    text, asked = survey_policy(path).yaml(JOINTS, {})
    assert "name: lidar" in text
    assert any("functions of the terms ['lidar']" in what for what in asked)


def test_a_config_of_rl_sar_says_all_but_the_commands(tmp_path):
    policy = loaded(rl_sar(tmp_path))
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


def test_a_phase_has_a_clock_whose_period_is_asked_for(tmp_path):
    observations = ["commands", "dof_pos", "beast_phase"]
    config = rl_sar(tmp_path, observations=observations, num_observations=7)
    save_network(config.parent / "walk.pt", 14, 2)
    with pytest.raises(ValueError, match="term 'gait_phase' needs a clock: state 'gait"):
        loaded(config)
    file = config.parent / "robot" / "policy.yaml"
    file.write_text(file.read_text().replace("# gait", "gait"))
    policy = load_policy(file, SimpleNamespace(joint_names=JOINTS, robot=SimpleNamespace(name="")))
    np.testing.assert_allclose(inputs(policy)[5:7], [0.0, 1.0])
    # It runs while the robot stands, too.
    after = policy.next_phases(policy.initial_phases, np.zeros(3))[0]
    assert after == pytest.approx(2 * math.pi * 0.02 / 0.8)
