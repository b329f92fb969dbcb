"""The studies' commands: ``python -m studies --help``."""

from collections.abc import Callable

import typer

from drake_safety.cli import run_app
from studies.adaptation import adaptation
from studies.evaluate import evaluate
from studies.features import features
from studies.figures import figures
from studies.gate import gate
from studies.publish import readme, ship, store
from studies.rapt import rapt
from studies.rare import rare
from studies.tutorials import tutorials
from studies.walking import walking

app = typer.Typer(
    help="Run the studies behind the tables of README and docs, from a checkout.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_COMMANDS: tuple[Callable[..., None], ...] = (
    *(evaluate, adaptation, features, gate, rapt, rare, walking),
    *(figures, store, readme, ship, tutorials),
)
for _command in _COMMANDS:
    app.command()(_command)


def main() -> None:
    """Runs the command."""
    run_app(app, "python -m studies")


if __name__ == "__main__":
    main()
