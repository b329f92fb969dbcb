"""The reference documentation: ports as the docstrings say them, and as the systems have them."""

import ast
import dataclasses
import inspect
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from packaging.specifiers import SpecifierSet

import drake_safety
import notebook_pages
import public_page
import system_block

ROOT = Path(__file__).resolve().parents[1]
SYSTEMS = sorted((ROOT / "drake_safety" / "systems").glob("*.py"))
OTHERS = (
    "diagrams/walking/command_guard.py",
    "drake_safety/plants/mujoco_plant.py",
    "drake_safety/simulation/closed_loop.py",
)

DOCSTRING = """Adds two numbers.

.. pydrake_system::

    name: Adder
    input_ports:
    - state: n_s + 1
    - noise: 2 n_v (optional)
    output_ports:
    - margins: 3

Not :meth:`subtract`, see ``margins``.

Example: ``Adder()``
"""


def test_a_block_says_its_ports_and_their_remarks():
    block = system_block.parse_block(DOCSTRING)
    assert block.name == "Adder"
    assert [(one.name, one.size, one.remark) for one in block.inputs] == [
        ("state", "n_s + 1", ""),
        ("noise", "2 n_v", "optional"),
    ]
    assert "| input | `noise` | 2 n_v | optional: standard normal numbers, for" in block.table
    assert block.table.count("\n") == 6
    # Behind it the symbols of the sizes.
    assert re.findall(r"(n_\w+)[:,]", block.table.splitlines()[-1]) == ["n_q", "n_v", "n_s"]
    # The picture names the system and has a dot for every port.
    assert block.svg.count("<circle") == 3
    assert all(f">{name}</text>" in block.svg for name in ("Adder", "state", "noise", "margins"))
    assert block.svg.count("<text") == 4


def test_a_docstring_becomes_markdown_without_its_block():
    text = system_block.to_markdown(DOCSTRING)
    example = "Examples:\n    >>> Adder()\n"
    assert text == f"Adds two numbers.\n\nNot `subtract`, see `margins`.\n\n{example}"
    # A unit behind an index is no link.
    assert system_block.to_markdown("The entry q[3] [rad].") == "The entry q[3] \\[rad]."


def test_a_block_of_something_else_is_refused():
    with pytest.raises(ValueError, match="got \\['name', 'ports'\\]"):
        system_block.parse_block(".. pydrake_system::\n\n    name: A\n    ports: [x]\n")
    with pytest.raises(ValueError, match="a port is 'name: size"):
        system_block.parse_block(".. pydrake_system::\n\n    name: A\n    input_ports: [x]\n")
    assert system_block.parse_block("Says nothing of ports.") is None


def test_every_port_has_a_meaning_and_every_meaning_a_port():
    nodes = [
        node
        for path in (*SYSTEMS, *map(ROOT.joinpath, OTHERS))
        for node in ast.parse(path.read_text("utf-8")).body
    ]
    docs = [ast.get_docstring(node) or "" for node in nodes if isinstance(node, ast.ClassDef)]
    blocks = [block for block in map(system_block.parse_block, docs) if block]
    used = set()
    for block in blocks:
        for port in (*block.inputs, *block.outputs):
            own = f"{block.name}.{port.name}"
            used.add(own if own in system_block.PORTS else port.name)
    assert used == set(system_block.PORTS)


def test_every_public_name_is_on_the_page_with_an_example_that_runs():
    homes, page = public_page.public_homes(), public_page.public_page()
    assert [*homes, "__version__"] == drake_safety.__all__
    shared = {}
    exec(public_page.PREAMBLE, shared)
    for name in homes:
        assert f"heading: drake_safety.{name}\n" in page
        public = getattr(drake_safety, name)
        (example,) = system_block.EXAMPLE.findall(inspect.getdoc(public))
        assert name in example or not callable(public) or name in NOT_CALLED
        exec(example, dict(shared))


# Their objects come from others, such as `run_episodes`.
NOT_CALLED = ("ChangeDetector", "ClosedLoop", "Episode", "Episodes", "SafetyAssessment", "Scenario")


def test_every_public_function_of_three_arguments_says_what_they_are():
    for name in public_page.public_homes():
        public = getattr(drake_safety, name)
        arguments = [one for one in inspect.signature(public).parameters if one != "self"]
        of_fields = dataclasses.is_dataclass(public) or name == "ClosedLoop"  # Have comments.
        if len(arguments) >= 3 and not of_fields:
            assert "\nArgs:\n" in inspect.getdoc(public), name


