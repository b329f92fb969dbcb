"""The report of a run: its tables and pictures as one self-contained HTML page."""

import base64
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from drake_safety.evaluation.figure_style import label_of, spoken
from drake_safety.evaluation.results import SCHEMA, Results
from drake_safety.evaluation.shift_study import shifts_tables
from drake_safety.evaluation.verdict_tables import verdict_tables
from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.dataset import read_info


def write_report(folder: Path, *, episodes: Path, versions: Mapping[str, str]) -> Path:
    """Writes ``report.html`` into the folder of a run; only recordings are outside the page."""
    require_extra("report", "report")
    from jinja2 import Environment, StrictUndefined

    if not folder.is_dir():
        raise ValueError(f"report: folder '{folder}' does not exist")
    files_of_modes = sorted(folder.glob("*.safetensors"), reverse=True)  # "sharpened" first.
    assessments = {path.stem: SafetyAssessment.load(path) for path in files_of_modes}
    results = [
        Results.read(path)
        for path in sorted(folder.glob("*.json"))
        if SCHEMA in path.read_text(encoding="utf-8", errors="replace")
    ]
    if not assessments and not results:
        there = sorted(path.name for path in folder.iterdir())[:8]
        raise ValueError(f"'{folder}' holds neither an assessment nor results, but {there}")
    names = [one.info_.scenario for one in assessments.values()]
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"spoken": spoken, "label": label_of}
    text = files(__package__).joinpath("report.html.j2").read_text(encoding="utf-8")
    # Folders of recorded motions, and pictures in none of them.
    motions = {path.parent for path in folder.rglob("recording.html")}
    page = environment.from_string(text).render(
        folder=folder.resolve().name,
        name=names[0] if names else results[0].entries.get("scenario", folder.name),
        assessments=assessments,
        training=read_info(episodes)[1].get("command", "") if episodes.is_dir() else "",
        results=[(one.entries, [*verdict_tables(one), *shifts_tables(one)]) for one in results],
        motions=[(one.relative_to(folder).as_posix(), _pictures(one)) for one in sorted(motions)],
        pictures=_pictures(folder),
        versions=versions,
    )
    write_file(file := folder / "report.html", page)
    return file


def _pictures(folder: Path) -> list[tuple[str, str]]:
    """Titles and data URLs of the pictures in a folder."""
    pictures = []
    for path in sorted(folder.glob("*.png")):
        content = base64.b64encode(path.read_bytes()).decode("ascii")
        pictures.append((spoken(path.stem).capitalize(), f"data:image/png;base64,{content}"))
    return pictures
