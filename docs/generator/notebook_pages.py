"""Pages of the tutorials: their cells, and the outputs of those that `make tutorials` has run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
_NOTE = "*As a notebook: `tutorials/{}`{}.*"


def tutorial_pages(run: Path = ROOT / "build" / "tutorials") -> dict[str, str]:
    """Markdown of every tutorial's page, by its path under ``docs/``.

    Args:
        run: Folder of notebooks with outputs; those that are not there are shown without.
    """
    pages = {}
    for path in sorted((ROOT / "tutorials").glob("*.ipynb")):
        has_run = (run / path.name).is_file()
        cells = json.loads((run / path.name if has_run else path).read_text("utf-8"))["cells"]
        note = _NOTE.format(path.name, "" if has_run else "; `make tutorials` adds its outputs")
        shown = [_shown(cell) for cell in cells]
        pages[f"tutorials/{path.stem}.md"] = "\n\n".join([shown[0], note, *shown[1:]]) + "\n"
    return pages


def _shown(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        source = re.sub(r"\]\(\.\./(?!docs/)([^)]+)\)", r"] (`\1`)", source)
        return re.sub(r"\]\((?:\.\./docs/)?([^)]+?)(?:\.ipynb|(\.md))\)", _link, source)
    parts = [f"```python\n{source}\n```"]
    for output in cell["outputs"]:
        image = output.get("data", {}).get("image/png")
        text = output.get("text") if output.get("name") != "stderr" else None
        if image:
            parts.append(f"![output](data:image/png;base64,{''.join(image.split())})")
        elif text:
            parts.append(f"```text\n{''.join(text).rstrip()}\n```")
    return "\n\n".join(parts)


def _link(found: re.Match[str]) -> str:
    """A link to another page, from the folder of the tutorials."""
    return f"](../{found[1]}.md)" if found[2] else f"]({found[1]}.md)"
