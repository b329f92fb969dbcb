"""The command ``drake-safety``: train, run and evaluate safety assessments.

Another command is a function of the command's name (its arguments are the command line, its
docstring the help) and an entry of `COMMANDS`. Only the module of the command that is called is
imported.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Container, Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any, NamedTuple

import typer
from rich.logging import RichHandler
from typer.core import TyperCommand

from drake_safety.cli.console import COMMAND, TARGET, ScenarioArgument, command_line, console
from drake_safety.extras import require_extra
from drake_safety.files.reading import is_number
from drake_safety.learning.segments import EpisodeError, installed_versions


class Entry(NamedTuple):
    """A command.

    Attributes:
        module: Its module.
        line: First line of its help.
        extra: The extra that it needs, said before it does anything.
        resumed: Option with which the same line continues it after Ctrl-C; None where nothing is
            kept.
    """

    module: str
    line: str
    extra: str = ""
    resumed: str | None = None


# In the order in which the help lists them.
COMMANDS = {
    "scenarios": Entry("prepare", "List the scenarios that come with the package."),
    "new": Entry(
        "prepare", "Write the folder of a robot and a first scenario from a URDF, for review."
    ),
    "check": Entry(
        "prepare", "Check a scenario and its robot, and print problems with their remedies."
    ),
    "train": Entry("train", "Simulate the nominal closed loop and train Γ.", "train", "--resume"),
    "calibrate": Entry(
        "calibrate", "Choose thresholds with a promised miss rate on fresh episodes.", "train", ""
    ),
    "ask": Entry(
        "ask", "Print the verdict on a target, or on a command of a walking robot; nothing moves."
    ),
    "run": Entry(
        "run", "Simulate once with Γ in the loop; write a recording, a timeline and the events."
    ),
    "play": Entry(
        "play",
        "Simulate a task on a page in the browser, in real time, until Stop or Ctrl-C.",
        "live",
    ),
    "evaluate": Entry(
        "evaluate",
        "Evaluate Γ, and the paper's form, on fresh episodes, throws and, with --shifts, other "
        "plants.",
        "train",
        "",
    ),
    "adapt": Entry(
        "adapt", "Adapt Γ to an actual robot, and evaluate it before and after.", "train", ""
    ),
    "monitor": Entry(
        "monitor",
        "Run the change monitor over logs of a robot: its alarms, their causes, and its levels.",
    ),
    "export": Entry(
        "export", "Write Γ as one ONNX file, which runs without this package and without Drake."
    ),
    "report": Entry(
        "report", "Write RUN/report.html, a self-contained page of what is there.", "report"
    ),
}
_DEBUG = "--debug"
_STOPPED = 130  # Exit code after Ctrl-C.


class _Command(TyperCommand):
    """A command whose extra is installed, and whose ``--cluster`` is connected while it runs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the arguments with the numbers of a target joined to one word."""
        return super().parse_args(ctx, join_targets(args))

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        extra = COMMANDS[self.name or ""].extra
        if extra:
            require_extra(extra, self.name or "")
        address = ctx.params.get("cluster")
        if address is None:
            return super().invoke(ctx)
        from drake_safety.simulation.cluster import connected

        with connected(address):
            return super().invoke(ctx)


def join_targets(args: Sequence[str]) -> list[str]:
    """Joins the numbers of a target or command: an option has a fixed number of words.

    Args:
        args: The words of a command line.
    """
    joined: list[str] = []
    words = list(args)
    while words:
        word = words.pop(0)
        if word not in (TARGET, COMMAND) or not words:
            joined.append(word)
            continue
        numbers = [words.pop(0)]
        while words and len(numbers) < 3 and is_number(numbers[-1]) and is_number(words[0]):
            numbers.append(words.pop(0))
        joined.append(f"{word}={' '.join(numbers)}")
    return joined


def make_app(called: Container[str] = tuple(COMMANDS)) -> typer.Typer:
    """The commands.

    Args:
        called: Those whose modules are imported; the others have a name and a line of help.
    """
    app = typer.Typer(
        help="Learn safety assessments of robot motions from simulations, and use them before and "
        f"during motions. With {_DEBUG}, anywhere in the line, errors show their traceback.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(_common)
    for name, (module, line, *_) in COMMANDS.items():
        function: Any = _not_called
        if name in called:
            function = getattr(import_module(f"drake_safety.cli.{module}"), name)
        app.command(name, cls=_Command, short_help=line)(function)
    return app


def _not_called(scenario: ScenarioArgument) -> None:
    """Stands for a command in the help of others, and where a shell completes a scenario."""


def _called() -> list[str]:
    """The words of the command line; where a shell completes a word, only if it is an option."""
    line = os.environ.get("COMP_WORDS", os.environ.get("_TYPER_COMPLETE_ARGS"))
    if line is None:
        return sys.argv[1:]
    words = line.split()
    return words if words[-1].startswith("-") else []


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        found = installed_versions("drake")
        console.print(
            f"drake-safety {found['drake_safety']}, drake {found['drake']}, "
            f"Python {sys.version.split()[0]}",
            highlight=False,
        )
        raise typer.Exit()


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
    resumed = {name: one.resumed for name, one in COMMANDS.items() if one.resumed is not None}
    run_app(make_app(_called()), "drake-safety", resumed)


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
