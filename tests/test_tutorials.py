"""The tutorials: clean files that a newcomer can read, and every cell of them runs."""

import base64
import json
import os
import re
from pathlib import Path

import pytest

from studies.tutorials import run, source_hash

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "tutorials").glob("*.ipynb"))
MAX_CELLS = 15
FAST = "DRAKE_SAFETY_FAST"


def cells(path, kind):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


@pytest.fixture(params=TUTORIALS, ids=lambda path: path.stem)
def tutorial(request):
    return request.param


def test_there_are_nine_tutorials_in_order():
    assert [int(path.stem.split("_")[0]) for path in TUTORIALS] == list(range(9))


def test_a_tutorial_begins_with_prose_is_short_and_holds_no_outputs(tutorial):
    notebook = json.loads(tutorial.read_text(encoding="utf-8"))
    assert notebook["cells"][0]["cell_type"] == "markdown"
    assert len(notebook["cells"]) <= MAX_CELLS
    for cell in notebook["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    prose = sum(len(text) for text in cells(tutorial, "markdown"))
    assert prose > 0.25 * sum(len(text) for text in cells(tutorial, "code"))


def test_the_fast_mode_is_set_in_the_first_cell_of_code(tutorial):
    assert FAST in cells(tutorial, "code")[0]
    assert all(FAST not in text for text in cells(tutorial, "code")[1:])


def test_links_of_a_tutorial_lead_somewhere(tutorial):
    links = re.findall(r"\]\(([^)#]+)\)", "\n".join(cells(tutorial, "markdown")))
    assert links
    missing = [link for link in links if not (tutorial.parent / link).exists()]
    assert missing == []


def test_the_stored_outputs_are_of_the_present_code_and_of_what_ships(tutorial):
    file = ROOT / "tutorials/outputs" / f"{tutorial.stem}.json"
    notebook, kept = (json.loads(path.read_text(encoding="utf-8")) for path in (tutorial, file))
    assert kept["source_sha256"] == source_hash(notebook), (
        f"run `studies tutorials {tutorial.stem}`"
    )
    assert len(kept["cells"]) == len(cells(tutorial, "code"))
    shown = [output for cell in kept["cells"] for output in cell]
    assert any("png" in output for output in shown)
    for output in shown:
        assert len(base64.b64decode(output.get("png", ""))) <= 60_000
    later = next(cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    later["source"] = [*later["source"], "\npass"]
    assert source_hash(notebook) != kept["source_sha256"]


@pytest.mark.slow
def test_every_cell_of_a_tutorial_runs(tutorial, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="the extra 'tutorials' is not installed")
    pytest.importorskip("ipykernel", reason="the extra 'tutorials' is not installed")
    import nbformat

    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv(FAST, "1")
    notebook = nbformat.read(tutorial, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}  # What it writes does not end up here.
    client = nbclient.NotebookClient(
        notebook, timeout=900, startup_timeout=300, resources=resources
    )
    client.execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    assert any("image/png" in out.get("data", {}) for out in outputs)  # It shows a picture.


@pytest.mark.slow
def test_run_keeps_texts_without_folders_and_small_pictures_but_no_progress(tmp_path):
    pytest.importorskip("nbclient", reason="the extra 'tutorials' is not installed")
    import nbformat

    tell = "import os, sys; print('in', os.getcwd() + '/a.txt'); print('42 %', file=sys.stderr); 7"
    draw = """import io, numpy as np, PIL.Image, IPython.display as shown
blocks = np.random.default_rng(0).integers(0, 255, (150, 200, 3), dtype=np.uint8)
PIL.Image.fromarray(np.kron(blocks, np.ones((8, 8, 1), np.uint8))).save(file := io.BytesIO(), "PNG")
print(len(file.getvalue()))
shown.display(shown.Image(file.getvalue()))"""
    notebook = nbformat.v4.new_notebook(
        cells=[
            nbformat.v4.new_markdown_cell("# Toy"),
            *map(nbformat.v4.new_code_cell, (tell, draw)),
        ]
    )
    path = tmp_path / "toy.ipynb"
    nbformat.write(notebook, path)
    found = run(path)
    assert found["cells"][0] == [{"text": "in a.txt"}, {"text": "7"}]
    (size, picture) = found["cells"][1]
    assert len(base64.b64decode(picture["png"])) <= 60_000 < int(size["text"])
    assert found["core_s"] > 0.0
    assert found["source_sha256"] == source_hash(json.loads(path.read_text(encoding="utf-8")))
