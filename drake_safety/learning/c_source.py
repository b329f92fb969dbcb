"""Assessor and monitor as C99 without dependencies, generated from their graphs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.onnx_graph import make_model

if TYPE_CHECKING:
    import onnx

PARTS = ("assessor", "monitor")


class Port(NamedTuple):
    """A port of one row; a number has no width."""

    name: str
    width: int | None
    description: str


def write(path: Path, assessment: Any, prefix: str | None = None) -> list[Path]:
    """Writes source, header and example, atomically and with the same bytes; returns the files."""
    require_extra("c", f"export to '{path}'")
    import jinja2

    prefix = path.stem if prefix is None else prefix
    if not re.fullmatch(r"[A-Za-z_]\w*", prefix, re.ASCII):
        raise ValueError(
            f"export to '{path}': prefix must be a name in C, of letters, digits and '_'; "
            f"got '{prefix}'"
        )
    models = {part: make_model(assessment, part, rows=1) for part in PARTS}
    contracts = {
        part: {entry.key: json.loads(entry.value) for entry in model.metadata_props}
        for part, model in models.items()
    }
    ports = {
        part: (_ports(model.graph.input), _ports(model.graph.output))
        for part, model in models.items()
    }
    inputs = {port.name: port for part in PARTS for port in ports[part][0]}
    columns = {name: names for part in PARTS for name, names in contracts[part]["inputs"].items()}
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"c_name": _c_name, "comment": lambda text: text.replace("*/", "* /")}
    environment.filters["quoted"] = lambda text: json.dumps(text, ensure_ascii=False)
    header = path.with_suffix(".h")
    calibrations = assessment.calibrations_
    known: dict[str, Any] = {
        "p": prefix,
        "header": header.name,
        "ports": ports,
        "inputs": [one for name, one in inputs.items() if name not in ("alarm", "memory")],
        "columns": {name: _distinct(names) for name, names in columns.items()},
        "contract": contracts["assessor"],
        "monitor": contracts["monitor"],
        "calibrations": calibrations,
        "threshold": next((key for key in ("motion", "plan") if key in calibrations), None),
        "sources": {part: _source(model, prefix, part) for part, model in models.items()},
    }
    templates = {path: "source.c.j2", header: "header.h.j2"}
    templates[path.with_name("example.c")] = "example.c.j2"
    for file, template in templates.items():
        write_file(file, environment.get_template(template).render(known))
    return list(templates)


def _ports(values: Any) -> list[Port]:
    shapes = [[d.dim_value for d in one.type.tensor_type.shape.dim] for one in values]
    return [
        Port(one.name, shape[1] if len(shape) > 1 else None, one.doc_string)
        for one, shape in zip(values, shapes, strict=True)
    ]


def _source(model: onnx.ModelProto, prefix: str, part: str) -> str:
    """The function `{prefix}_{part}_graph`; all its names are static and differ between parts."""
    from emx_onnx_cgen.compiler import Compiler, CompilerOptions

    del model.metadata_props[:]  # They would be in a comment; the header says them.
    options = CompilerOptions(
        model_name=f"{prefix}_{part}_graph",
        restrict_arrays=False,  # C++ does not know the word.
        large_temp_threshold_bytes=0,  # No `malloc`.
        large_weight_threshold=0,  # No second file.
    )
    source = Compiler(options).compile(model)
    source = re.sub(r"^extern const .*\n", "", source, flags=re.M)
    source = re.sub(r"^_Bool \w+_load\(.*?^}\n", "", source, flags=re.M | re.S)
    source = re.sub(r"^(const EMX_UNUSED|void) ", r"static \1 ", source, flags=re.M)
    return re.sub(r"\b(ref_scalar|node\d+|weight\d+)_", rf"{part}_\1_", source)


def _c_name(text: str) -> str:
    return re.sub(r"[^A-Z0-9]+", "_", text.upper()).strip("_")


def _distinct(names: list[str]) -> dict[str, str]:
    """Constants of the columns' names, which two names may not share."""
    constants: dict[str, str] = {}
    for i, name in enumerate(names):
        constant = _c_name(name)
        constants[f"{constant}_{i}" if constant in constants else constant] = name
    return constants
