"""``drake-safety compare``: one table of several scenarios."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_safety.cli.console import (
    ClusterOption,
    WorkersOption,
    command_line,
    console,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import check_writable

if TYPE_CHECKING:
    from drake_safety.evaluation.tables import Table


def compare(
    scenarios: Annotated[
        list[str], typer.Argument(help="Names of scenarios, or paths of YAML files.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the table and a subfolder per scenario.")],
    episodes: Annotated[int, typer.Option(help="Nominal training episodes.", min=20)] = 2048,
    fresh: Annotated[int, typer.Option(help="Fresh nominal episodes for tests.", min=20)] = 500,
    throws: Annotated[
        int, typer.Option(help="Fresh throws at the actual plant, for tasks with recovery.", min=1)
    ] = 300,
    seed: Annotated[int, typer.Option(help="Seed.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Train and evaluate scenarios in one table: recalls, falls with and without recovery.

    Without recovery only plans are evaluated. A figure shows the robots. A stopped comparison
    continues when called again; finished rows are kept.
    """
    from drake_safety.evaluation.comparison import (
        Effort,
        compare_scenario,
        comparison_table,
    )
    from drake_safety.evaluation.comparison_figure import comparison_figure, standing_still
    from drake_safety.evaluation.figure_style import save
    from drake_safety.simulation.scenario import load_scenario

    loaded = [load_scenario(name) for name in scenarios]
    names = [scenario.name for scenario in loaded]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"compare: {twice} are named more than once")
    effort = Effort(num_episodes=episodes, num_fresh=fresh, num_throws=throws, seed=seed)
    check_writable(out)
    rows = []
    with open_stages() as stages:
        for scenario in loaded:
            row = compare_scenario(
                scenario, out / scenario.name, effort, num_workers=workers, progress=stages
            )
            rows.append(row)
            # After every row, so that finished rows can be read during the next.
            _write(out, rows, comparison_table(rows))
    console.print(comparison_table(rows).to_rich())
    for suffix in ("json", "md"):
        print_path("table", out / f"comparison.{suffix}")
    found = {scenario.name: standing_still(scenario.make_loop()) for scenario in loaded}
    stills = {name: still for name, still in found.items() if still is not None}
    if stills:
        for picture in save(comparison_figure(rows, stills), out / "comparison"):
            print_path("picture", picture)


def _write(out: Path, rows: list[dict[str, object]], table: Table) -> None:
    report = {"command": command_line(), "versions": versions(), "rows": rows}
    texts = {
        "json": json.dumps(report, indent=2) + "\n",
        "md": table.to_markdown() + "\n",
    }
    for suffix, text in texts.items():
        (out / f"comparison.{suffix}").write_text(text, encoding="utf-8")
