"""A system's ports, from the ``.. pydrake_system::`` block of its docstring: table and picture."""

from __future__ import annotations

import html
import re
from dataclasses import dataclass

import yaml

DIRECTIVE = re.compile(r"^\.\. pydrake_system::\n((?:[ \t]+.*\n|\n)*)", re.MULTILINE)
_ROW, _MARGIN, _HEAD, _LETTER = 24, 14, 34, 7.4  # Of the picture [pixels].
_REMARK = re.compile(r"^(\w+)\s*(?:\((.*)\))?$")


@dataclass(frozen=True)
class SystemBlock:
    """What the block says.

    Attributes:
        name: Of the system.
        inputs: Each port and the remark behind it, if there is one.
        outputs: Likewise.
    """

    name: str
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]

    @property
    def table(self) -> str:
        """The ports as a Markdown table."""
        rows = [("input", *port) for port in self.inputs]
        rows += [("output", *port) for port in self.outputs]
        lines = [f"| {kind} | `{port}` | {remark} |" for kind, port, remark in rows]
        return "\n".join(["| | port | |", "|---|---|---|", *lines])

    @property
    def svg(self) -> str:
        """The block with its ports, as an SVG that takes its colours from the page."""
        names = [port for port, _ in (*self.inputs, *self.outputs)]
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
            for row, (port, _) in enumerate(ports):
                y = _HEAD + (row + 0.5) * _ROW
                parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="4" fill="currentColor"/>')
                parts.append(
                    f'<text x="{x + inwards:.0f}" y="{y + 4:.0f}" text-anchor="{anchor}">'
                    f"{html.escape(port)}</text>"
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
    """A docstring without the block, for its page shows it, and with roles as plain code.

    Args:
        docstring: Without its indentation.
    """
    text = DIRECTIVE.sub("", docstring + "\n").rstrip("\n")
    text = re.sub(r":(?:attr|class|func|meth|mod):`~?([^`]+)`", r"`\1`", text)
    # What follows a bracket in brackets is a unit, not the target of a link.
    text = re.sub(r"\]( ?)\[([^\]\n]*)\]", r"]\1\\[\2]", text)
    return re.sub(r"``([^`\n]+)``", r"`\1`", text)


def _ports(lines: list[str] | None) -> tuple[tuple[str, str], ...]:
    ports = []
    for line in lines or []:
        found = _REMARK.match(str(line))
        if found is None:
            raise ValueError(f"pydrake_system: a port is 'name' or 'name (remark)'; got '{line}'")
        ports.append((found.group(1), found.group(2) or ""))
    return tuple(ports)
