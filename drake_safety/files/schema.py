"""Dataclasses that check themselves, and strict YAML that is read into them."""

import functools
import json
import math
import re
from collections.abc import Collection
from dataclasses import MISSING, asdict, fields, is_dataclass
from enum import Enum
from numbers import Real
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

import pydantic
import pydantic.dataclasses
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat

from drake_safety.files.reading import did_you_mean, parse_yaml, reading, shortened

_NO_OTHER_KEYS = ConfigDict(extra="forbid", defer_build=True)
_UNKNOWN = "unexpected_keyword_argument"
_Value = TypeVar("_Value")

if TYPE_CHECKING:
    # For mypy, only this one makes a class that `dataclasses.replace` takes.
    from dataclasses import dataclass as schema
else:
    schema = functools.partial(pydantic.dataclasses.dataclass, config=_NO_OTHER_KEYS)
    """A dataclass whose constructor checks the types and ranges of its annotations."""


def _ascending(bounds: list[Any]) -> list[Any]:
    if bounds != sorted(bounds):
        raise ValueError("must be [lowest, highest]")
    return bounds


def _increasing(bounds: list[float]) -> list[float]:
    if not bounds[0] < bounds[1]:
        raise ValueError("must be [lowest, highest], lowest < highest")
    return bounds


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"must be a regular expression: {error}") from None
    return text


Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
ShareBelowOne = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Pair = Annotated[list[_Value], Field(min_length=2, max_length=2)]
Triple = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Bounds = Annotated[Pair[_Value], AfterValidator(_ascending)]
"""Lowest and highest, which may be the same."""
Interval = Annotated[Pair[FiniteFloat], AfterValidator(_increasing)]
Pattern = Annotated[str, AfterValidator(_pattern)]
_PACKAGE = r"^([A-Za-z0-9][\w.\[\],-]*( ?@ ?[\w.:/+@%-]+|[=<>~!][=<>~!.*,+\w-]*)?)?$"
Requirement = Annotated[str, Field(pattern=_PACKAGE)]
"""A package that a message advises to install: no options, nothing that a shell reads."""


def check_times(who: str, *, or_zero: Collection[str] = (), **times: Any) -> None:
    """Refuses times [s] that are not finite and positive or, if named, not negative."""
    for name, value in times.items():
        is_real = isinstance(value, Real) and not isinstance(value, bool)
        if not (is_real and (0 < value < math.inf or (value == 0 and name in or_zero))):
            wanted = "not be negative or infinite" if name in or_zero else "be positive and finite"
            raise ValueError(f"{who}: {name} must {wanted} [s]; got {value}")


def load_typed(schema: type[_Value], raw: Any, who: str) -> _Value:
    """Reads plain values, as in a YAML document, into a dataclass.

    A nested mapping that leaves keys out keeps their values in the field's default.
    """
    try:
        text = json.dumps({"value": _merged(schema, raw)}, default=_plain)
    except TypeError as error:  # A key is not text.
        raise ValueError(f"{who}: {error}") from None
    known: Any = schema  # For mypy, the cache wants what can be hashed.
    try:
        document: Any = _document(known).model_validate_json(text, strict=True)
    except pydantic.ValidationError as error:
        # An unknown key may be the reason for the others.
        first = min(error.errors(), key=lambda one: one["type"] != _UNKNOWN)
        raise ValueError(f"{who}: {_message(schema, first)}") from None
    return document.value


def load_typed_file(schema: type[_Value], path: Path, who: str) -> _Value:
    """Reads a YAML file by :func:`load_typed`."""
    if not path.is_file():
        raise ValueError(f"{who} does not exist")
    with reading(path):
        return load_typed(schema, parse_yaml(path.read_text(encoding="utf-8"), who), who)


@functools.cache
def _document(schema: Any) -> type[pydantic.BaseModel]:
    # Inside it, dataclasses of the standard library, such as a user's task has, refuse them too.
    return pydantic.create_model("Document", __config__=_NO_OTHER_KEYS, value=(schema, ...))


def _merged(default: Any, raw: Any) -> Any:
    """Fills a partial value with its default, to any depth."""
    if not (is_dataclass(default) and isinstance(raw, dict)):
        return raw
    known = {}
    for one in fields(default):
        factory = one.default_factory if isinstance(default, type) else MISSING
        known[one.name] = getattr(default, one.name, None) if factory is MISSING else factory()
    stated = {key: _merged(known.get(key), one) for key, one in raw.items()}
    return stated if isinstance(default, type) else asdict(default) | stated


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, Enum) else getattr(value, "tolist", value.__str__)()


def _message(schema: Any, error: Any) -> str:
    """The path of a key, what it must be, what it is, and what may have been meant."""
    # pydantic names a key that is wrong itself by the mark that follows it.
    place = tuple(one for one in error["loc"][1:] if one != "[key]")
    kind, got = error["type"], shortened(repr(error["input"]))
    name = f"'{'.'.join(map(str, place))}'" if place else "this"
    if kind == _UNKNOWN:
        known = _keys(schema, place[:-1])
        return f"unknown key {name}{did_you_mean(place[-1], known)}; keys there are {known}"
    if kind == "dataclass_type":
        return f"{name} must be a mapping with keys of {_keys(schema, place)}; got {got}"
    if kind == "missing":
        return f"{name} is missing"
    text = error["msg"].removeprefix("Value error, ")
    if kind == "value_error" and isinstance(error["input"], dict):
        return f"{name}: {text}" if place else text
    text = re.sub(r"^\w+ should ", "must ", text).replace(" after validation", "")
    if kind == "literal_error":
        text += did_you_mean(error["input"], re.findall("'(.*?)'", error["ctx"]["expected"]))
    return f"{name} {text}; got {got}"


def _keys(schema: Any, place: tuple[str | int, ...]) -> list[str]:
    """Keys of the dataclass at a place in a document."""
    if NoneType in get_args(schema):
        schema = get_args(schema)[0]
    if not place:
        return [one.name for one in fields(schema)]
    inner = get_type_hints(schema)[str(place[0])] if is_dataclass(schema) else get_args(schema)[-1]
    return _keys(inner, place[1:])
