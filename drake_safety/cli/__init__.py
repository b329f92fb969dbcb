"""The command ``drake-safety``: train, run and evaluate safety assessments.

Another command is a function of the command's name (its arguments are the command line, its
docstring the help) and a line in `_COMMANDS`.
"""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.logging import RichHandler

from drake_safety.cli import (
    adapt,
    ask,
    calibrate,
    evaluate,
    export,
    play,
    prepare,
    report,
    run,
    train,
)
from drake_safety.cli.console import command_line, console
from drake_safety.cli.targets import TargetCommand
from drake_safety.extras import require_extra

# In the order in which the help lists them.
_COMMANDS = (
    prepare.scenarios,
    prepare.new,
    prepare.check,
    train.train,
    calibrate.calibrate,
    ask.ask,
    run.run,
    play.play,
    evaluate.evaluate,
    adapt.adapt,
    export.export,
    report.report,
)

# The extra that a command needs, said before it does anything.
_NEEDS = {
    "train": "train",
    "calibrate": "train",
    "evaluate": "train",
    "adapt": "train",
    "report": "report",
    "play": "live",
}
# What continues a stopped command that keeps finished episodes: the same line with this option.
_RESUMED = {"train": "--resume", "calibrate": "", "evaluate": "", "adapt": ""}
_DEBUG = "--debug"
_STOPPED = 130  # Exit code after Ctrl-C.


class _Command(TargetCommand):
    """A command whose extra is installed, and whose ``--cluster`` is connected while it runs."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        if self.name in _NEEDS:
            require_extra(_NEEDS[self.name], self.name)
        address = ctx.params.get("cluster")
        if address is None:
            return super().invoke(ctx)
        from drake_safety.simulation.cluster import connected

        with connected(address):
            return super().invoke(ctx)


app = typer.Typer(
    help="Learn safety assessments of robot motions from simulations, and use them before and "
    f"during motions. With {_DEBUG}, anywhere in the line, errors show their traceback.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for _command in _COMMANDS:
    app.command(cls=_Command)(_command)


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        from drake_safety.learning.segments import installed_versions

        found = installed_versions("drake")
        console.print(
            f"drake-safety {found['drake_safety']}, drake {found['drake']}, "
            f"Python {sys.version.split()[0]}",
            highlight=False,
        )
        raise typer.Exit()


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Runs the command."""
    run_app(app, "drake-safety", _RESUMED)


def run_app(commands: typer.Typer, program: str, resumed: Mapping[str, str] | None = None) -> None:
    """Runs a command; user errors are printed as one line, with --debug as a traceback.

    SIGTERM stops it as Ctrl-C does.

    Args:
        commands: The commands.
        program: Name of the program.
        resumed: Commands that can be continued after Ctrl-C, and the option that does so or "".
    """
    handler = RichHandler(console=console, show_path=False)
    logging.getLogger("drake_safety").addHandler(handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments = [argument for argument in sys.argv[1:] if argument != _DEBUG]
    try:
        code = commands(arguments, prog_name=program, standalone_mode=False)
        if code == _STOPPED:  # Typer's own answer to Ctrl-C.
            raise KeyboardInterrupt
        sys.exit(code)
    except (typer.Abort, KeyboardInterrupt):
        console.print("stopped; finished episodes are kept", highlight=False)
        option = (resumed or {}).get(next(iter(arguments), ""))
        if option is not None:
            line = command_line(program, option)
            console.print("continue with:", line, highlight=False, soft_wrap=True)
        sys.exit(_STOPPED)
    except Exception as error:
        from drake_safety.learning.segments import EpisodeError

        if isinstance(error, (ValueError, OSError, EpisodeError)) and _DEBUG not in sys.argv:
            console.print("error", error, style="red", highlight=False, soft_wrap=True)
            if isinstance(error, EpisodeError):
                console.print(f"{_DEBUG} in the command line shows where", highlight=False)
            sys.exit(2)
        # Typer's own errors (unknown options, wrong types) have `show`.
        if not hasattr(error, "exit_code") or not hasattr(error, "show"):
            raise
        error.show()
        sys.exit(error.exit_code)
