"""An extension of griffe, which reads the docstrings: ours are written for Sphinx's roles."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
from system_block import to_markdown

_SCHEMA = "drake_safety.files.schema.schema"  # A dataclass that checks itself.
_DATACLASSES = griffe.Module("dataclasses")
_DATACLASSES["dataclass"] = griffe.Function("dataclass")


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

    A comment beside a field of a class is its docstring. A class of the package's own decorator
    is a dataclass, so that its page shows the constructor with the defaults.
    """

    def on_class_instance(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        """Says that a class is a dataclass."""
        del kwargs
        for decorator in cls.decorators:
            if decorator.callable_path == _SCHEMA:
                call = decorator.value
                assert isinstance(call, griffe.ExprCall) and cls.parent is not None
                call.function = griffe.ExprName("dataclass", parent=_DATACLASSES)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Shows a type without its limits, and the list that a ``default_factory`` returns."""
        del kwargs
        note = attr.annotation
        if isinstance(note, griffe.ExprSubscript) and str(note.left) == "Annotated":
            assert isinstance(note.slice, griffe.ExprTuple)
            attr.annotation = note.slice.elements[0]
        if isinstance(attr.value, griffe.ExprCall) and len(attr.value.arguments) == 1:
            (argument,) = attr.value.arguments
            factory = argument.value if isinstance(argument, griffe.ExprKeyword) else None
            if isinstance(factory, griffe.ExprLambda) and str(attr.value.function) == "field":
                attr.value = factory.body

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrites an object's docstring."""
        del kwargs
        is_field = obj.parent is not None and obj.parent.is_class and obj.is_public
        if is_field and obj.docstring is None and (comment := comment_of(obj)):
            obj.docstring = griffe.Docstring(comment, parent=obj)
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
