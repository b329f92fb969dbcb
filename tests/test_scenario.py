import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import yaml

import toy_tasks
from command_line import invoked, python
from drake_safety import load_scenario
from drake_safety.simulation.rollouts import episodes_info
from drake_safety.simulation.scenario import parse_scenario, read_scenario, scenario_names
from drake_safety.simulation.scenario_check import check_scenario
from legged_robots import write_hexapod
from toy_tasks import SCENARIO, gliding

BALANCING = "task: drake_safety.diagrams.balancing:Balancing\nrobot: laikago\n"


def parsed(text, name="mine", folder=Path()):
    return parse_scenario(text, name=name, folder=folder)


def with_parameters(text):
    return f"{SCENARIO}parameters: {text}\n"


def test_values_of_a_file_are_replaced_by_their_keys():
    plain = load_scenario("pendulum")
    changes = {"episode_duration_s": 3.0, "variations.heavy.mass_scale": 2.0}
    changed = load_scenario("pendulum", changes | {"parameters.damping": 0.1})
    assert changed.variation("heavy").mass_scale == 2.0
    assert changed.variations.keys() - plain.variations.keys() == {"heavy"}
    assert (changed.episode_duration_s, changed.parameters.damping) == (3.0, 0.1)
    assert changed.assessment == plain.assessment
    with pytest.raises(ValueError, match="unknown key 'dampng'"):
        load_scenario("pendulum", {"parameters.dampng": 0.1})


@pytest.mark.parametrize(
    ("control_period_s", "monitor_step_s"), [(0.01, 0.02), (0.006, 0.024), (0.05, 0.05)]
)
def test_the_monitor_steps_whole_control_periods_of_at_least_20_ms(
    control_period_s, monitor_step_s
):
    scenario = replace(gliding(), control_period_s=control_period_s)
    assert scenario.monitor_step_s == pytest.approx(monitor_step_s)
    assert gliding().watch_period_s == gliding().control_period_s
    reaching = load_scenario("atlas_reaching", {"parameters.monitor_period_s": 0.05})
    assert reaching.watch_period_s == 0.05 > reaching.control_period_s


@pytest.fixture
def beside(tmp_path):
    """A scenario whose task, and a module that this imports, stand in its own folder."""
    module = Path(toy_tasks.__file__).read_text()
    imported = "from beside_period import period\n\nCONTROL_PERIOD_S = period()"
    lines = module.replace("CONTROL_PERIOD_S = 0.01", imported)
    (tmp_path / "beside_task.py").write_text(lines)
    (tmp_path / "beside_period.py").write_text("def period():\n    return 0.01\n")
    path = tmp_path / "beside.yaml"
    path.write_text(SCENARIO.replace("toy_tasks:", "beside_task:"))
    yield path
    for name in ("beside_task", "beside_period"):
        sys.modules.pop(name, None)


def test_a_task_beside_its_scenario_is_found_and_nothing_else_afterwards(beside):
    searched = list(sys.path)
    scenario = load_scenario(beside)
    assert scenario.task_class().__module__ == "beside_task"
    assert scenario.simulation_hash() == load_scenario(beside).simulation_hash()
    assert replace(scenario, episode_duration_s=0.4).make_loop().scenario.num_steps == 10
    assert sys.path == searched
    with pytest.raises(ValueError, match=r"no module 'beside_other', .*beside the scenario"):
        load_scenario(changed(beside, "beside_task:", "beside_other:"))


def changed(path, old, new):
    path.write_text(path.read_text().replace(old, new))
    return path


def test_a_task_beside_its_scenario_runs_in_worker_processes(beside):
    code = (
        "from drake_safety import load_scenario, run_episodes\n"
        f"scenario = load_scenario({str(beside)!r})\n"
        "episodes = run_episodes(scenario, 12, num_workers=2)\n"
        "same = run_episodes(scenario, 12, num_workers=1)\n"
        "assert all((a.state == b.state).all() for a, b in zip(episodes, same, strict=True))"
    )
    # The folder is neither that of the process nor on its path.
    python("-c", code)


