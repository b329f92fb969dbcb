"""`new --task walking`: from a URDF and a policy's files to a robot that can be checked."""

import math

import pytest
import yaml

from command_line import invoked, problems
from drake_safety.files.schema import load_typed
from drake_safety.importing.policy_template import PolicyTemplate, survey_policy
from drake_safety.policies.policy import PolicyParameters
from drake_safety.policies.policy_network import (
    PolicyMetadata,
    PolicyNetwork,
    load_network,
    read_metadata,
)
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.scenario_check import check_scenario
from policy_networks import GAINS, TERMS, new, save_network, save_onnx, walker

SWINGS = [f"swing_{i}" for i in range(6)]


def uncommented(path, *starts):
    """Removes the sign of comments before lines, and what follows the next one."""
    lines = path.read_text().splitlines()
    for i, line in enumerate(lines):
        if line.startswith(tuple(f"# {start}" for start in starts)):
            lines[i] = line[2:].partition("#")[0].rstrip()
    path.write_text("\n".join(lines))


@pytest.mark.train
def test_a_network_alone_leaves_what_it_cannot_tell_to_be_asked_for(tmp_path):
    network = save_network(tmp_path / "walk.pt", 42, 18, scale=0.0)
    out, result = new(tmp_path, network)
    assert result.exit_code == 0, result.output
    text = (out / "policy.yaml").read_text()
    for key in ("joints", "default_positions", "action_scale", "gains", "observation"):
        (line,) = [line for line in text.splitlines() if line.startswith(f"# {key}:")]
        assert "# ASK" in line
    assert (out / "walk.pt").read_bytes() == network.read_bytes()
    scenario = out / "walking.yaml"
    (finding,) = problems(scenario).values()
    assert finding.item == "diagram"
    for key in ("joints", "default_positions", "observation"):
        assert f"'{key}'" in finding.message
    assert "policy.yaml" in finding.message
    # Done as it says, the check passes, but for a network that rests.
    uncommented(out / "policy.yaml", "joints:", "default_positions:", "action_scale:")
    stated = yaml.safe_load((out / "policy.yaml").read_text())
    stated["gains"] = {".*": GAINS}
    stated["observation"] = [{"name": name} for name in TERMS]
    (out / "policy.yaml").write_text(yaml.safe_dump(stated))
    (finding,) = problems(scenario).values()
    assert "it holds its posture" in finding.message


@pytest.mark.train
def test_a_policy_is_copied_whole_and_the_joints_that_it_moves_are_not_fixed(tmp_path):
    files = ["policy.onnx.data", "weights/R"]
    path = save_onnx(tmp_path / "policy.onnx", 42, 18, memory=[("h_in", "h_out")], files=files)
    # Three legs have feet; the policy moves the others too.
    out, result = new(tmp_path, path, "--feet", "tibia_0,tibia_2,tibia_4")
    assert result.exit_code == 0, result.output
    assert all(name in (out / "policy.yaml").read_text() for name in SWINGS)
    assert "are fixed" not in (out / "README.md").read_text()
    for name in (path.name, *files):
        assert (out / name).read_bytes() == (tmp_path / name).read_bytes()
    assert load_network(out / path.name).widths == (42, 18)
    scenario = load_scenario(out / "walking.yaml")
    assert {out / name for name in files} < set(scenario.task_class().model_files(scenario))


def test_metadata_of_a_network_are_not_asked_for(tmp_path):
    every = {".*": 0.25}
    metadata = PolicyMetadata(
        joints=["a", "b"],
        stiffness=every,
        damping=every,
        action_scale=every,
        default_positions=every,
    )
    network = PolicyNetwork(tmp_path / "p.onnx", lambda batch: batch, (45, 2), metadata)
    text, asked = PolicyTemplate(network=network).yaml(["a", "b", "c"], {})
    kinds = ["limit", "time", "terms", "ranges"]
    assert [what.partition(":")[2].split()[1] for what in asked] == kinds
    assert "45 entries" in text
    text, asked = PolicyTemplate(network=network).yaml(["c", "d"], {})
    assert "['a', 'b'] are none of them" in asked[0]


