"""Commands before training: ``drake-safety scenarios``, ``new`` and ``check``."""

from pathlib import Path
from typing import Annotated, Any

from rich.text import Text
from typer import Argument, Exit, Option

from drake_safety.assessments import assessed_scenarios
from drake_safety.cli import console
from drake_safety.extras import MissingExtraError
from drake_safety.importing.model_source import model_file
from drake_safety.importing.policy_template import survey_policy
from drake_safety.importing.robot_check import check_urdf
from drake_safety.importing.robot_template import write_robot
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.simulation.scenario import load_scenario, scenario_names
from drake_safety.simulation.scenario_check import check_scenario

_NUM_EPISODES = 16  # For the share of unsafe episodes.
_NEEDS = {"example-robot-data": "robots", ".onnx": "walking"}  # Extras by folder or suffix.


def scenarios() -> None:
    """List the scenarios that come with the package."""
    rows: list[tuple[str, ...]] = []
    trained = assessed_scenarios()
    for name in scenario_names():
        try:
            scenario = load_scenario(name)
            files = scenario.task_class().model_files(scenario)
            marks = {mark for file in files for mark in (*file.parts, file.suffix)}
            needs = ", ".join(extra for mark, extra in _NEEDS.items() if mark in marks)
            plants = ", ".join(scenario.variations)
        except MissingExtraError as error:
            needs, plants = error.needs, "–"
        rows.append((name, "yes" if name in trained else "no", needs, plants))
    console.show(console.new_table("scenario", "trained", "needs", "plants", rows=rows), width=80)
    console.say("trained: an assessment comes with the package; `train` learns that of any other")
    console.say("needs: extras; `make walking` installs both, and the policies that walk")


def new(
    name: Annotated[str, Argument(help="Name of the robot, and of its folder.")],
    model: Annotated[
        str,
        Option(
            *("--urdf", "--mjcf", "--robot-description"),
            metavar="FILE | NAME",
            help="Its model file, which may be xacro; or its name in robot_descriptions.",
        ),
    ],
    xacro_arg: Annotated[
        list[str] | None, Option(metavar="KEY=VALUE", help="An argument of xacro; repeatable.")
    ] = None,
    task: Annotated[str, Option(help="'balancing', 'reaching' or 'walking'.")] = "balancing",
    policy: Annotated[
        Path | None, Option(help="Walking: network, deploy.yaml or config.yaml.", dir_okay=False)
    ] = None,
    motors: Annotated[
        str | None, Option(help="Joints in the order of a deploy.yaml's motors, with commas.")
    ] = None,
    feet: Annotated[str | None, Option(help="Links on the ground; by default the lowest.")] = None,
    hands: Annotated[str | None, Option(help="Links that arms end in, with commas.")] = None,
    out: Annotated[Path | None, Option(help="Folder to write; NAME by default.")] = None,
) -> None:
    """Write the folder of a robot and a first scenario from a model file, for review.

    Values that the file does not have are marked ASK in the files, with their units.
    """
    if (task == "walking") != (policy is not None):
        raise ValueError(f"new: --policy is that of --task walking; got '{task}' and {policy}")
    arguments = dict(text.partition("=")[::2] for text in xacro_arg or [])
    if not all(arguments.values()):
        raise ValueError(f"new: --xacro-arg is KEY=VALUE; got {xacro_arg}")
    # Before anything is written.
    template = None if policy is None else survey_policy(policy, _names(motors), console.say)
    moved = () if template is None else template.joints or None
    options: dict[str, Any] = {"feet": _names(feet) or None, "hands": _names(hands) or None}
    options |= {"moved": moved, "xacro_arguments": arguments}
    written = write_robot(name, model_file(model), task, out or Path(name), **options)
    files, asked, sizes = written.files, written.asked, written.sizes
    if template is not None:
        more, unknown = template.write(written.folder, written.joints, written.posture)
        files, asked = [*files[:-1], *more, files[-1]], [*asked, *unknown]
    mass, height = f"{sizes.mass_kg:.1f} kg", f"{sizes.height_m:.3f} m"
    console.say(f"{name}: {mass}, its base '{sizes.base}' stands {height} high")
    console.say(f"posture {written.posture_source}")
    for path in files:
        console.say("wrote", path)
    if written.num_hulls:
        look = f"look at them by python -m pydrake.visualization.model_visualizer {files[0]}"
        console.say(f"{written.num_hulls} convex hulls replace collision meshes: {look}")
    for what in written.decided:
        console.say("decided", what)
    for what in (*written.copy.warnings, *written.copy.left_out):
        console.say(f"note  {what}", style="yellow")
    if bare := written.copy.bare_links:
        lost = f"{len(bare)} links have lost their collision meshes, and everything passes through"
        remedy = f"{', '.join(bare)}: add boxes or capsules to {files[0]}"
        console.say(f"WARNING  {lost} {remedy}", style="bold red")
    for what in asked:
        console.say(f"ask   {what}", style="yellow")
    console.say("next: drake-safety check", written.files[-1])


def _names(text: str | None) -> list[str]:
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def check(
    scenario: console.ScenarioArgument,
    quick: Annotated[bool, Option("--quick", help="Without what takes a minute.")] = False,
    import_: Annotated[
        bool, Option("--import/--no-import", help="Import the task, which runs a stranger's code.")
    ] = True,
) -> None:
    """Check a scenario and its robot, and print problems with their remedies.

    The exit code is 1 if there is a problem.
    """
    num_problems = 0
    with console.open_stages() as stages:
        for finding in check_scenario(
            scenario,
            num_episodes=0 if quick else _NUM_EPISODES,
            seed=DEMONSTRATION.first,
            is_imported=import_,
            check_robot=check_urdf,
            progress=stages,
        ):
            num_problems += not finding.is_ok
            word = ("problem", "red")
            if finding.is_ok:
                word = ("warning", "bold yellow") if finding.is_warning else ("OK     ", "green")
            remedy = f"\n     fix: {finding.remedy}" if finding.remedy else ""
            # A line of a file cannot look like a finding.
            lines = f"  {finding.item}: {finding.message}{remedy}".replace("\n", "\n    ")
            console.say(Text.assemble(word, lines))
    if num_problems:
        console.say(f"{num_problems} problem{'s' * (num_problems > 1)}", style="red")
        raise Exit(1)
    if not import_:
        return console.say("its files are right; nothing else is checked: its code was not run")
    if quick:
        console.say("not checked: the share of unsafe episodes, and the margins of a policy")
    console.say("ready: drake-safety train", scenario, "--out FOLDER")
