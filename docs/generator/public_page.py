"""The page of the public names: signature, what it is, and an example that a test runs."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

from system_block import parse_block, to_markdown

ROOT = Path(__file__).resolve().parents[2]
PREAMBLE = """\
import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from drake_safety import *

scenario, legged_scenario = load_scenario("pendulum"), load_scenario("laikago_balancing")
heavier_scenario = load_scenario("pendulum", {"parameters.mass_kg": 1.2})
loop, legged_loop = scenario.make_loop(), legged_scenario.make_loop()
start, steps = legged_loop.standing_start(), legged_scenario.parameters.recovery.step
times = {"duration_s": 1.0, "step_s": 0.04, "num_workers": 1}
timing = {"period_s": 0.02, "offset_s": 0.0025, "horizon": 10, "num_outlook": 8}
episodes = run_episodes(scenario, 16, num_workers=1)
assessment = load_assessment("laikago_balancing")
builder, ports = DiagramBuilder(), {}  # Constants in place of a plant and a planner.
for name in ("state", "desired_preview", "features"):
    source = ConstantVectorSource(np.zeros(assessment.info_.widths[name]))
    ports[name] = builder.AddSystem(source).get_output_port()
"""
"""The first lines of all examples."""
_INTRODUCTION = """\
# Public names

`drake_safety` has these names; any other is imported from its module. The heading of an entry is
its import path.
The examples begin with:

```python
{preamble}```

| name | purpose |
|---|---|
{table}
"""
_ENTRY = """
::: {path}
    options:
      heading: drake_safety.{name}
      toc_label: {name}
      members: false
      skip_local_inventory: true
"""


def public_homes() -> dict[str, str]:
    """Modules of the names that the package exports, by name; the package is not imported."""
    tree = ast.parse((ROOT / "drake_safety" / "__init__.py").read_text("utf-8"))
    assigned = [node for node in tree.body if isinstance(node, ast.Assign)]
    (homes,) = (one.value for one in assigned if ast.unparse(one.targets[0]) == "_HOMES")
    return dict(ast.literal_eval(homes))


def public_page() -> str:
    """Markdown of the page."""
    rows, entries = [], []
    for name, home in public_homes().items():
        path = ROOT.joinpath(*home.split(".")).with_suffix(".py")
        if not path.is_file():  # A folder beside the package, which is its own in a wheel.
            home = home.removeprefix("drake_safety.")
            path = ROOT / home / "__init__.py"
        nodes = ast.parse(path.read_text("utf-8")).body
        (node,) = (one for one in nodes if getattr(one, "name", None) == name)
        assert isinstance(node, ast.ClassDef | ast.FunctionDef)
        block = parse_block(docstring := inspect.cleandoc(ast.get_docstring(node) or ""))
        rows.append(f"| [`{name}`](#{home}.{name}) | {to_markdown(docstring.splitlines()[0])} |")
        entries.append(_ENTRY.format(path=f"{home}.{name}", name=name))
        if block is not None:
            entries.append(f"\nPorts:\n\n{block.table}\n")
    table = "\n".join(rows)
    return _INTRODUCTION.format(preamble=PREAMBLE, table=table) + "".join(entries)
