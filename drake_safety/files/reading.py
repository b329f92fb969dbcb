"""The boundary at which the errors of file formats become errors that name the file and the key."""

import difflib
import json
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

_LONGEST_MESSAGE = 500  # Characters, without the name of the file.
_MOST_BYTES = 2**33
_MOST_VALUES = 200_000  # Values of a YAML document, with aliases expanded.


@contextmanager
def reading(
    path: Path,
    what: str = "",
    errors: type[Exception] | tuple[type[Exception], ...] = (ValueError, RecursionError),
) -> Iterator[None]:
    """Context manager in which a file is read: errors become `ValueError` with its name.

    ``what``, such as "log", precedes the name. Readers of foreign formats raise any ``errors``.
    """
    try:
        yield
    except Exception as error:
        is_of_system = isinstance(error, OSError) and error.filename is not None
        is_own = type(error).__module__.startswith("drake_safety.")  # Such as a missing extra.
        if is_of_system or is_own or not isinstance(error, errors):
            raise
        text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        if type(error) is not ValueError or str(path) not in text:
            text = f"{what} '{path}': {text}" if what else f"{path}: {text}"
        raise ValueError(shortened(text)) from error


def shortened(text: str) -> str:
    """Cuts a message that quotes a large part of a file."""
    return text if len(text) <= _LONGEST_MESSAGE else f"{text[: _LONGEST_MESSAGE - 4]} ..."


def check_memory(num_bytes: int, who: str) -> None:
    """Raises ValueError if the content of a file, by its header, takes too much memory."""
    if num_bytes > _MOST_BYTES:
        raise ValueError(f"{who} would take {num_bytes / 1e9:.3g} GB")


def is_number(value: Any) -> bool:
    """Whether a value or its text is a number."""
    try:
        float(value)
    except (ValueError, TypeError):
        return False
    return True


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)`` for an error message, or "" if no known name is like it."""
    near = difflib.get_close_matches(str(name), [str(word) for word in known], n=1, cutoff=0.7)
    return f" (did you mean '{near[0]}'?)" if near else ""


class YamlLoader(yaml.SafeLoader):
    """Reads ``1e-3`` as a number, as YAML 1.2 does, and refuses keys that stand twice."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Composes a mapping; keys differ as texts, as in JSON, which :func:`load_typed` reads."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        lines: dict[str, int] = {}
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            name, line = key.value, key.start_mark.line + 1
            if key.tag != "tag:yaml.org,2002:merge":
                name = str(self.construct_object(key))
            if name in lines:
                raise ValueError(f"key '{name}' stands twice, in lines {lines[name]} and {line}")
            lines[name] = line
        return node


YamlLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    [*"-+.0123456789"],
)


def yaml_text(text: str) -> str:
    """Returns a text as a YAML scalar, quoted where YAML would read anything else."""
    if re.fullmatch(r"[\w./-]+", text) and yaml.load(text, Loader=YamlLoader) == text:
        return text
    return json.dumps(text, ensure_ascii=False)


def parse_yaml(text: str, who: str, loader: type[yaml.SafeLoader] = YamlLoader) -> Any:
    """Parses YAML of plain values; double keys, deep nesting and many aliases are refused."""
    try:
        value = yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        raise ValueError(f"{who} is not YAML: {shortened(str(error))}") from error
    except RecursionError:
        raise ValueError(f"{who} is not YAML that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{who}: {error}") from error
    pending, num_values = [value], 0
    while pending:
        item = pending.pop()
        num_values += 1
        if num_values > _MOST_VALUES:
            raise ValueError(f"{who} has more than {_MOST_VALUES} values with its aliases")
        if isinstance(item, dict | list):
            pending += [*item, *item.values()] if isinstance(item, dict) else item
    return value