def test_a_task_of_a_name_that_is_taken_is_refused_with_both_files(beside, tmp_path):
    load_scenario(beside)
    other = tmp_path / "other"
    other.mkdir()
    for name in ("beside.yaml", "beside_task.py", "beside_period.py"):
        (other / name).write_text((tmp_path / name).read_text())
    with pytest.raises(
        ValueError, match=r"module 'beside_task' is .*, and not .*other/beside_task"
    ):
        load_scenario(other / "beside.yaml")
    # A module that is installed is not replaced by a file beside the scenario either.
    (tmp_path / "yaml.py").write_text("")
    with pytest.raises(ValueError, match=r"module 'yaml' is .*: give the file a name of its own"):
        load_scenario(changed(beside, "beside_task:", "yaml:"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: [", "scenario 'mine' is not YAML"),
        (BALANCING + "parameters: {push: {sharee: 1}}", "push.sharee' .* keys there are .*'share'"),
        ("task: nowhere:X", "no module 'nowhere'"),
        (SCENARIO + "folder: /there", r"unknown keys \['folder'\]"),
        ("task: drake_safety.diagrams.balancing:Throw", "no task 'Throw'"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_with_what_would(text, message):
    with pytest.raises(ValueError, match=message):
        parsed(text)


def test_a_module_that_a_task_lacks_is_not_taken_for_the_task(tmp_path, monkeypatch):
    (tmp_path / "hungry_task.py").write_text("import hungry\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="No module named 'hungry'"):
        parsed("task: hungry_task:X\nrobot: laikago\n")


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_loads_and_is_read_again_from_its_canonical_text(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert "nominal" in scenario.variations
    assert isinstance(scenario.parameters, scenario.task_class().Parameters)
    again = parse_scenario(scenario.to_yaml(), name=name, folder=Path("/"))
    assert again == scenario
    assert again.simulation_hash() == scenario.simulation_hash()


@pytest.mark.parametrize(
    ("text", "is_same"),
    [
        ("robot: none\n" + SCENARIO.replace("robot: none\n", ""), True),
        (with_parameters("{speed_m_s: 2.0}"), True),  # The default.
        (SCENARIO + "assessment: {epochs: 3, mode: paper}", True),
        (SCENARIO + "assessment: {horizon: 11}", False),
        (SCENARIO.replace("actual: {", "payload: {}, actual: {"), True),
        (SCENARIO.replace("nominal: {}", "nominal: {mass_scale: 1.2}"), False),
        (with_parameters("{speed_m_s: 3.0}"), False),
    ],
)
def test_what_changes_a_rollout_and_nothing_else_changes_the_hash(text, is_same):
    assert (parsed(text).simulation_hash() == parsed(SCENARIO).simulation_hash()) == is_same
    assert len(parsed(text).simulation_hash()) == 64


def test_another_default_of_the_tasks_parameters_changes_the_hash(monkeypatch):
    @dataclass(kw_only=True)
    class Faster(toy_tasks.GlidingParameters):
        speed_m_s: float = 3.0

    before = gliding().simulation_hash()
    monkeypatch.setattr(toy_tasks.Gliding, "Parameters", Faster)
    assert gliding().simulation_hash() != before


@pytest.mark.parametrize(("step_s", "is_same"), [("0.04", True), ("0.02", False)])
def test_a_copy_is_the_scenario_that_was_learned_from_only_if_it_simulates_the_same(
    tmp_path, step_s, is_same
):
    learned = episodes_info(parsed(SCENARIO).make_loop(), seed=0)
    path = tmp_path / "copied.yaml"
    path.write_text(SCENARIO.replace("step_s: 0.04", f"step_s: {step_s}"))
    copy = load_scenario(path)
    assert copy.simulation_hash() != learned.scenario_hash
    assert copy.adopt(learned) == is_same
    assert (copy.simulation_hash() == learned.scenario_hash) == is_same
    assert copy.name == "copied"


def test_the_hash_is_of_the_files_of_robot_obstacles_and_policy_and_not_of_their_paths(tmp_path):
    hashes = set()
    for folder in (tmp_path / "here", tmp_path / "there" / "my robots"):
        write_hexapod(folder)
        urdf, robot = folder / "hexapod.urdf", folder / "robot.yaml"
        urdf.write_text(f"{urdf.read_text()}<!-- from /here/hexapod.xacro -->")
        text = robot.read_text().replace("urdf: hexapod.urdf", f"urdf: {urdf}")
        assert str(urdf) in text
        robot.write_text(text)
        (folder / "shelf.urdf").write_text(
            f'<robot><mesh filename="file://{folder}/a.obj"/></robot>'
        )
        reaching = load_scenario(
            "atlas_reaching",
            {"robot": str(robot), "parameters.obstacles": [{"model": f"{folder}/shelf.urdf"}]},
        )
        walking = load_scenario("go2_walking", {"parameters.policy": f"{folder}/policy.yaml"})
        (folder / "policy.yaml").write_text(f"network: {folder}/policy.onnx\njoints: [a]\n")
        (folder / "policy.onnx").write_bytes(b"a network")
        hashes.add((reaching.simulation_hash(), walking.simulation_hash()))
    assert len(hashes) == 1
    (folder / "shelf.urdf").write_text("<robot/>")
    (folder / "policy.onnx").write_bytes(b"another one")
    for scenario, before in zip((reaching, walking), hashes.pop(), strict=True):
        assert scenario.simulation_hash() != before
    before = reaching.simulation_hash()
    urdf.write_text(urdf.read_text().replace('mass value="6.0"', 'mass value="7.0"'))
    assert reaching.simulation_hash() != before


def test_a_relative_robot_path_starts_at_the_scenarios_folder(tmp_path):
    scenario = parsed(BALANCING.replace("laikago", "robots/robot.yaml"), folder=tmp_path)
    assert scenario.robot == str((tmp_path / "robots" / "robot.yaml").resolve())


def test_a_strangers_scenario_is_checked_without_running_its_code(tmp_path, monkeypatch):
    (tmp_path / "stranger.py").write_text('raise SystemExit("code was run")\n')
    file = tmp_path / "mine.yaml"
    file.write_text("task: stranger:Task\nrobot: laikago\nvariations: {nominal: {}, actual: {}}\n")
    monkeypatch.syspath_prepend(tmp_path)
    findings = list(check_scenario(file, is_imported=False))
    assert all(finding.is_ok for finding in findings)
    assert "stranger:Task, which was not imported" in findings[1].message
    assert "12 joints" in " ".join(finding.message for finding in findings)
    scenario = read_scenario(file)
    assert (scenario.task, scenario.parameters) == ("stranger:Task", {})
    with pytest.raises(SystemExit, match="code was run"):
        load_scenario(file)
    (finding,) = check_scenario(file)  # A failed condition in Drake is SystemExit, too.
    assert finding.message == "SystemExit: code was run"


@pytest.mark.parametrize(
    ("key", "text", "seen"),
    [
        ("name", "\x1b[2J\nOK  ready", "␛[2J\n    OK  ready"),
        ("name", "b\u202eyb", "b\ufffdyb"),
        ("requires", "x; rm -rf ~", "must match pattern"),
    ],
)
def test_texts_of_strangers_print_nothing_but_themselves(tmp_path, key, text, seen):
    robot = {"name": "r", "urdf": "package://not-there/r.urdf", "base": "base"} | {key: text}
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(robot))
    file = tmp_path / "s.yaml"
    stated = {"task": "stranger:Task", "robot": "robot.yaml", "variations": {"nominal": {}}}
    file.write_text(yaml.safe_dump(stated))
    result = invoked("check", file, "--no-import")
    assert seen in result.output
    for sign in "\x1b\r\u202e":
        assert sign not in result.output
    assert "pip install" not in result.output
