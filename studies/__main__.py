"""The studies' commands: ``python -m studies --help``."""

from __future__ import annotations

import typer

from drake_safety.cli import run_app
from studies.ablate import ablate
from studies.adaptation import adaptation
from studies.animation import animation
from studies.bench import bench
from studies.converged import converged
from studies.kills import kills
from studies.learning_curve import train_fewer
from studies.plan_study import plan_study
from studies.publish import readme, ship, store
from studies.readings import readings
from studies.scale import scale
from studies.soak import soak
from studies.truth import truth
from studies.walking import walking

app = typer.Typer(
    help="Run the studies behind the tables of README and docs, from a checkout.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(ablate)
app.command()(plan_study)
app.command("learning-curve")(train_fewer)
app.command()(adaptation)
app.command()(animation)
app.command()(readings)
app.command()(converged)
app.command()(kills)
app.command()(scale)
app.command()(soak)
app.command()(truth)
app.command()(walking)
app.command()(bench)
app.command()(store)
app.command()(readme)
app.command()(ship)


def main() -> None:
    """Runs the command."""
    run_app(app, "python -m studies")


if __name__ == "__main__":
    main()