def test_hosted_pages_are_built_with_what_the_extra_docs_installs_alone():
    hosted = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (ROOT / hosted["mkdocs"]["configuration"]).is_file()
    assert hosted["build"]["tools"]["python"] in SpecifierSet(project["requires-python"])
    (install,) = hosted["build"]["jobs"]["install"]
    (_, *listing) = shlex.split(install.partition("$(")[2].removesuffix(")"))
    printed = subprocess.run([sys.executable, *listing], cwd=ROOT, capture_output=True, text=True)
    assert printed.stdout.split() == project["optional-dependencies"]["docs"]


def test_links_out_of_docs_lead_to_generated_pages_and_figures_stay_in_one_piece():
    pages = pytest.importorskip("pages", reason="extra 'docs' not installed", exc_type=ImportError)
    page = SimpleNamespace(file=SimpleNamespace(generated_by=None, src_uri="page.md"))
    files = SimpleNamespace(src_uris={"reference/robots/robot.md", "tutorials/6_compose.md"})
    for text, shown in {
        "[`A`](../drake_safety/robots/robot.py)": "[`A`](reference/robots/robot.md)",
        "[6](../tutorials/6_compose.ipynb)": "[6](tutorials/6_compose.md)",
        "[`Makefile`](../Makefile) [us](../LICENSE)": "`Makefile` us (`LICENSE`)",
        "![p](pictures/path.png)": "[![p](pictures/path.png)](pictures/path.png)",
        # No-break space and word joiner; code stays as it is.
        "90 % (80–95)\n```\n9 %\n```": "90\u00a0% (80–\u206095)\n```\n9 %\n```",
    }.items():
        assert pages.on_page_markdown(text, page, files) == shown
    with pytest.raises(FileNotFoundError, match=r"page\.md: a link leads to .*/nowhere, which"):
        pages.on_page_markdown("[a](../nowhere)", page, files)
    short = "<p><code>policy.yaml</code> <code>run_episodes</code></p><td><code>safety_"
    long = f"{short}probability</code></td>"
    assert pages.on_page_content(long) == f"{short}<wbr>probability</code></td>"


@pytest.mark.slow
def test_the_reference_builds_without_a_warning(tmp_path):
    commands = pytest.importorskip("mkdocs.commands.build", reason="extra 'docs' not installed")
    pytest.importorskip("mkdocstrings", reason="extra 'docs' not installed")
    del commands
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    page = (tmp_path / "reference" / "systems" / "safety_assessor" / "index.html").read_text()
    assert "predicted_margins" in page
    assert "<svg" in page
    assert "drake_safety.systems.safety_assessor.SafetyAssessor" in page
    page = (tmp_path / "reference" / "public" / "index.html").read_text()
    shown = re.sub(r"<[^>]+>", "", page)
    for name in public_page.public_homes():
        assert f"drake_safety.{name}" in shown
    assert shown.count("Examples:") == len(public_page.public_homes())
    assert "initial_uncertainty: Share = 0.3" in shown and "dropout: ShareBelowOne" in shown
    assert "hidden_sizes: Widths = [128, 128]" in shown and "horizon: int = 10" in shown
    for page in tmp_path.rglob("*.html"):
        shown = re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8"))
        assert not re.search(r":(class|meth|func|attr|mod):|={6}|\.\. \w+::", shown), page


def test_every_tutorial_is_a_page_and_shows_the_outputs_that_are_kept(tmp_path):
    paths = sorted((ROOT / "tutorials").glob("*.ipynb"))
    pages = notebook_pages.tutorial_pages(tmp_path)
    assert [*pages] == [f"tutorials/{path.stem}.md" for path in paths]
    first = next(iter(pages.values()))
    assert "](../concepts.md)" in first and "](6_compose.md)" in first
    assert "`python -m studies tutorials` adds its outputs" in first
    # The first cell of code is folded, the second is not.
    setup, _, rest = first.partition("</details>")
    assert setup.count("```python") == 1 and "DRAKE_SAFETY_FAST" in setup
    assert rest.count("```python") > 1
    outputs = [[{"text": "0.7 0.3"}, {"png": "iVBORw0KGgo="}]]
    kept = {"core_s": 61.0, "cells": [*outputs, []]}
    (tmp_path / f"{paths[0].stem}.json").write_text(json.dumps(kept), encoding="utf-8")
    first = next(iter(notebook_pages.tutorial_pages(tmp_path).values()))
    after = first.partition("</details>")[2]
    assert after.startswith(
        "\n\n```text\n0.7 0.3\n```\n\n![output](data:image/png;base64,iVBORw0KGgo=)"
    )
    assert "it takes 2 minutes of one core" in first and "adds its outputs" not in first
