"""Commands before training: ``drake-safety scenarios``, ``new`` and ``check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from drake_safety.cli.console import ScenarioArgument, console, new_table, open_stages, print_path
from drake_safety.control.policy_template import survey_policy
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.robot_figure import robot_figure
from drake_safety.extras import MissingExtraError
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.robots.robot_template import write_robot
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import load_scenario, scenario_names
from drake_safety.simulation.scenario_check import check_scenario

# By whether a check passed, and whether with a warning.
_WORDS = {
    (True, False): ("OK     ", "green"),
    (True, True): ("warning", "bold yellow"),
    (False, False): ("problem", "red"),
}


def scenarios() -> None:
    """List the scenarios that come with the package."""
    table = new_table("scenario", "task", "robot", "plants", "horizon", "needs")
    for name in scenario_names():
        try:
            scenario = load_scenario(name)
            scenario.task_class().model_files(scenario)
        except MissingExtraError as error:
            table.add_row(name, *4 * ["–"], error.needs)
            continue
        horizon_s = scenario.assessment.horizon * scenario.preview_step_s
        table.add_row(
            name,
            scenario.task.rpartition(":")[2],
            scenario.robot,
            ", ".join(scenario.variations),
            f"{scenario.assessment.horizon} steps, {horizon_s:g} s",
            "",
        )
    console.print(table)


def new(
    name: Annotated[str, typer.Argument(help="Name of the robot, and of its folder.")],
    urdf: Annotated[Path, typer.Option(help="Its URDF.", dir_okay=False)],
    task: Annotated[str, typer.Option(help="'balancing', 'reaching' or 'walking'.")] = "balancing",
    policy: Annotated[
        Path | None,
        typer.Option(
            help="For 'walking': its network (.onnx, .pt), a deploy.yaml of unitree_rl_lab or a "
            "config.yaml of rl_sar.",
            dir_okay=False,
        ),
    ] = None,
    motors: Annotated[
        str | None,
        typer.Option(
            help="Joints in the order of the robot's motors, with commas, for a deploy.yaml, which "
            "numbers them."
        ),
    ] = None,
    feet: Annotated[
        str | None,
        typer.Option(help="Links that touch the ground, with commas; the lowest by default."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; NAME by default.")] = None,
) -> None:
    """Write the folder of a robot and a first scenario from a URDF, for review.

    Values that a URDF does not have are marked ASK in the files, with their units.
    """
    if (task == "walking") != (policy is not None):
        raise ValueError(
            f"new: --policy is that of --task walking, and of no other; got task '{task}' and "
            f"policy {policy}"
        )
    # Before anything is written.
    template = None if policy is None else survey_policy(policy, _names(motors))
    written = write_robot(
        name,
        urdf,
        task,
        Path(name) if out is None else out,
        feet=_names(feet) or None,
        moved=() if template is None else template.joints or None,
    )
    files, asked = written.files, written.asked
    if template is not None:
        more, unknown = template.write(written.folder, written.joints, written.posture)
        files, asked = [*files[:-1], *more, files[-1]], [*asked, *unknown]
    mass_kg, height_m = written.sizes.mass_kg, written.sizes.height_m
    _say(f"{name}: {mass_kg:.1f} kg, its base '{written.sizes.base}' stands {height_m:.3f} m high")
    for path in files:
        print_path("wrote", path)
    if written.num_hulls:
        _say(
            f"{written.num_hulls} convex hulls replace collision meshes that Drake does not read. "
            f"Look at them: drake-safety check {written.files[-1]} --picture FILE"
        )
    for what in written.copy.left_out:
        _say(f"note  {what}", "yellow")
    if written.bare:
        _say(
            f"WARNING  {len(written.bare)} links have lost their collision meshes, which are "
            "missing or cannot be read: everything passes through "
            f"{', '.join(written.bare)}. Add boxes or capsules to {files[0]}; `check` reminds you",
            "bold red",
        )
    for what in asked:
        _say(f"ask   {what}", "yellow")
    print_path("next: drake-safety check", written.files[-1])


def _say(text: str, style: str | None = None) -> None:
    console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


def _names(text: str | None) -> list[str]:
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def check(
    scenario: ScenarioArgument,
    episodes: Annotated[
        int, typer.Option(help="Episodes simulated for the share of unsafe ones.", min=0)
    ] = 16,
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave these episodes out, as by --episodes 0.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of these episodes.")] = DEMONSTRATION.first,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Draw the standing robot beside its collision shapes, as FILE.png and FILE.svg.",
            dir_okay=False,
        ),
    ] = None,
    import_: Annotated[
        bool,
        typer.Option(
            "--import/--no-import",
            help="Import the scenario's task, which runs its code. Without, only its files are "
            "checked: for a scenario from a stranger.",
        ),
    ] = True,
) -> None:
    """Check a scenario and its robot, and print problems with their remedies.

    The exit code is 1 if there is a problem.
    """
    if picture is not None and not import_:
        raise ValueError("check: --picture needs the task, which --no-import does not import")
    num_problems = 0
    with open_stages() as stages:
        for finding in check_scenario(
            scenario,
            num_episodes=0 if quick else episodes,
            seed=seed,
            is_imported=import_,
            progress=stages,
        ):
            num_problems += not finding.is_ok
            word, style = _WORDS[finding.is_ok, finding.is_warning]
            text = Text.assemble((word, style), f"  {finding.item}: {finding.message}")
            if finding.remedy:
                text.append(f"\n         fix: {finding.remedy}")
            console.print(text, highlight=False, soft_wrap=True)
    if picture is not None:
        _draw(scenario, picture)
    if num_problems:
        console.print(f"{num_problems} problems", style="red", highlight=False)
        raise typer.Exit(1)
    if import_:
        if quick:
            console.print(
                "not checked: the share of unsafe episodes; leave out --quick before you train",
                highlight=False,
            )
        console.print("ready: drake-safety train", scenario, "--out FOLDER", highlight=False)
    else:
        console.print("its files are right; its code was not run", highlight=False)


def _draw(scenario: str, picture: Path) -> None:
    """Draws a robot beside its collision shapes.

    Raises:
        ValueError: The scenario has no legged robot, or its diagram cannot be built.
    """
    loop = load_scenario(scenario).make_loop()
    if not isinstance(loop, LeggedLoop):
        raise ValueError(
            f"check: --picture draws a legged robot; task '{type(loop).__name__}' has none"
        )
    for path in save(robot_figure(loop), picture):
        print_path("picture", path)
