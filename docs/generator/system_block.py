"""A system's ports, from the ``.. pydrake_system::`` block of its docstring: table and picture."""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from pathlib import Path

import yaml

DIRECTIVE = re.compile(r"^\.\. pydrake_system::\n((?:[ \t]+.*\n|\n)*)", re.MULTILINE)
EXAMPLE = re.compile(r"^Example: ``(.+)``$", re.MULTILINE)
_ROW, _MARGIN, _HEAD, _LETTER = 24, 14, 34, 7.4  # Of the picture [pixels].
_SIZE = re.compile(r"^([^(]+?)\s*(?:\((.*)\))?$")
_KNOWN = yaml.safe_load((Path(__file__).parent / "ports.yaml").read_text("utf-8"))
SIZES, PORTS = _KNOWN["sizes"], _KNOWN["ports"]


@dataclass(frozen=True)
class Port:
    """A port of a system.

    Attributes:
        size: Number of entries, in the symbols of ``SIZES``; "abstract" for no vector.
        remark: Behind the size, such as "optional".
    """

    name: str
    size: str
    remark: str = ""


@dataclass(frozen=True)
class SystemBlock:
    """What the block says.

    Attributes:
        name: Of the system.
    """

    name: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]

    @property
    def table(self) -> str:
        """The ports as a Markdown table, and what the symbols of their sizes mean."""
        rows = [("input", port) for port in self.inputs]
        rows += [("output", port) for port in self.outputs]
        lines = [
            f"| {kind} | `{port.name}` | {port.size} | {self.content(port)} |"
            for kind, port in rows
        ]
        used = set(re.findall(r"[A-Za-z]\w*", " ".join(port.size for _, port in rows)))
        symbols = [f"{key}: {text}" for key, text in SIZES.items() if used & set(key.split(", "))]
        return "\n".join(
            ["| | port | size | content |", "|---|---|---|---|", *lines, "", "; ".join(symbols)]
        )

    def content(self, port: Port) -> str:
        """What a port carries, with its remark in front."""
        text = PORTS.get(f"{self.name}.{port.name}") or PORTS[port.name]
        remark = port.remark.replace("``", "`")
        return f"{remark}: {text}" if remark else text

    @property
    def svg(self) -> str:
        """The block with its ports, as an SVG that takes its colours from the page."""
        names = [port.name for port in (*self.inputs, *self.outputs)]
        half = max(map(len, names), default=4) * _LETTER + 2 * _MARGIN
        width = max(2 * half, len(self.name) * 9 + 2 * _MARGIN)
        num_rows = max(len(self.inputs), len(self.outputs), 1)
        height = _HEAD + num_rows * _ROW + _MARGIN
        parts = [
            f'<rect x="{_MARGIN}" y="1" width="{width:.0f}" height="{height}" rx="6" '
            'fill="none" stroke="currentColor" stroke-width="1.5"/>',
            f'<text x="{_MARGIN + width / 2:.0f}" y="22" text-anchor="middle" '
            f'font-weight="bold">{html.escape(self.name)}</text>',
        ]
        sides = (
            (self.inputs, _MARGIN, "start", _MARGIN),
            (self.outputs, _MARGIN + width, "end", -_MARGIN),
        )
        for ports, x, anchor, inwards in sides:
            for row, port in enumerate(ports):
                y = _HEAD + (row + 0.5) * _ROW
                parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="4" fill="currentColor"/>')
                parts.append(
                    f'<text x="{x + inwards:.0f}" y="{y + 4:.0f}" text-anchor="{anchor}">'
                    f"{html.escape(port.name)}</text>"
                )
        full = width + 2 * _MARGIN
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {full:.0f} {height + 2}" '
            f'width="{full:.0f}" role="img" aria-label="{html.escape(self.name)} and its ports" '
            'font-family="monospace" font-size="12" fill="currentColor">'
            + "".join(parts)
            + "</svg>"
        )


def parse_block(docstring: str) -> SystemBlock | None:
    """The block of a docstring; None where there is none.

    Args:
        docstring: Without its indentation.

    Raises:
        ValueError: The block is not a name with input and output ports.
    """
    found = DIRECTIVE.search(docstring + "\n")
    if found is None:
        return None
    content = yaml.safe_load(found.group(1))
    unknown = set(content or {}) - {"name", "input_ports", "output_ports"}
    if not content or "name" not in content or unknown:
        raise ValueError(
            "pydrake_system: expected name, input_ports and output_ports; got "
            f"{list(content or {})}"
        )
    return SystemBlock(
        name=content["name"],
        inputs=_ports(content.get("input_ports")),
        outputs=_ports(content.get("output_ports")),
    )


def to_markdown(docstring: str) -> str:
    """A docstring without the block, for its page shows it, with roles as plain code.

    An ``Example:`` is a section.

    Args:
        docstring: Without its indentation.
    """
    text = DIRECTIVE.sub("", docstring + "\n").rstrip("\n")
    text = EXAMPLE.sub(r"Examples:\n    >>> \1\n", text)
    text = re.sub(r":(?:attr|class|func|meth|mod):`~?([^`]+)`", r"`\1`", text)
    # What follows a bracket in brackets is a unit, not the target of a link.
    text = re.sub(r"\]( ?)\[([^\]\n]*)\]", r"]\1\\[\2]", text)
    return re.sub(r"``([^`\n]+)``", r"`\1`", text)


def _ports(lines: list[dict[str, str | int]] | None) -> tuple[Port, ...]:
    ports = []
    for line in lines or []:
        if not isinstance(line, dict) or len(line) != 1:
            raise ValueError(f"pydrake_system: a port is 'name: size (remark)'; got '{line}'")
        ((name, size),) = line.items()
        ports.append(Port(name, *_SIZE.match(str(size)).groups(default="")))
    return tuple(ports)
