"""The command line: every command is listed, and what a user did wrong is one line."""

import math
import sys
from types import SimpleNamespace

import pytest
import typer

from drake_safety.cli import app, main
from drake_safety.cli.run import parse_pushes
from drake_safety.cli.training_folder import MODES, assessment_file, load_assessment
from drake_safety.learning.assessment import AssessmentParameters
from drake_safety.simulation.balls import Throw
from gliding_task import SCENARIO


def call(monkeypatch, *arguments):
    """Runs the command as a shell would; returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["drake-safety", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_every_command_says_in_a_sentence_what_it_does():
    commands = typer.main.get_command(app).commands
    assert list(commands) == ["scenarios", "train", "ask", "run", "evaluate"]
    for command in commands.values():
        assert command.help.splitlines()[0].endswith(".")


def test_a_table_of_scenarios_is_printed(monkeypatch, capsys):
    assert call(monkeypatch, "scenarios") in (0, None)
    printed = capsys.readouterr().out
    assert "nominal, actual" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "nothing", "--out", "x"], "error scenario 'nothing' does not exist"),
        (
            ["train", "laikago_balancing", "--out", "x", "--mode", "both ways"],
            "error train: mode must be one of ['sharpened', 'paper', 'both']; got 'both ways'",
        ),
        (["run", "laikago_balancing", "--assessment", "x"], "error x holds no 'sharpened'"),
        (["evaluate", "laikago_balancing", "--assessment", "x"], "error x holds no 'sharpened'"),
        (
            ["ask", "laikago_balancing", "--assessment", "x", "--target", "1", "-2", "3"],
            "error x holds no 'sharpened'",
        ),
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


def test_throws_at_a_task_without_recovery_are_refused_before_anything_is_simulated(
    monkeypatch, capsys, tmp_path
):
    file = tmp_path / "gliding.yaml"
    file.write_text(SCENARIO)
    assert call(monkeypatch, "evaluate", file, "--assessment", tmp_path) == 2
    assert "has no recovery to judge: pass --throws 0" in capsys.readouterr().out


def test_an_unknown_option_is_answered_with_the_usage(monkeypatch, capsys):
    assert call(monkeypatch, "scenarios", "--colour") == 2
    printed = capsys.readouterr()
    assert "Usage: drake-safety scenarios" in printed.out + printed.err


def test_a_run_that_is_stopped_says_that_episodes_are_kept(monkeypatch, capsys):
    def stopped(**options):
        raise KeyboardInterrupt

    monkeypatch.setattr("drake_safety.cli.app", stopped)
    assert call(monkeypatch, "scenarios") == 130
    assert "finished episodes are kept" in capsys.readouterr().out


def test_training_is_not_mixed_with_episodes_that_are_there_already(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("drake_safety.simulation.dataset.completed", lambda path: {0, 1, 2})
    (tmp_path / "episodes").mkdir()
    assert call(monkeypatch, "train", "laikago_balancing", "--out", tmp_path) == 2
    assert "already holds 3 episodes: pass --resume" in capsys.readouterr().out


def test_a_missing_assessment_is_answered_with_those_that_are_there(tmp_path):
    assessment_file(tmp_path, "paper").touch()
    with pytest.raises(ValueError, match=r"no 'sharpened' assessment; it holds \['paper'\]"):
        load_assessment(tmp_path, "sharpened")


def test_the_mode_trained_first_is_the_default_one():
    assert MODES[0] == AssessmentParameters().mode


@pytest.fixture
def scenario():
    demonstration = [Throw(time_s=0.6), Throw(time_s=1.7)]
    return SimpleNamespace(parameters=SimpleNamespace(demonstration=demonstration))


def test_pushes_are_the_scenarios_own_balls_or_described_in_degrees(scenario):
    own = "time=1 mass=3 speed=9 direction=90"
    first, second, third = parse_pushes(scenario, ["ball", own])
    assert [first, second] == scenario.parameters.demonstration
    assert (third.time_s, third.mass_kg, third.speed_m_s) == (1.0, 3.0, 9.0)
    assert third.direction_rad == pytest.approx(math.pi / 2)
    assert parse_pushes(scenario, ["time=1"]) == [Throw(time_s=1.0)]


@pytest.mark.parametrize(
    ("push", "message"),
    [
        ("weight=3", r"unknown 'weight'; give 'ball', or any of \['time=NUMBER', 'mass=NUMBER'"),
        ("mass=heavy", "'heavy' is not a number"),
        ("mass=-1", "mass_kg must be positive; got -1.0"),
    ],
)
def test_a_push_that_cannot_be_is_refused(scenario, push, message):
    with pytest.raises(ValueError, match=message):
        parse_pushes(scenario, [push])
