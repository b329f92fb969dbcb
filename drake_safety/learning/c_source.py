"""Assessor and monitor as C99 without dependencies, generated from their graphs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.onnx_graph import make_model

if TYPE_CHECKING:
    import onnx

PARTS = ("assessor", "monitor")
_EXAMPLE = "Verdicts on the rows of a CSV file"  # In the first line of every example.


def write(path: Path, assessment: Any, prefix: str | None = None) -> list[Path]:
    """Writes source, header and example, atomically and with the same bytes; returns the files."""
    prefix = path.stem if prefix is None else prefix
    if not re.fullmatch(r"[A-Za-z_]\w*", prefix, re.ASCII):
        what = f"prefix must be a name in C, of letters, digits and '_'; got '{prefix}'"
        raise ValueError(f"export to '{path}': {what}")
    example = path.with_name("example.c")
    if path == example or (example.exists() and _EXAMPLE not in example.read_text()):
        what = f"it also writes '{example.name}' there, which would be lost"
        raise ValueError(f"export to '{path}': {what}; choose another name or folder")
    require_extra("c", f"export to '{path}'")
    import jinja2

    models = {part: make_model(assessment, part, rows=1) for part in PARTS}
    contracts = [{e.key: json.loads(e.value) for e in m.metadata_props} for m in models.values()]
    inputs = {port.name: port for model in models.values() for port in model.graph.input}
    inputs = {name: port for name, port in inputs.items() if name not in ("alarm", "memory")}
    columns = contracts[1]["inputs"] | contracts[0]["inputs"]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"c_name": _c_name, "comment": lambda text: text.replace("*/", "* /")}
    environment.filters |= {"quoted": lambda text: json.dumps(text, ensure_ascii=False)}
    environment.filters |= {"width": _width}
    header, calibrations = path.with_suffix(".h"), assessment.calibrations_
    known: dict[str, Any] = {
        "p": prefix,
        "P": prefix.upper(),
        "header": header.name,
        "inputs": inputs.values(),
        "ports": {part: (m.graph.input, m.graph.output) for part, m in models.items()},
        "columns": {name: _distinct(columns[name]) for name in inputs},
        "num_inputs": sum(map(_width, inputs.values())),
        "contract": contracts[0],
        "monitor": contracts[1],
        "calibrations": calibrations,
        "threshold": next((key for key in ("motion", "plan") if key in calibrations), None),
        "sources": [_source(model, prefix, part) for part, model in models.items()],
    }
    files = {path: "source.c", header: "header.h", example: "example.c"}
    for file, template in files.items():
        text = environment.get_template(f"{template}.j2").render(known)
        write_file(file, f"{text}\n")
    return list(files)


def _width(port: onnx.ValueInfoProto) -> int:
    """Width of a port of one row; 0 for a number."""
    shape = port.type.tensor_type.shape.dim
    return int(shape[1].dim_value) if len(shape) > 1 else 0


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
    its_own = rf"\b(?!{prefix}_{part}_graph)(ref_scalar|node\d+|weight\d+)_"
    return re.sub(its_own, rf"{part}_\1_", source)


def _c_name(text: str) -> str:
    return re.sub(r"[^A-Z0-9]+", "_", text.upper()).strip("_")


def _distinct(names: list[str]) -> dict[str, str]:
    """Names of columns by their constants, which two names may not share."""
    constants: dict[str, str] = {}
    for i, name in enumerate(names):
        constant = _c_name(name)
        constants[f"{constant}_{i}" if constant in constants else constant] = name
    return constants
