"""A hook of MkDocs: a page for every system and every module, from the source; links; line breaks.

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
_PICTURE = re.compile(r"^!\[[^\]]*\]\((pictures/[^)]+)\)(?:\{[^}]*\})?", re.MULTILINE)
_INTERVAL = re.compile(r"(?<=\d)–(?=\d)| (?=%)")
_NAMES = re.compile(
    r'(?<=class="doc doc-heading">).*?(?=</h\d>)|'
    r"(?:(?<=<td><code>)[\w./-]{12,}|(?<=<code>)[\w./-]{24,})(?=</code>)",
    re.DOTALL,
)
_BREAK = re.compile(r"(?<=\w)(?:\.(?=\w{6})|[_/](?=\w))")  # Not before a file's suffix.
_UP = "[Reference](../index.md) › {}"


def on_files(files: Files, config: Any) -> Files:
    """Adds the generated pages."""
    for name, content in (reference_pages() | tutorial_pages()).items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, files: Files, **kwargs: Any) -> str:
    """A link out of ``docs/`` leads to a module's or tutorial's page, or becomes the file's name.

    A picture leads to its file. Intervals and percentages are not broken.

    Raises:
        FileNotFoundError: There is no such file.
    """
    del kwargs
    if page.file.generated_by is not None:
        return markdown
    markdown = _PICTURE.sub(r"[\g<0>](\1)", markdown)
    parts = markdown.split("```")  # Every second part is code.
    parts[::2] = [_INTERVAL.sub(_unbroken, part) for part in parts[::2]]
    markdown = "```".join(parts)

    def name(found: re.Match[str]) -> str:
        path = ROOT / found.group(2).split("#")[0]
        if not path.exists():
            raise FileNotFoundError(f"{page.file.src_uri}: a link leads to {path}, which is not")
        text, target = found.groups()
        generated = re.sub(r"^drake_safety/(.+)\.py$", r"reference/\1.md", target)
        generated = re.sub(r"ipynb$", "md", generated)
        if generated in files.src_uris:
            return f"[{text}]({generated})"
        return text if text.strip("`") == target else f"{text} (`{target}`)"

    return _OUTWARD.sub(name, markdown)


def on_page_content(html: str, **kwargs: Any) -> str:
    """Long names may be broken at a point, a slash or an underscore."""
    del kwargs
    return _NAMES.sub(lambda one: _BREAK.sub(r"\g<0><wbr>", one[0]), html)


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
                [_UP.format("systems"), f"# {block.name}", block.svg, block.table, f"::: {module}"]
            )
            summary = to_markdown((ast.get_docstring(node) or "").splitlines()[0])
            systems.append(f"| [{block.name}](systems/{path.stem}.md) | {summary} |")
    pages["reference/public.md"] = public_page()
    lines = [
        "# Reference",
        "",
        "[Public names](public.md) has what most users need, with examples.",
    ]
    lines += ["", "## Systems", "", "| system | purpose |", "|---|---|", *sorted(systems)]
    for room in ROOMS:
        lines += ["", f"## {room}", "", "| module | purpose |", "|---|---|"]
        for path in _modules(room):
            module = f"drake_safety.{room}.{path.stem}"
            page = f"reference/{room}/{path.stem}.md"
            docstrings = (
                inspect.cleandoc(ast.get_docstring(node) or "") for node in _classes(path)
            )
            blocks = [block for block in map(parse_block, docstrings) if block]
            ports = [f"Ports of {block.name}:\n\n{block.table}" for block in blocks]
            pages[page] = "\n\n".join(
                [_UP.format(room), f"# {path.stem}", *ports, f"::: {module}\n"]
            )
            summary = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").splitlines()[0]
            lines.append(f"| [{path.stem}]({room}/{path.stem}.md) | {to_markdown(summary)} |")
    pages["reference/index.md"] = "\n".join(lines) + "\n"
    return pages


def _unbroken(found: re.Match[str]) -> str:
    return "\N{NO-BREAK SPACE}" if found[0] == " " else "–\N{WORD JOINER}"


def _modules(room: str) -> list[Path]:
    folder = ROOT / "drake_safety" / room
    return [path for path in sorted(folder.glob("*.py")) if path.stem != "__init__"]


def _classes(path: Path) -> list[ast.ClassDef]:
    tree = ast.parse(path.read_text("utf-8"))
    return [node for node in tree.body if isinstance(node, ast.ClassDef)]
