"""An extension of griffe, which reads the docstrings: ours are written for Sphinx's roles."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
from system_block import to_markdown


def comment_of(obj: griffe.Object) -> str:
    """The comment behind an attribute, or that on the lines above it; "" if there is none."""
    if not obj.is_attribute or not obj.lineno or not obj.endlineno:
        return ""
    lines = obj.lines_collection[obj.filepath]
    if behind := re.search(r"  # (?!type:|noqa)(.*)$", lines[obj.endlineno - 1]):
        return behind[1]
    first = obj.lineno - 1
    while lines[first - 1].lstrip().startswith("# "):
        first -= 1
    return " ".join(line.strip(" #") for line in lines[first : obj.lineno - 1])


class PlainMarkdown(griffe.Extension):
    """Takes port blocks, which have a table of their own, and roles out of every docstring.

    A comment beside a field of a class is its docstring.
    """

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrites an object's docstring."""
        del kwargs
        is_field = obj.parent is not None and obj.parent.is_class and obj.is_public
        if is_field and obj.docstring is None and (comment := comment_of(obj)):
            obj.docstring = griffe.Docstring(comment, parent=obj)
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
