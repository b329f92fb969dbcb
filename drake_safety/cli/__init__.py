"""The command ``drake-safety``: train, run and evaluate safety assessments.

Another command is a function of the command's name (its arguments are the command line, its
docstring the help), an entry of `COMMANDS` and an example in `commands.txt`. Only the module of the
command that is called is imported.
"""

import logging
import re
import signal
import sys
import traceback
from collections.abc import Callable, Container, Sequence
from importlib import import_module
from importlib.resources import files
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from typer.core import TyperCommand, TyperGroup

from drake_safety.cli import console
from drake_safety.extras import require_extra
from drake_safety.files.reading import is_number
from drake_safety.learning.segments import EpisodeError, installed_versions

COMMANDS = {
    "scenarios": ("prepare", "", "List the scenarios that come with the package."),
    "new": ("prepare", "", "Write a robot's folder and a first scenario from a URDF or an MJCF."),
    "check": ("prepare", "", "Check a scenario and its robot, and print problems with remedies."),
    "train": ("train", "train", "Simulate the nominal and random plants, and train Γ."),
    "calibrate": ("calibrate", "train", "Choose thresholds with a promised miss rate."),
    "ask": ("ask", "", "Print the verdict on a target, or on a command of a walking robot."),
    "run": ("run", "", "Simulate once with Γ in the loop; write a recording and a timeline."),
    "play": ("play", "live", "Simulate a task on a page in the browser, in real time."),
    "evaluate": ("evaluate", "train", "Evaluate Γ on fresh episodes, throws and other plants."),
    "gate": ("gate", "", "Decide whether a candidate fails more often than the baseline."),
    "rate": ("rate", "", "Estimate a failure rate from few episodes, also of rare failures."),
    "pushes": ("pushes", "", "Find the smallest pushes that make a robot fall, all around it."),
    "adapt": ("adapt", "train", "Adapt Γ to an actual robot, and say whether it is better."),
    "monitor": ("monitor", "", "Run the change monitor over logs of a robot."),
    "export": ("export", "", "Write Γ as one ONNX or C file."),
    "report": ("export", "report", "Write RUN/report.html, a self-contained page of a run."),
}
"""Module, the extra that it needs, and a line of help."""
EXAMPLES = files("drake_safety.diagrams").joinpath("commands.txt").read_text(encoding="utf-8")
"""A line for each command, in the order of the help: its group, then an example."""
_DEBUG = "--debug"
_STOPPED = 130  # Exit code after Ctrl-C.
_ERRORS = {"gate": 3}  # Exit codes of errors where 1 and 2 are results.
# An argument with its type in the help, or the type behind an option.
_TYPED = re.compile(r"^(\w[\w.]*) <.*|<(?:list\[)?(\w+)[^>]*>")


class _Group(TyperGroup):
    """The commands, in groups."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes the commands' lines of help."""
        listed = re.findall(r"(?m)^(\w+) +(\w+)", EXAMPLES)
        for group in dict(listed):
            with formatter.section(group):
                names = [name for its_group, name in listed if its_group == group]
                formatter.write_dl([(f"{name:<9}", COMMANDS[name][2]) for name in names])


class _Command(TyperCommand):
    """A command whose extra is installed, and whose ``--cluster`` is connected while it runs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the arguments, of which the three numbers of a target are one value."""
        return super().parse_args(ctx, join_targets(args))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments, by words in capitals."""
        return [piece.strip("{}").upper() for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes arguments and options, with words in capitals for their values."""
        write, word = formatter.write_dl, lambda match: (match[1] or match[2]).upper()
        formatter.write_dl = lambda rows: write([(_TYPED.sub(word, n), text) for n, text in rows])
        super().format_options(ctx, formatter)

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        name = self.name or ""
        if extra := COMMANDS[name][1]:
            require_extra(extra, name)
        address = ctx.params.get("cluster")
        if address is None:
            return super().invoke(ctx)
        from drake_safety.simulation.cluster import connected

        with connected(address):
            return super().invoke(ctx)


def join_targets(args: Sequence[str]) -> list[str]:
    """Joins the three numbers of a target or command, which may as well be a name."""
    words = list(args)
    for i, word in enumerate(words):
        numbers = words[i + 1 : i + 4]
        if word in ("--target", "--command") and len(numbers) == 3 and all(map(is_number, numbers)):
            words[i + 1 : i + 4] = [" ".join(numbers)]
    return words


def make_app(called: Container[str] = tuple(COMMANDS)) -> typer.Typer:
    """Builds the commands; a command that is not called has a name and a line of help."""
    app = typer.Typer(
        cls=_Group,
        help="Γ, learned from simulated episodes, predicts from a robot's state and plan whether "
        "its motion stays safe. COMMAND --help shows a command's options and an example. With "
        f"{_DEBUG}, anywhere in the line, errors show their traceback.",
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(_common)
    for name, (module, _, line) in COMMANDS.items():
        function: Any = _not_called
        if name in called:
            function = getattr(import_module(f"drake_safety.cli.{module}"), name)
        (example,) = re.findall(rf"(?m)^\w+ +({name}\b.*)", EXAMPLES)
        epilog = f"Example:\n\n\b\ndrake-safety {example}"
        app.command(name, cls=_Command, short_help=line, epilog=epilog)(function)
    return app


def _not_called(scenario: console.ScenarioArgument) -> None:
    """Stands for a command in the help of others."""


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        versions, python = installed_versions("drake"), sys.version.split()[0]
        own, drake = versions["drake_safety"], versions["drake"]
        console.say(f"drake-safety {own}, drake {drake}, Python {python}")
        raise typer.Exit()


def _common(
    version: Annotated[
        bool,
        typer.Option("--version", help="Versions.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Runs the command."""
    # An import that fails is an error of the command.
    run_app(lambda *given, **options: make_app(sys.argv[1:])(*given, **options), "drake-safety")


def run_app(commands: Callable[..., Any], program: str) -> None:
    """Runs a command; user errors are one line, with --debug a traceback; SIGTERM is as Ctrl-C."""
    # A program that reads a pipe gets results alone.
    log = console.console if console.console.is_terminal else Console(stderr=True)
    handler = RichHandler(console=log, show_path=False)
    logging.getLogger("drake_safety").addHandler(handler)
    # Commands that keep a page open print its address themselves.
    logging.getLogger("drake").setLevel(logging.WARNING)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments = [argument for argument in sys.argv[1:] if argument != _DEBUG] or ["--help"]
    name = arguments[0]
    try:
        code = commands(arguments, prog_name=program, standalone_mode=False)
        if code == _STOPPED:  # Typer's own answer to Ctrl-C.
            raise KeyboardInterrupt
    except (typer.Abort, KeyboardInterrupt):
        console.say(
            "stopped; finished episodes are kept: the same command continues (train: with --resume)"
        )
        sys.exit(_STOPPED)
    except (Exception, SystemExit) as error:
        if isinstance(error, (ValueError, OSError, EpisodeError)) and _DEBUG not in sys.argv:
            console.say("error:", error, style="red")
        elif hasattr(error, "format_message"):  # Typer's own: unknown options, wrong types.
            console.say("error:", error.format_message(), style="red")
        elif name in _ERRORS:
            traceback.print_exception(error)
        else:
            raise
        sys.exit(_ERRORS.get(name, 2))
    sys.exit(code)
