"""``drake-safety new``: a robot's folder and its first scenario, from a URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_safety.cli.console import console, print_path


def new(
    name: Annotated[str, typer.Argument(help="Name of the robot, and of its folder.")],
    urdf: Annotated[Path, typer.Option(help="Its URDF.", dir_okay=False)],
    task: Annotated[str, typer.Option(help="'balancing' or 'reaching'.")] = "balancing",
    feet: Annotated[
        str | None,
        typer.Option(help="Links that touch the ground, with commas; the lowest by default."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; NAME by default.")] = None,
) -> None:
    """Write a robot's folder and its first scenario from a URDF, to be looked over.

    What a URDF does not tell is marked ASK in the files, with its unit.
    """
    from drake_safety.robots.robot_template import write_robot

    written = write_robot(
        name,
        urdf,
        task,
        Path(name) if out is None else out,
        feet=None if feet is None else [link.strip() for link in feet.split(",")],
    )
    sizes = written.sizes
    console.print(
        f"{name}: {sizes.mass_kg:.1f} kg, its base '{sizes.base}' stands {sizes.height_m:.3f} m "
        "high",
        highlight=False,
        soft_wrap=True,
    )
    for path in written.files:
        print_path("wrote", path)
    for what in written.left_out:
        console.print("note ", what, style="yellow", highlight=False, markup=False, soft_wrap=True)
    for what in written.asked:
        console.print("ask  ", what, style="yellow", highlight=False, markup=False, soft_wrap=True)
    print_path("next: drake-safety check", written.files[-1])
