"""``drake-safety export``: Γ as one ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    console,
    print_path,
    print_shipped,
)
from drake_safety.cli.training_folder import (
    MODES,
    assessment_folder,
    check_fresh,
    check_writable,
    load_assessment,
)
from drake_safety.simulation.scenario import load_scenario


def export(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = MODES[0],
    out: Annotated[Path, typer.Option(help="The file.", dir_okay=False)] = Path("gamma.onnx"),
) -> None:
    """Write Γ as one ONNX file, which runs without this package and without Drake.

    It holds the maps, the grid, the beliefs and the correction of the assessment, adapted or not;
    its metadata say what its inputs are and what its thresholds promise.
    """
    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, assessment)
    gamma = load_assessment(folder.path, mode)
    check_fresh(gamma, loaded)
    check_writable(out.parent)
    print_shipped(folder)
    out.parent.mkdir(parents=True, exist_ok=True)
    gamma.to_onnx(out)
    lines: dict[str, str] = {
        one.kind: f"safe from {one.threshold:.4f}, unsafe below {one.unsafe_below:.4f}: "
        f"{one.promise}"
        for one in gamma.calibrations_.values()
    }
    if not lines:
        lines["thresholds"] = "none: `drake-safety calibrate` chooses them for a promised miss rate"
    for name, text in lines.items():
        console.print(f"{name:<16}  {text}", highlight=False, soft_wrap=True)
    print_path(f"written           {out.stat().st_size / 1e6:.2f} MB,", out)
