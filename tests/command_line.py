"""The command line in this process, as a shell would call it."""

import sys

import pytest
from typer.testing import CliRunner

from drake_safety import cli


def call(monkeypatch, *arguments, main=cli.main):
    """Runs the command as a shell would; returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["drake-safety", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code or 0


def invoked(*arguments):
    """The result of a command whose output is kept."""
    return CliRunner().invoke(cli.make_app(), [*map(str, arguments)])


def study(monkeypatch, *arguments):
    """The same of ``python -m studies``."""
    from studies.__main__ import main

    return call(monkeypatch, *arguments, main=main)
