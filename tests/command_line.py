"""The command line in this process, as a shell would call it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drake_safety import cli
from drake_safety.simulation.scenario_check import check_scenario


def call(monkeypatch, *arguments, main=cli.main):
    """Runs the command as a shell would; returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["drake-safety", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code or 0


def invoked(*arguments):
    """The result of a command whose output is kept."""
    return CliRunner().invoke(cli.make_app(), [*map(str, arguments)])


def python(*arguments, cwd="/"):
    """Runs Python in a process of its own, which finds this package; returns its output."""
    paths = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    environment["PYTHONIOENCODING"] = "utf-8"
    options = {"cwd": cwd, "env": environment, "capture_output": True, "encoding": "utf-8"}
    done = subprocess.run([sys.executable, *map(str, arguments)], **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


def problems(scenario, num_episodes=0):
    """Returns the findings of `check` that are problems, by item."""
    findings = check_scenario(scenario, num_episodes=num_episodes)
    return {finding.item: finding for finding in findings if not finding.is_ok}


def study(monkeypatch, *arguments):
    """The same of ``python -m studies``."""
    from studies.__main__ import main

    return call(monkeypatch, *arguments, main=main)
