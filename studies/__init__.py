"""What makes the tables of README and docs, and nobody else needs: ``python -m studies``.

Runs from a checkout, on the folders that ``drake-safety train`` and ``evaluate`` write; it is not
part of the installed package.
"""

from drake_safety.cli.console import command_line as _typed


def command_line() -> str:
    """The command as it was typed."""
    return _typed("python -m studies")
