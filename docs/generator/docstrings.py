"""An extension of griffe, which reads the docstrings: ours are written for Sphinx's roles."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
from system_block import to_markdown


class PlainMarkdown(griffe.Extension):
    """Takes port blocks, which have a table of their own, and roles out of every docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrites an object's docstring."""
        del kwargs
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
