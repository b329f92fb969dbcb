"""``python -m studies tutorials``: runs the tutorials and keeps the outputs that the site shows."""

import base64
import hashlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_safety.assessments import assessed_scenarios, shipped_folder
from drake_safety.cli.console import say
from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.assessment_file import file_hash

TUTORIALS = Path("tutorials")
OUTPUTS = TUTORIALS / "outputs"
_MOST_BYTES = 60_000  # Largest picture.
_COLOURS = (256, 64, 16)
_WIDTHS = (1000, 800, 640, 480, 320)  # [px]
_TIME = """\
import psutil
_one = psutil.Process()
_times = [_one.cpu_times()[:4], *(of.cpu_times()[:2] for of in _one.children(recursive=True))]
print(sum(map(sum, _times)))"""
"""Prints the time of the kernel and its processes [s]."""


def tutorials(
    names: Annotated[
        list[str] | None, typer.Argument(help="Numbers or names of tutorials; all by default.")
    ] = None,
) -> None:
    """Run the tutorials one by one and keep their outputs in tutorials/outputs/NAME.json.

    A file has the outputs of every cell of code, the time of one core [s], and a hash of its code.
    """
    there = {path.stem: path for path in sorted(TUTORIALS.glob("*.ipynb"))}
    for name in names or there:
        found = [stem for stem in there if stem == name or stem.partition("_")[0] == name]
        if not found:
            raise ValueError(f"no tutorial '{name}'; the tutorials are {list(there)}")
        file = OUTPUTS / f"{found[0]}.json"
        file.parent.mkdir(exist_ok=True)
        text = json.dumps(run(there[found[0]]), indent=1, ensure_ascii=False)
        write_file(file, f"{text}\n")
        say("outputs in", file)


def source_hash(notebook: Mapping[str, Any]) -> str:
    """SHA-256 of the cells of code, and of the shipped assessments that they name."""
    cells = [one["source"] for one in notebook["cells"] if one["cell_type"] == "code"]
    code = "\0".join(map("".join, cells))
    shipped = [
        file_hash(file)
        for name in assessed_scenarios()
        if f'"{name}"' in code and "load_assessment" in code
        for file in sorted(shipped_folder(name).glob("*.safetensors"))
    ]
    return hashlib.sha256("\0".join([code, *shipped]).encode()).hexdigest()


def run(path: Path) -> dict[str, Any]:
    """Runs a notebook in a folder of its own: outputs by cell, time of one core [s], and hash."""
    require_extra("tutorials", "tutorials", "nbclient", "ipykernel")
    import nbclient
    import nbformat

    paths = [str(Path.cwd()), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(_TIME))
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(
            notebook, timeout=None, startup_timeout=300, resources=resources
        ).execute()
    core_s = float(notebook.cells.pop().outputs[0]["text"])
    return {
        "source_sha256": source_hash(notebook),
        "core_s": round(core_s, 1),
        "cells": [
            [kept for one in cell.outputs if (kept := _kept(one, [folder, sys.prefix, paths[0]]))]
            for cell in notebook.cells
            if cell.cell_type == "code"
        ],
    }


def _kept(output: Mapping[str, Any], folders: Sequence[str]) -> dict[str, str] | None:
    """An output as the site shows it: a picture, or a text without progress."""
    data = output.get("data", {})
    if "image/png" in data:
        return {"png": _small(data["image/png"])}
    text = output.get("text", data.get("text/plain", ""))
    if output.get("name") == "stderr" or not text.strip() or text.startswith("<"):
        return None
    text = re.sub(r"\x1b\[[\d;]*m", "", text)  # Colours of a terminal.
    for one in folders:
        text = text.replace(f"{one}/", "")
    return {"text": text.rstrip()}


def _small(png: str) -> str:
    """A picture of at most 60 kB, in fewer colours and then smaller, in base64."""
    from PIL import Image

    content = base64.b64decode(png)
    for width in _WIDTHS:
        for colours in _COLOURS:
            if len(content) <= _MOST_BYTES:
                return base64.b64encode(content).decode()
            picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
            picture.thumbnail((width, 10 * width), Image.Resampling.LANCZOS)
            file = io.BytesIO()
            picture.quantize(colours).save(file, "PNG", optimize=True)
            content = file.getvalue()
    return base64.b64encode(content).decode()
