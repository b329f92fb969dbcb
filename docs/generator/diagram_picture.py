"""The picture of examples/compose.py: Drake's GraphViz, with the ports that are connected.

``python docs/generator/diagram_picture.py`` writes ``docs/pictures/compose.svg`` by GraphViz's
``dot``, or by another program that reads the graph and writes SVG, given as arguments.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "pictures" / "compose.svg"
_NODE = re.compile(r"^(s\d+) \[shape=none, border=0, label=<\n(.*?)>\];$", re.DOTALL | re.MULTILINE)
_PORT = re.compile(r'<TD PORT="([uy]\d+)"[^>]*>(?:<FONT[^>]*>)?(\w+)')
_EDGE = re.compile(r"^(s\d+):(y\d+):e -> (s\d+):(u\d+):w", re.MULTILINE)
_GAMMA = "#e6eef8"  # Colour of Γ in the block diagram too.
_TABLE = 'BORDER="0" CELLSPACING="0" CELLPADDING="3"'
_HEAD = """digraph {
bgcolor=white; nodesep=0.2; ranksep=0.5
node [fontname="Helvetica", fontsize=12]; edge [color="#5a626d", arrowsize=0.7]"""


def connected(graph: str) -> str:
    """A diagram's GraphViz string without the ports that nothing is connected to.

    Systems stand below each other in the order in which they were added: inputs above the name,
    outputs below. The SceneGraph and the diagram's own ports are left out.
    """
    (scene,) = re.findall(r"^(s\d+) .*\n.*\n.*\n<B>SceneGraph</B>", graph, re.MULTILINE)
    graph = re.sub(rf"^(?:{scene}:.*|s\d+:.* {scene}:.*)\n", "", graph, flags=re.MULTILINE)
    ends = {end for one, y, other, u in _EDGE.findall(graph) for end in ((one, y), (other, u))}

    def table(node: re.Match[str]) -> str:
        key, label = node.groups()
        if key == scene:
            return ""
        kind, name = re.findall(r"<B>(?:\w+\.)*(\w+)</B><BR/>\nname=(\w+)", label)[0]
        ports = [port for port in _PORT.findall(label) if (key, port[0]) in ends]
        above, below = (
            "".join(
                f'<TD PORT="{one}" BORDER="1">{text}</TD>' for one, text in ports if one[0] == end
            )
            for end in "uy"
        )
        colour = _GAMMA if kind.endswith("SafetyAssessor") else "white"
        head = f'<TR><TD BGCOLOR="{colour}" BORDER="1"><B>{kind}</B> {name}</TD></TR>'
        rows = [
            f"<TR><TD><TABLE {_TABLE}><TR>{row}</TR></TABLE></TD></TR>" * bool(row)
            for row in (above, below)
        ]
        return f"{key} [shape=none, label=<<TABLE {_TABLE}>{rows[0]}{head}{rows[1]}</TABLE>>];"

    def ordered(edge: re.Match[str]) -> str:
        one, y, other, u = edge.groups()
        is_back = int(one[1:]) > int(other[1:])
        return f"{one}:{y}:s -> {other}:{u}:n" + " [constraint=false]" * is_back

    nodes = [table(node) for node in _NODE.finditer(graph)]
    edges = [ordered(edge) for edge in _EDGE.finditer(graph)]
    return "\n".join([_HEAD, *nodes, *edges, "}"])


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "examples"))
    from compose import compose

    graph = connected(compose().GetGraphvizString(max_depth=1))
    command = sys.argv[1:] or ["dot", "-Tsvg"]
    drawn = subprocess.run(command, input=graph, capture_output=True, text=True, check=True)
    PICTURE.write_text(drawn.stdout, encoding="utf-8")