@pytest.mark.parametrize(
    ("said", "asked_for"),
    [
        ({}, ["scale and history of the terms"]),
        ({"observation_terms_scale": "1,2", "observation_history_lengths": "1,2"}, []),
        ({"observation_history_lengths": "2"}, ["scale and history", "'history' do not fit"]),
    ],
)
def test_observations_that_a_network_names_are_stated(tmp_path, said, asked_for):
    raw = {"observation_names": "base_ang_vel,actions"} | said
    network = PolicyNetwork(tmp_path / "p.onnx", list, (45, 2), read_metadata(raw))
    text, asked = PolicyTemplate(network=network).yaml(["a", "b"], {})
    terms = load_typed(PolicyParameters, yaml.safe_load(text), "policy").observation
    assert [term.name for term in terms] == ["base_ang_vel", "last_action"]
    assert [term.history for term in terms] == [1, 2 if "1,2" in said.values() else 1]
    assert all(term.clip == math.inf for term in terms)
    of_terms = [what for what in asked if "of the terms" in what or "metadata" in what]
    for what, words in zip(of_terms, asked_for, strict=True):
        assert words in what


def test_new_refuses_a_policy_before_it_writes_anything(tmp_path):
    (tmp_path / "odd.yaml").write_text("a: 1")
    for policy in ("gone.pt", "odd.yaml"):
        out, result = new(tmp_path, tmp_path / policy)
        assert result.exit_code != 0 and not out.exists()
    assert "odd.yaml'" in str(result.exception)
    result = invoked("new", "walker", "--urdf", tmp_path / "hexapod.urdf", "--task", "walking")
    assert result.exit_code != 0


def test_more_joints_named_than_moved_are_observed_and_the_moved_ones_asked_for(tmp_path):
    said = {"joint_names": "a,b,c", "observation_names": "joint_pos,actions"}
    network = PolicyNetwork(tmp_path / "p.onnx", list, (5, 2), read_metadata(said))
    network.outputs = ["actions", "velocity"]
    text, asked = PolicyTemplate(network=network).yaml(["a", "b", "c", "d"], {})
    assert "# joints: [a, b, c]  # ASK the 2 joints that it moves" in text
    assert "# action_clip: 1.0  # ASK the limit of actions in training" in text
    stated = load_typed(PolicyParameters, yaml.safe_load(text), "policy")
    assert [term.joints for term in stated.observation] == [["a", "b", "c"], []]
    assert any("['actions', 'velocity']: the first is the action" in what for what in asked)


@pytest.mark.train
def test_a_policy_that_reads_its_observation_wrongly_is_told_about_its_policy(tmp_path):
    network = save_network(tmp_path / "walk.pt", 42, 18, scale=-0.0005)
    scenario = walker(tmp_path, network)
    findings = {f.item: f for f in check_scenario(scenario, num_episodes=0)}
    assert f"{network.name} is TorchScript: code of its author" in findings["network"].message
    assert list(findings).index("network") < list(findings).index("diagram")
    walks = findings["takes over and walks, from standing"]
    assert not walks.is_ok and "it leaves the safe set at" in walks.message
    assert "order of 'joints' and of the terms" in walks.remedy
    assert not any("joint_gains" in finding.remedy for finding in findings.values())


@pytest.mark.train
def test_new_says_what_a_network_is_before_it_is_loaded(tmp_path):
    (tmp_path / "p.pt").write_bytes(b"")
    said = []
    with pytest.raises(ValueError, match="not a TorchScript network"):
        survey_policy(tmp_path / "p.pt", announce=said.append)
    assert said[0].endswith("p.pt is TorchScript: code of its author, which runs here")
