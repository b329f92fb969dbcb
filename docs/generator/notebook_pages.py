"""Pages of the tutorials: their cells, and the outputs that `python -m studies tutorials` keeps."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
_NOTE = "*As a notebook: `tutorials/{}`{}.*"
_RUN = "; it takes {time} of one core"
_NOT_RUN = "; `python -m studies tutorials` adds its outputs"
_SETUP = "<details markdown><summary>Setup</summary>\n\n{}\n\n</details>"


def tutorial_pages(outputs: Path = ROOT / "tutorials" / "outputs") -> dict[str, str]:
    """Markdown of every tutorial's page, by its path under ``docs/``.

    Args:
        outputs: Folder of kept outputs; tutorials that are not there are shown without.
    """
    pages = {}
    for path in sorted((ROOT / "tutorials").glob("*.ipynb")):
        cells, file = json.loads(path.read_text("utf-8"))["cells"], outputs / f"{path.stem}.json"
        kept = json.loads(file.read_text("utf-8")) if file.is_file() else {"cells": []}
        outputs_of = iter(kept["cells"])
        shown, is_setup = [], True
        for cell in cells:
            if cell["cell_type"] == "markdown":
                shown.append(_prose("".join(cell["source"])))
                continue
            code = f"```python\n{''.join(cell['source'])}\n```"
            shown.append(_SETUP.format(code) if is_setup else code)
            shown += _shown(next(outputs_of, []))
            is_setup = False
        note = _NOTE.format(
            path.name, _RUN if "core_s" in kept else "" if kept["cells"] else _NOT_RUN
        )
        note = note.format(time=_time(kept.get("core_s", 0.0)))
        pages[f"tutorials/{path.stem}.md"] = "\n\n".join([shown[0], note, *shown[1:]]) + "\n"
    return pages


def _time(seconds: float) -> str:
    minutes = max(1, math.ceil(seconds / 60))
    return "less than a minute" if minutes == 1 else f"{minutes} minutes"


def _prose(source: str) -> str:
    source = re.sub(r"\]\(\.\./(?!docs/)([^)]+)\)", r"] (`\1`)", source)
    return re.sub(r"\]\((?:\.\./docs/)?([^)]+?)(?:\.ipynb|(\.md))\)", _link, source)


def _shown(outputs: Sequence[dict[str, Any]]) -> list[str]:
    return [
        f"![output](data:image/png;base64,{one['png']})"
        if "png" in one
        else f"```text\n{one['text']}\n```"
        for one in outputs
    ]


def _link(found: re.Match[str]) -> str:
    """A link to another page, from the folder of the tutorials."""
    return f"](../{found[1]}.md)" if found[2] else f"]({found[1]}.md)"
