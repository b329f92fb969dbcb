"""The picture of examples/compose.py: Drake's GraphViz, with the ports that are connected.

``python docs/generator/diagram_picture.py`` writes ``docs/pictures/compose.svg`` by GraphViz's
``dot``, or by another program that reads the graph and writes SVG, given as arguments.
"""

from __future__ import annotations

import re
import subprocess
import sys
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "pictures" / "compose.svg"
_NODE = re.compile(r"^(s\d+) \[shape=none, border=0, label=<\n(.*?)>\];$", re.DOTALL | re.MULTILINE)
_PORT = re.compile(r'<TD PORT="([uy]\d+)"[^>]*>(?:<FONT[^>]*>)?(\w+)')
_EDGE = re.compile(r"^(s\d+):(y\d+):e -> (s\d+(?:out)?):(u?\d+):w", re.MULTILINE)


def connected(graph: str) -> str:
    """A diagram's GraphViz string without the ports that nothing is connected to.

    Systems stand in the order in which they were added. The SceneGraph is left out.
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
        sides = ([one for one in ports if one[0][0] == side] for side in "uy")
        rows = [
            "".join(
                f'<TD PORT="{port[0]}" BORDER="1">{port[1]}</TD>' if port else "<TD></TD>"
                for port in row
            )
            for row in zip_longest(*sides)
        ]
        cells = "".join(f"<TR>{row}</TR>\n" for row in rows)
        head = f'<TR><TD BORDER="1" COLSPAN="2"><B>{kind}</B><BR/>{name}</TD></TR>\n'
        options = 'BORDER="0" CELLSPACING="0" CELLPADDING="4"'
        return f"{key} [shape=none, label=<<TABLE {options}>\n{head}{cells}</TABLE>>];"

    def ordered(edge: re.Match[str]) -> str:
        one, _, other, _ = edge.groups()
        is_back = "out" not in other and int(one[1:]) > int(other[1:])
        return f"{edge.group()} [constraint=false]" if is_back else edge.group()

    graph = _EDGE.sub(ordered, _NODE.sub(table, graph))
    graph = graph.replace("color=black", "color=white", 1).replace("<B>Diagram</B>", "", 1)
    return graph.replace("rankdir=LR", 'rankdir=LR\nnode [fontname="Courier"]', 1)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "examples"))
    from compose import compose

    graph = connected(compose().GetGraphvizString(max_depth=1))
    command = sys.argv[1:] or ["dot", "-Tsvg"]
    drawn = subprocess.run(command, input=graph, capture_output=True, text=True, check=True)
    PICTURE.write_text(drawn.stdout, encoding="utf-8")
