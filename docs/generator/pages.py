"""A hook of MkDocs: a page for every system and every module, from the source; links to the source.

Nothing is imported from the package: the pages are built where Drake is not installed, too.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
from notebook_pages import tutorial_pages
from public_page import public_page
from system_block import parse_block, to_markdown

ROOT = Path(__file__).resolve().parents[2]
ROOMS = (
    "learning",
    "robots",
    "control",
    "plants",
    "simulation",
    "planning",
    "logs",
    "evaluation",
    "live",
)
_OUTWARD = re.compile(r"\[([^\]]*)\]\(\.\./([^)]+)\)")


def on_files(files: Files, config: Any) -> Files:
    """Adds the generated pages."""
    for name, content in (reference_pages() | tutorial_pages()).items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """Links that lead out of ``docs/`` into the checkout become the file's name.

    Raises:
        FileNotFoundError: There is no such file.
    """
    del kwargs
    if page.file.generated_by is not None:
        return markdown

    def name(found: re.Match[str]) -> str:
        path = ROOT / found.group(2).split("#")[0]
        if not path.exists():
            raise FileNotFoundError(f"{page.file.src_uri}: a link leads to {path}, which is not")
        return f"{found.group(1)} (`{found.group(2)}`)"

    return _OUTWARD.sub(name, markdown)


def reference_pages() -> dict[str, str]:
    """Markdown of every generated page, by its path under ``docs/``."""
    pages = {}
    systems = []
    for path in _modules("systems"):
        for node in _classes(path):
            block = parse_block(inspect.cleandoc(ast.get_docstring(node) or ""))
            if block is None:
                continue
            module = f"drake_safety.systems.{path.stem}"
            pages[f"reference/systems/{path.stem}.md"] = "\n\n".join(
                [f"# {block.name}", block.svg, block.table, f"::: {module}"]
            )
            summary = to_markdown((ast.get_docstring(node) or "").splitlines()[0])
            systems.append(f"| [{block.name}](systems/{path.stem}.md) | {summary} |")
    pages["reference/public.md"] = public_page()
    lines = [
        "# Reference",
        "",
        "[Public names](public.md) has what most users need, with examples.",
    ]
    lines += ["", "## Systems", "", "| system | |", "|---|---|", *sorted(systems)]
    for room in ROOMS:
        lines += ["", f"## {room}", "", "| module | |", "|---|---|"]
        for path in _modules(room):
            module = f"drake_safety.{room}.{path.stem}"
            page = f"reference/{room}/{path.stem}.md"
            docstrings = (
                inspect.cleandoc(ast.get_docstring(node) or "") for node in _classes(path)
            )
            blocks = [block for block in map(parse_block, docstrings) if block]
            ports = [f"Ports of {block.name}:\n\n{block.table}" for block in blocks]
            pages[page] = "\n\n".join([f"# {path.stem}", *ports, f"::: {module}\n"])
            summary = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").splitlines()[0]
            lines.append(f"| [{path.stem}]({room}/{path.stem}.md) | {to_markdown(summary)} |")
    pages["reference/index.md"] = "\n".join(lines) + "\n"
    return pages


def _modules(room: str) -> list[Path]:
    folder = ROOT / "drake_safety" / room
    return [path for path in sorted(folder.glob("*.py")) if path.stem != "__init__"]


def _classes(path: Path) -> list[ast.ClassDef]:
    tree = ast.parse(path.read_text("utf-8"))
    return [node for node in tree.body if isinstance(node, ast.ClassDef)]
