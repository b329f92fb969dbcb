"""Writes the report of a run: one self-contained HTML file, with figures and tables beside it."""

from __future__ import annotations

import base64
import gzip
import json
import shutil
from collections.abc import Collection, Mapping
from dataclasses import asdict
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from drake_safety.evaluation.embedding_figure import cause_colours
from drake_safety.evaluation.figure_style import save, spoken
from drake_safety.evaluation.report.cell_map import (
    map_cells,
    map_figure,
    map_views,
    safe_share,
)
from drake_safety.evaluation.report.run_folder import REPORT_FOLDER, Missing, Run
from drake_safety.evaluation.tables import Column
from drake_safety.evaluation.verdict_tables import verdict_tables
from drake_safety.extras import require_extra
from drake_safety.learning.assessment import SafetyAssessment

_MAX_SVG_BYTES = 1_500_000  # Larger figures are embedded as PNG.
_KNOWN_PREFIXES = ("segments", "episodes", "throws", "plans", "monitoring")
_SHARE = Column("", "", "%", digits=1)


def write_report(
    run: Run, *, versions: dict[str, str], angular_constraints: Collection[str] = ()
) -> Path:
    """Writes RUN/report: the page, every figure as SVG and PNG, every table as CSV and JSON.

    Args:
        run: Contents of the run; parts found missing are added to `run.missing`.
        versions: Versions of the packages that write the report.
        angular_constraints: Constraints whose margins are angles.

    Returns:
        Path of the page.
    """
    folder = run.folder / REPORT_FOLDER
    for name in ("figures", "tables"):
        # Figures of an earlier report must not be taken for those of this one.
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name).mkdir(parents=True)
    tables = verdict_tables(run.results)
    maps = {
        mode: _map(run, assessment, folder, angular_constraints)
        for mode, assessment in run.assessments.items()
    }
    pictures = _pictures(run, folder)
    page = (
        _environment()
        .get_template("page.html.j2")
        .render(
            run=run,
            style=_text("style.css"),
            script=_text("page.js"),
            words=_words("words.yaml"),
            scenario=run.scenario,
            counts=_counts(run),
            tiles=_tiles(run),
            paper=_beside_the_paper(run, pictures),
            tables=tables,
            pictures=pictures,
            motions=_motions(run, pictures),
            maps=maps,
            all_estimates=[
                (key, Column("", "", digits=4), estimate) for key, estimate in run.results.items()
            ],
            entries=run.results.entries,
            versions=versions,
        )
    )
    file = folder / "index.html"
    file.write_text(page, encoding="utf-8")
    return file


@cache
def _environment() -> Any:
    require_extra("report", "write_report")
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        loader=FunctionLoader(_text),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["spoken"] = spoken
    environment.filters["number"] = lambda value: f"{value:,}".replace(",", " ")
    return environment


