"""``drake-safety export`` and ``report``: files for readers without this package."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES


def export(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    mode: console.ModeOption = MODES[0],
    out: Annotated[
        Path, Option(help="The file: ONNX, or C if its name ends in .c.", dir_okay=False)
    ] = Path("gamma.onnx"),
    part: Annotated[
        str, Option(help="Part in an ONNX file: 'gamma', 'assessor' or 'monitor'; C has all.")
    ] = "gamma",
    prefix: Annotated[
        str | None, Option(help="Prefix of all names in C; by default the file's name.")
    ] = None,
) -> None:
    """Write Γ as one ONNX or C file, which runs without this package and without Drake."""
    if out.suffix not in (".onnx", ".c"):
        raise ValueError(f"export: --out must end in .onnx or .c; got '{out}'")
    is_c = out.suffix == ".c"
    if (is_c and part != "gamma") or (prefix is not None and not is_c):
        raise ValueError("export: --part belongs to an ONNX file, --prefix to C")
    *_, gamma = folders.open_assessment(scenario, assessment, mode)
    folders.check_writable(out.parent)
    written = [out]
    if is_c:
        written = gamma.to_c(out, prefix)
    else:
        gamma.to_onnx(out, part)
    for one in gamma.calibrations_.values():
        verdicts = f"safe from {one.threshold:.4f}, unsafe below {one.unsafe_below:.4f}"
        console.say(f"{one.kind:<16}  {verdicts}: {one.promise}")
    for file in written:
        console.say(f"written           {file.stat().st_size / 1e6:.2f} MB,", file)


def report(
    run: Annotated[Path, Argument(help="Folder written by `train` and other commands.")],
) -> None:
    """Write RUN/report.html, a self-contained page of what is there."""
    from drake_safety.evaluation.report import write_report

    written = write_report(run, episodes=folders.episodes_folder(run), versions=console.versions())
    console.say("page", written)
