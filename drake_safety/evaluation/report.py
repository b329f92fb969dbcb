"""The report of a run: what was judged and how, as one self-contained HTML page."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from drake_safety.evaluation.figure_style import label_of, spoken
from drake_safety.evaluation.results import SCHEMA, Results
from drake_safety.evaluation.shift_study import shifts_tables
from drake_safety.evaluation.tables import Column
from drake_safety.evaluation.verdict_tables import MEANINGS, set_title, verdict_tables
from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.dataset import read_info

REPORT_FILE = "report.html"
_NUMBER = Column("", "", digits=4)


def write_report(folder: Path, *, episodes: Path, versions: Mapping[str, str]) -> Path:
    """Writes the page into the folder of a run, from what is there.

    Assessments, results and pictures are those of `train`, `calibrate`, `evaluate`, `run` and
    `adapt`. Recordings are linked, all else is inside the page. The command of the training names
    ``episodes``.
    """
    require_extra("report", "report")
    from jinja2 import Environment, StrictUndefined

    if not folder.is_dir():
        raise ValueError(f"report: there is no folder '{folder}'")
    files_of_modes = sorted(folder.glob("*.safetensors"), reverse=True)  # "sharpened" first.
    assessments = {path.stem: SafetyAssessment.load(path) for path in files_of_modes}
    results = [
        Results.read(path)
        for path in sorted(folder.glob("*.json"))
        if SCHEMA in path.read_text(encoding="utf-8", errors="replace")
    ]
    if not assessments and not results:
        there = sorted(path.name for path in folder.iterdir())[:8]
        raise ValueError(
            f"report: '{folder}' holds neither an assessment nor results, but {there}; "
            "`drake-safety train` and `evaluate` write them"
        )
    infos = [assessment.info_ for assessment in assessments.values()]
    tables = [(one, [*verdict_tables(one), *shifts_tables(one)]) for one in results]
    columns = {one.key: one for _, found in tables for table in found for one in table.columns}
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"spoken": spoken, "label": label_of, "set_title": set_title}
    text = files(__package__).joinpath("report.html.j2").read_text(encoding="utf-8")
    page = environment.from_string(text).render(
        folder=folder.resolve().name,
        name=infos[0].scenario if infos else results[0].entries.get("scenario", folder.name),
        assessments=assessments,
        training=read_info(episodes)[1].get("command", "") if episodes.is_dir() else "",
        results=tables,
        meanings=[(columns[key].title, MEANINGS[key]) for key in columns if key in MEANINGS],
        number=_NUMBER,
        motions=_motions(folder),
        pictures=_pictures(folder),
        versions=versions,
    )
    file = folder / REPORT_FILE
    write_file(file, page)
    return file


def _motions(folder: Path) -> list[dict[str, Any]]:
    """Folders of recorded motions: their events, as `run` writes them, pictures and recording."""
    found = {path.parent for name in ("run.json", "recording.html") for path in folder.rglob(name)}
    motions: list[dict[str, Any]] = []
    for one in sorted(found):
        motions.append({"name": one.relative_to(folder).as_posix(), "pictures": _pictures(one)})
        if (events := one / "run.json").is_file():
            motions[-1]["events"] = json.loads(events.read_text(encoding="utf-8"))
        if (recording := one / "recording.html").is_file():
            motions[-1]["recording"] = recording.relative_to(folder).as_posix()
    return motions


def _pictures(folder: Path) -> list[tuple[str, str]]:
    """Titles and data URLs of the pictures in a folder."""
    return [
        (
            spoken(path.stem).capitalize(),
            f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}",
        )
        for path in sorted(folder.glob("*.png"))
    ]
