"""The command line: every command is listed, and what a user did wrong is one line."""

import math
import re
import shlex
import sys
from types import SimpleNamespace

import pytest
import typer

import drake_safety
from command_line import call
from drake_safety.assessments import assessed_scenarios
from drake_safety.cli import COMMANDS, main, make_app
from drake_safety.cli.run import parse_pushes
from drake_safety.learning.segments import EpisodeError
from drake_safety.plants.balls import Throw
from drake_safety.simulation.scenario import load_scenario
from live_scenarios import learned, quick
from toy_tasks import SCENARIO


@pytest.mark.train
def test_a_mistake_in_a_task_names_its_episode_and_debug_shows_where(tmp_path, monkeypatch, capsys):
    file = tmp_path / "gliding.yaml"
    file.write_text(SCENARIO + "parameters: {failure: bug}\n")
    command = ("train", file, "--episodes", 8, "--workers", 1)
    assert call(monkeypatch, *command, "--out", tmp_path / "a") == 2
    told = capsys.readouterr().out
    assert "of 'gliding' (seed 0): RuntimeError: operands could not be broadcast" in told
    arguments = ["drake-safety", *map(str, command), "--debug", "--out", str(tmp_path / "b")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(EpisodeError) as caught:
        main()
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_a_table_of_scenarios_and_the_version_are_printed(monkeypatch, capsys):
    assert call(monkeypatch, "scenarios") in (0, None)
    printed = capsys.readouterr().out
    assert "nominal, actual" in printed
    assert max(map(len, printed.splitlines())) <= 80
    rows = {name: cells for name, *cells in re.findall(r"│ (\w+) +│ (yes|no) +│ (.*?) +│", printed)}
    trained = {name for name, cells in rows.items() if cells[0] == "yes"}
    assert trained == {*assessed_scenarios()}
    assert rows["pendulum"] == ["no", ""] and rows["atlas_reaching"] == ["yes", ""]
    assert rows["g1_walking"][1] in ("robots, walking", "drake_safety[robots]")
    assert call(monkeypatch, "--version") in (0, None)
    printed = capsys.readouterr().out
    assert printed.startswith(f"drake-safety {drake_safety.__version__}, drake ")


def test_the_help_has_every_command_in_a_group_with_an_example_that_parses(monkeypatch, capsys):
    assert call(monkeypatch) == 0
    listing = capsys.readouterr().out
    assert (
        listing.split("\n\n")[1].strip().startswith("Γ, learned from simulated episodes, predicts")
    )
    listed = re.findall(r"^  ([a-z]+)  ", listing, flags=re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)
    assert re.findall(r"^(\w+):$", listing, flags=re.MULTILINE) == [
        "Options",
        "Use",
        "Train",
        "Judge",
    ]
    commands = typer.main.get_command(make_app()).commands
    for name in COMMANDS:
        assert call(monkeypatch, name, "--help") == 0
        shown = capsys.readouterr().out
        assert not re.search(r"[<{}]|list\[", shown), shown
        (example,) = re.findall(r"^  Example:\n\n  drake-safety (.*)$", shown, flags=re.MULTILINE)
        command, *arguments = shlex.split(example)
        assert command == name
        commands[name].make_context(name, arguments)
        if name != "scenarios":
            assert "Arguments:" in shown and re.search(r"^Usage: .* [A-Z]+", shown)


SCENE = "laikago_balancing"
MISSING = "error: folder 'x' holds no 'sharpened' assessment; it holds []: run `drake-safety train`"


@pytest.mark.parametrize("arguments", [["run", SCENE, "--foo"], ["fly"]])
def test_an_option_or_a_command_that_is_not_there_is_one_line_too(monkeypatch, capsys, arguments):
    assert call(monkeypatch, *arguments) == 2
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("error: No such ")


@pytest.mark.train
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "nothing", "--out", "x"], "error: scenario 'nothing' does not exist"),
        (
            ["train", SCENE, "--out", "x", "--mode", "both ways"],
            "error: train: mode must be one of",
        ),
        (["calibrate", SCENE, "--miss-rate", "2"], "error: calibration: --miss-rate is 2.0"),
        (["run", SCENE, "--assessment", "x"], MISSING),
    ],
)
def test_what_a_user_did_wrong_is_one_line_and_no_traceback(
    monkeypatch, capsys, tmp_path, arguments, message
):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *arguments) == 2
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.train
@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["train", "pendulum", "--out"], "file"),
        (["run", SCENE, "--push", "ball", "--out"], "file/inside"),
    ],
)
def test_a_folder_that_cannot_be_written_is_found_before_anything_is_simulated(
    monkeypatch, capsys, tmp_path, arguments, what
):
    monkeypatch.setattr("drake_safety.simulation.rollouts.collect_episodes", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert call(monkeypatch, *arguments, what) == 2
    assert f"error: folder '{what}" in (printed := capsys.readouterr().out)
    assert "cannot be written" in printed


@pytest.mark.train
def test_training_is_not_mixed_with_episodes_that_are_there_already(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("drake_safety.cli.train.completed", lambda path: {0, 1, 2})
    (tmp_path / "episodes").mkdir()
    assert call(monkeypatch, "train", "laikago_balancing", "--out", tmp_path) == 2
    assert "already holds 3 episodes: pass --resume" in capsys.readouterr().out


@pytest.mark.train
def test_a_task_without_goals_or_balls_runs_an_episode_and_takes_no_push(
    monkeypatch, capsys, tmp_path
):
    learned(quick(load_scenario("pendulum"))).save(tmp_path / "sharpened.safetensors")
    command = ("run", "pendulum", "--assessment", tmp_path)
    assert call(monkeypatch, *command, "--push", "ball") == 2
    assert call(monkeypatch, *command, "--mcap", tmp_path / "run" / "run.mcap") == 0
    assert "the episode starts" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == {"recording.html", "run.json", "run.mcap", "timeline.png", "timeline.svg"}


def test_pushes_are_the_scenarios_own_balls_or_described_in_degrees():
    demonstration = [Throw(time_s=0.6), Throw(time_s=1.7)]
    scenario = SimpleNamespace(parameters=SimpleNamespace(demonstration=demonstration))
    own = "time=1 mass=3 speed=9 direction=90"
    first, second, third = parse_pushes(scenario, ["ball", own])
    assert [first, second] == demonstration
    assert (third.time_s, third.mass_kg, third.speed_m_s) == (1.0, 3.0, 9.0)
    assert third.direction_rad == pytest.approx(math.pi / 2)
    assert parse_pushes(scenario, ["time=1"]) == [Throw(time_s=1.0)]
