"""The command line in this process, as a shell would call it."""

import sys

import pytest

from drake_safety import cli


def call(monkeypatch, *arguments):
    """Runs the command as a shell would; returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["drake-safety", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code
