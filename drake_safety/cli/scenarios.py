"""``drake-safety scenarios``."""

from __future__ import annotations

from drake_safety.cli.console import console, new_table


def scenarios() -> None:
    """List the scenarios that come with the package."""
    from drake_safety.robots.model_files import MissingExtraError
    from drake_safety.simulation.scenario import load_scenario, scenario_names

    table = new_table("scenario", "task", "robot", "plants", "horizon", "needs")
    for name in scenario_names():
        try:
            scenario = load_scenario(name)
            scenario.task_class().model_files(scenario)
        except MissingExtraError:
            table.add_row(name, *4 * ["–"], "drake_safety[robots]")
            continue
        horizon_s = scenario.assessment.horizon * scenario.step_s
        table.add_row(
            name,
            scenario.task.rpartition(":")[2],
            scenario.robot,
            ", ".join(scenario.variations),
            f"{scenario.assessment.horizon} steps, {horizon_s:g} s",
            "",
        )
    console.print(table)