def _text(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


@cache
def _words(name: str) -> Any:
    return yaml.safe_load(_text(name))


def _counts(run: Run) -> list[dict[str, Any]]:
    """Numbers and shares of the ends of training episodes, safe ones first."""
    causes = run.causes
    total = sum(causes.values())
    order = sorted(causes, key=lambda cause: (cause != "safe", -causes[cause]))
    names = [] if run.info is None else run.info.constraint_names
    palette = dict(zip(names, cause_colours(len(names)), strict=True))
    return [
        {
            "name": spoken(cause),
            "count": causes[cause],
            "share": causes[cause] / total,
            "colour": "var(--safe)" if cause == "safe" else palette.get(cause, "var(--faint)"),
        }
        for cause in order
    ]


def _tiles(run: Run) -> list[dict[str, str]]:
    """The most important estimates."""
    estimates = run.results
    tiles = []

    def add(key: str, title: str, remark: str, column: Column) -> None:
        estimate = estimates.get(key)
        if estimate is not None:
            tiles.append(
                {
                    "title": title,
                    "value": column.value_text(estimate),
                    "interval": column.interval_text(estimate),
                    "remark": f"{remark} ({estimate.n})",
                }
            )

    recall = Column("", "")
    add("throws.falls_without_recovery", "falls without recovery", "of fresh throws", _SHARE)
    add("throws.sharpened.falls_with_recovery", "falls with recovery", "of these throws", _SHARE)
    add("throws.sharpened.false_triggers", "false triggers", "of harmless throws", _SHARE)
    add("plans.sharpened.safe_recall", "safe recall", "of fresh, safe targets", recall)
    add(
        "plans.sharpened.unsafe_recall",
        "unsafe recall",
        "of fresh, unsafe targets",
        recall,
    )
    add("plans.causes.right_cause", "correct cause named", "of correctly refused targets", _SHARE)
    add("segments.sharpened.auc", "AUC of every segment", "fresh episodes; 1 is perfect", recall)
    return tiles[:4]


def _beside_the_paper(run: Run, pictures: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Results of the paper and the corresponding results of the run."""
    words = _words("paper.yaml")
    task = str(run.scenario.get("task", "")).rpartition(":")[2]
    chosen = [
        one
        for one in words["comparisons"]
        if one["task"] == task or (not task and run.results.has(one["figures"]))
    ]
    comparisons = []
    for one in chosen:
        values = [
            {
                "name": name,
                "paper": printed,
                "ours": column.value_text(run.results[key]),
                "interval": column.interval_text(run.results[key]),
            }
            for name, printed, key, unit in one.get("values", [])
            if key in run.results
            for column in [Column("", "", unit, digits=_digits(unit))]
        ]
        found = [p for name, p in pictures.items() if Path(name).name == one["picture"]]
        comparisons.append({**one, "values": values, "found": found[0] if found else None})
    parameters = []
    learned = run.assessments.get("paper") or run.assessments.get("sharpened")
    if chosen and learned is not None:
        ours = asdict(learned.parameters)
        for key, symbol, meaning, printed in words["parameters"]:
            value = printed.get(chosen[0]["task"]) if isinstance(printed, dict) else printed
            parameters.append((spoken(key), symbol, meaning, value, ours[key]))
    return {"comparisons": comparisons, "parameters": parameters}


def _digits(unit: str) -> int:
    return {"%": 1, "=": 2}.get(unit, 3)


def _pictures(run: Run, folder: Path) -> dict[str, dict[str, Any]]:
    """Copies every picture; returns what the page shows of each, by name."""
    known = _words("words.yaml")["pictures"]
    shown = {}
    # In the order of words.yaml, all others after them.
    order = {stem: i for i, stem in enumerate(known)}
    names = sorted(run.pictures, key=lambda name: (order.get(Path(name).name, len(order)), name))
    for name in names:
        flat = name.replace("/", "_")
        for suffix, path in run.pictures[name].items():
            shutil.copyfile(path, folder / "figures" / f"{flat}{suffix}")
        shown[name] = _shown(name, run.pictures[name])
    return shown


def _shown(name: str, paths: Mapping[str, Path]) -> dict[str, Any]:
    """What the page shows of a picture, given its files by suffix."""
    stem, flat = Path(name).name, name.replace("/", "_")
    svg, png = paths.get(".svg"), paths.get(".png")
    is_light = svg is not None and (png is None or svg.stat().st_size <= _MAX_SVG_BYTES)
    chosen = svg if svg is not None and is_light else paths[".png"]
    kind = "svg+xml" if chosen.suffix == ".svg" else "png"
    content = base64.b64encode(chosen.read_bytes()).decode("ascii")
    words = _words("words.yaml")["pictures"].get(stem, {})
    is_calibration = any(word in stem for word in ("calibration", "reliability"))
    return {
        "name": name,
        "stem": stem,
        "title": words.get("title", spoken(stem).capitalize()),
        "caption": words.get("caption", ""),
        "source": f"data:image/{kind};base64,{content}",
        "files": [f"figures/{flat}{suffix}" for suffix in paths],
        "section": "calibration" if is_calibration else "verdicts",
    }


def _motions(run: Run, pictures: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {
            "name": motion.name,
            "events": motion.events,
            "timeline": pictures.get(f"{motion.name}/timeline"),
            # A few megabytes, unpacked by the page on demand.
            "recording": None
            if motion.recording is None
            else base64.b64encode(gzip.compress(motion.recording.read_bytes(), mtime=0)).decode(),
        }
        for motion in run.motions
    ]


def _map(
    run: Run, assessment: SafetyAssessment, folder: Path, angular_constraints: Collection[str]
) -> dict[str, Any]:
    mode = assessment.parameters.mode
    info = assessment.info_
    is_own = run.info is not None and run.info.scenario_hash == info.scenario_hash
    try:
        cells = map_cells(
            assessment,
            run.episodes if is_own else None,
            angular_constraints=angular_constraints,
        )
    except ValueError as error:
        run.missing.append(Missing(what=f"Typical episodes of the map “{mode}”", why=str(error)))
        cells = map_cells(assessment)
    save(map_figure(assessment, cells), folder / "figures" / f"map_{mode}")
    _save_cells(mode, cells, info.constraint_names, folder / "tables")
    views = map_views(assessment, cells)
    return {
        "mode": mode,
        "resolution": assessment.grid_.resolution,
        "min_count": assessment.parameters.min_count,
        "num_members": assessment.beliefs_.shape[0],
        "horizon_s": info.horizon * info.preview_step_s,
        "causes": [spoken(name) for name in info.constraint_names],
        "colours": cause_colours(len(info.constraint_names)),
        "units": ["°" if name in angular_constraints else "cm" for name in info.constraint_names],
        "cells": cells,
        "views": views,
        "labels": [_cell_label(cell, info.constraint_names) for cell in cells],
    }


def _cell_label(cell: dict[str, Any], names: list[str]) -> str:
    """Text of a cell for screen readers."""
    place = f"Cell {cell['column'] + 1}, {cell['row'] + 1}"
    if cell["belief"][2] >= 1.0:
        return f"{place}: empty, {cell['count']} segments, don't know"
    words = f"{place}: {100 * safe_share(cell):.0f} % of what is known is safe"
    words += f", {100 * cell['belief'][2]:.0f} % don't know, {cell['count']} segments"
    if max(cell["causes"]) > 0.005:
        words += f", likely cause {spoken(names[cell['causes'].index(max(cell['causes']))])}"
    return words


def _save_cells(mode: str, cells: list[dict[str, Any]], names: list[str], folder: Path) -> None:
    text = json.dumps({"mode": mode, "constraints": names, "cells": cells})
    (folder / f"cells_{mode}.json").write_text(text + "\n", encoding="utf-8")
    header = ["column", "row", "safe", "unsafe", "unknown", "segments", *names, "typical_episode"]
    lines = [",".join(header)]
    for cell in cells:
        typical = cell["typical"]
        values = [cell["column"], cell["row"], *cell["belief"], cell["count"], *cell["causes"]]
        lines.append(",".join(map(str, [*values, typical["episode"] if typical else ""])))
    (folder / f"cells_{mode}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
