import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml

import command_line
from drake_safety.cli import make_app
from drake_safety.learning.assessment import AssessmentParameters
from drake_safety.robots.robot_model import load_robot_file
from drake_safety.simulation.scenario import load_scenario, parse_scenario
from legged_robots import write_hexapod
from studies.__main__ import app as studies

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = "".join(
    (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")
    for page in ("command_line", "contributing")
)
MAKEFILE = (ROOT / "Makefile").read_text()
CARDS = "".join(
    path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("assessments/*/README.md"))
)


def blocks(language, text=README):
    """The fenced blocks of a language, each without the indentation of its list."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", text, flags=re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def shell_commands(program, text=README):
    """The arguments of every line that calls a program, inline ones too."""
    lines = [line for block in blocks("sh", text) for line in block.splitlines()]
    # In a sentence a command may be only named.
    lines += re.findall(r"`([^`\n]+ [^`\n]+ [^`\n]+)`", text)
    called = [line for line in lines if line.startswith(f"{program} ")]
    return [shlex.split(line, comments=True)[len(program.split()) :] for line in called]


@pytest.mark.slow
def test_the_python_of_the_readme_runs_as_one_script_and_prints_a_belief(tmp_path):
    (first,) = blocks("python")
    # The README's numbers of episodes, maps and epochs take minutes; nothing else is changed.
    assert first.count("num_episodes=2048") == first.count("\nassessment = ") == 1
    first = first.replace("num_episodes=2048", "num_episodes=56")
    few = "scenario.assessment.epochs, scenario.assessment.ensemble_size = 5, 1"
    first = first.replace("\nassessment = ", f"\n{few}\nassessment = ")
    script = tmp_path / "readme.py"
    script.write_text(first, encoding="utf-8")
    printed = command_line.python(script, cwd=tmp_path)
    belief = np.array(printed.strip().strip("[]").split(), dtype=float)
    assert belief.shape == (3,)
    assert np.all(belief >= 0)
    assert belief.sum() == pytest.approx(1.0, abs=1e-4)


def test_the_refusal_of_the_readme_and_of_start_is_what_the_command_prints(monkeypatch, capsys):
    (call,) = [call for call in shell_commands("drake-safety") if call[0] == "ask"]
    assert command_line.call(monkeypatch, *call) == 1
    (shown,), printed = blocks("text"), capsys.readouterr().out.splitlines()
    assert shown in blocks("text", (ROOT / "docs/start.md").read_text(encoding="utf-8"))
    number = re.compile(r"-?\d+(?:\.\d+)?")
    alike = {number.sub("#", line): line for line in printed}
    for line in shown.splitlines():
        # The words to the letter, the numbers up to what other processors make of them.
        stated, found = (
            [float(digits) for digits in number.findall(one)]
            for one in (line, alike[number.sub("#", line)])
        )
        assert found == pytest.approx(stated, abs=0.03, rel=0.05)


def test_every_command_of_the_readme_of_the_command_line_page_and_of_the_cards_parses():
    for program, commands in (("drake-safety", make_app()), ("python -m studies", studies)):
        group = typer.main.get_command(commands)
        calls = shell_commands(program, README + COMMANDS + CARDS)
        assert {call[0] for call in calls} == set(group.commands)
        for name, *arguments in calls:
            # Parses and validates; nothing is run.
            group.commands[name].make_context(name, arguments)


def test_the_makefile_has_every_target_of_the_readme():
    targets = set(re.findall(r"^([a-z]+):.*## ", MAKEFILE, flags=re.MULTILINE))
    named = {call[0] for call in shell_commands("make")}
    assert {"demo", "test"} <= named <= targets
    trained = r"/drake-safety train .*--episodes (\d+) --out runs/demo"
    (num_episodes,) = re.findall(trained, MAKEFILE)
    assert f"simulates {num_episodes} episodes" in README
    assert f"## Train on {num_episodes} episodes" in MAKEFILE


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_help_lists_every_target_that_is_no_file():
    named = " ".join(re.findall(r"^\.PHONY: (.*)$", MAKEFILE, flags=re.MULTILINE)).split()
    command = ["make", "--no-print-directory", "help"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    listed = re.findall(r"^  make (\S+) +\S", printed, flags=re.MULTILINE)
    assert sorted(listed) == sorted(named)


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#\s]+)", README))
def test_every_relative_link_of_the_readme_leads_to_a_file(target):
    if not re.match(r"https?://", target):
        assert not Path(target).is_absolute()
        assert (ROOT / target).is_file()


def test_the_numbers_in_the_readmes_prose_are_the_programs_defaults():
    parameters = AssessmentParameters()
    assert f"{parameters.resolution} × {parameters.resolution} cells" in README
    assert parameters.ensemble_size == 3
    assert "averages three such networks" in README


def test_the_versions_are_those_of_the_constraints_and_the_citation_is_of_this_one():
    constraints = (ROOT / "constraints.txt").read_text()
    pinned = re.findall(r"^drake==([^\s;]+);", constraints, flags=re.MULTILINE)
    assert len(pinned) == 2
    assert [version for version in pinned if f"with Drake {version}" not in README] == []
    project = (ROOT / "pyproject.toml").read_text()
    assert "!=1.52.0" in project
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    stated, project = ("version", "license", "keywords"), tomllib.loads(project)["project"]
    assert [cited[key] for key in ("title", *stated)] == [project[key] for key in ("name", *stated)]


def test_the_readme_is_filled_in_and_knows_no_path_of_anyones_machine():
    assert re.findall(r"\{\{.*?\}\}|@\w*@", README) == []
    assert re.findall(r"(?<![\w.])/(?:home|root|tmp|work|Users)/\S*", README) == []


def test_the_scenario_of_the_page_makes_a_loop_with_a_robot_of_ones_own(tmp_path):
    write_hexapod(tmp_path)
    page = (ROOT / "docs" / "your_own_robot.md").read_text(encoding="utf-8")
    (text,) = [one for one in blocks("yaml", page) if one.startswith("task: ")]
    (tmp_path / "balancing.yaml").write_text(text)
    scenario = load_scenario(tmp_path / "balancing.yaml")
    assert Path(scenario.robot) == tmp_path / "robot.yaml"
    for variation in ("nominal", "actual"):
        loop = scenario.make_loop(variation)
        assert loop.robot.name == load_robot_file(tmp_path / "robot.yaml").name
    assert scenario.task.startswith("drake_safety.diagrams.")
    with pytest.raises(ValueError, match=r"unknown key 'robots' .*; keys there are \['name', "):
        parse_scenario(f"{text}\nrobots: two\n", name="own", folder=tmp_path)
