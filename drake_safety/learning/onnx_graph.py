"""An assessment as one ONNX graph, which runs without this package and without Drake."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.grid import Grid
from drake_safety.learning.novelty import NUM_QUADRATIC, Novelty
from drake_safety.learning.prediction import (
    LOGIT_LIMIT,
    SHIFT_LIMIT,
    BaseLogit,
    Correction,
    unknown_above,
)
from drake_safety.learning.segments import installed_versions
from drake_safety.learning.trained_maps import INPUT_LIMIT, Embedding
from drake_safety.learning.trees import Trees

if TYPE_CHECKING:
    import onnx


SCHEMA_VERSION = 1
"""Version of the graph's ports and of its metadata."""
OPSET = 17
_IR_VERSION = 8  # That of the opset's time, so that old runtimes read the file.
_DESCRIPTIONS = {
    "state": "Measured state.",
    "desired_preview": "Desired outputs over the horizon, row-major in time.",
    "features": "Features of state and preview, computed by the caller.",
    "belief": "Safe, unsafe, don't know; they sum to 1.",
    "safety_probability": 'Probability of staying safe; 0 where it is "don\'t know".',
    "cause_probability": "The belief's unsafe mass split by the violated constraint.",
    "predicted_margins": "Smallest margin of each constraint until the motion's end; negative is "
    "violated; NaN for maps that predict none.",
    "novelty": "Distance from the training inputs; novel above 1.",
    "fall_probability": "Probability of a fall; 1 for inputs that are not finite, NaN if it was "
    "not learned.",
    "embedding": "Place of the input in the first map.",
}
_UNITS = (
    "those of the recorded ports: SI and radians (m, m/s, rad, rad/s, N, N·m) in the tasks of "
    "drake_safety"
)


def write(path: Path, assessment: Any) -> None:
    """Writes `SafetyAssessment.predict` as one ONNX file, atomically.

    The same assessment gives the same bytes.
    """
    require_extra("onnx", f"export to '{path}'")
    import onnx

    info, parameters = assessment.info_, assessment.parameters
    embedding, grid, correction = assessment.embedding_, assessment.grid_, assessment.correction_
    base_logit = assessment.base_logit_
    nodes = _Nodes()
    inputs = {name: info.widths[name] for name in ("state", "desired_preview")}
    if assessment.columns_.has_features:
        inputs["features"] = info.widths["features"]
    x, is_usable = _inputs(nodes, inputs, assessment.columns_.is_used, parameters.feature_unit)
    usable = nodes("Where", is_usable, x, 0.0)
    y, logit, margins, activations = _maps(nodes, usable, embedding)
    share = _novelty(nodes, x, assessment.novelty_)
    is_known = nodes("And", is_usable, nodes("LessOrEqual", share, 1.0))
    weights, inside = _cell_weights(nodes, y, grid)
    num_causes = len(info.constraint_names)
    empty = np.zeros(3 + num_causes)
    empty[belief_masses.UNCERTAINTY] = 1.0
    # Relative to the empty belief, which a map contributes whose output lies outside its grid.
    relative = (assessment.beliefs_ - empty) / embedding.num_members
    masses = nodes("Add", _read_grid(nodes, weights, relative), empty)
    masses = nodes("Where", is_known, masses, empty, output="masses")
    nodes.columns(masses, 0, 3, output="belief")
    nodes.columns(masses, 3, 3 + num_causes, output="cause_probability")
    nan = np.full(num_causes, np.nan)
    nodes("Where", is_usable, nan if margins is None else margins, nan, output="predicted_margins")
    nodes("Squeeze", share, [1], output="novelty")
    first = nodes("Gather", y, np.array(0), axis=0)
    nodes("Where", is_usable, first, np.full(2, np.nan), output="embedding")
    safe, uncertainty = (
        nodes.columns(masses, column, column + 1)
        for column in (belief_masses.SAFE, belief_masses.UNCERTAINTY)
    )
    if base_logit is None:
        probability, fall = safe, None
    else:
        trees = assessment.trees_
        heads = _heads(nodes, logit, margins, base_logit)
        if trees is not None:
            heads = nodes("Concat", heads, _trees(nodes, usable, trees), axis=1)
        slopes = np.array(base_logit.slopes[: 2 if trees is None else 3], dtype=float)
        scaled = nodes("MatMul", heads, slopes[:, None])
        unsafe_logit = nodes.clip(nodes("Add", scaled, base_logit.offset), LOGIT_LIMIT)
        if correction.is_any:
            guard = _read_grid(nodes, weights, correction.guard[..., None])
            num_inside = nodes("ReduceSum", inside, [0], keepdims=0)
            guard = nodes("Div", guard, nodes("Max", num_inside, 1.0))
            shift = _shift(nodes, heads, activations, guard, correction)
            unsafe_logit = nodes("Add", unsafe_logit, shift)
        probability = nodes("Sigmoid", nodes("Neg", unsafe_logit))
        fall = _fall(nodes, margins, unsafe_logit, usable, assessment.fall_logit_)
    is_known = nodes("LessOrEqual", uncertainty, unknown_above(parameters.initial_uncertainty))
    probability = nodes("Where", is_known, probability, 0.0)
    nodes("Squeeze", probability, [1], output="safety_probability")
    # Without it, NaN of N rows.
    fall = nodes("Where", is_usable, fall, 1.0) if fall else nodes("Mul", safe, np.nan)
    nodes("Squeeze", fall, [1], output="fall_probability")
    outputs: dict[str, int | None] = {
        "belief": 3,
        "safety_probability": None,
        "cause_probability": num_causes,
        "predicted_margins": num_causes,
        "novelty": None,
        "embedding": 2,
        "fall_probability": None,
    }
    contract = _contract(assessment, inputs)
    graph = onnx.helper.make_graph(
        nodes.nodes,
        "gamma",
        [_port(name, width) for name, width in inputs.items()],
        [_port(name, width) for name, width in outputs.items()],
        nodes.constants,
    )
    model = onnx.helper.make_model(
        graph,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="drake_safety",
        producer_version=contract["drake_safety"],
    )
    onnx.helper.set_model_props(model, {name: json.dumps(one) for name, one in contract.items()})
    onnx.checker.check_model(model, full_check=True)
    write_file(path, model.SerializeToString(deterministic=True))


def _contract(assessment: Any, ports: Iterable[str]) -> dict[str, Any]:
    """What the file is, by the name of the entry of its metadata."""
    info, parameters = assessment.info_, assessment.parameters
    adaptation, calibrations = assessment.adaptation_, assessment.calibrations_.values()
    preview = [f"{name} [{k}]" for k in range(info.horizon) for name in info.output_names]
    columns = {
        "state": info.state_names,
        "desired_preview": preview,
        "features": info.feature_names,
    }
    return {
        "schema_version": SCHEMA_VERSION,
        "drake_safety": installed_versions()["drake_safety"],
        "scenario": info.scenario,
        "scenario_hash": info.scenario_hash,
        "mode": parameters.mode,
        "plant": info.variation,
        "adaptation": None if adaptation is None else asdict(adaptation),
        "inputs": {name: columns[name] for name in ports},
        "constraint_names": info.constraint_names,
        "units": _UNITS,
        "horizon": info.horizon,
        "step_s": info.step_s,
        "preview_step_s": info.preview_step_s,
        "unknown_above": unknown_above(parameters.initial_uncertainty),
        "calibrations": [one.to_json() | {"promise": one.promise} for one in calibrations],
    }


class _Nodes:
    """Nodes and constants of a graph; calling it adds a node and returns its output's name.

    Values that are no names become constants: a number one of double precision, a list of integers
    one of indices, an array one of its own type.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def __call__(
        self, operator: str, *inputs: str | Any, output: str | None = None, **attributes: Any
    ) -> str:
        from onnx import helper, numpy_helper

        names = []
        for one in inputs:
            if not isinstance(one, str):
                # Settings may be integers.
                value = np.asarray(one, dtype=float if isinstance(one, int | float) else None)
                value = np.ascontiguousarray(value).reshape(value.shape)
                one = f"constant_{len(self.constants)}"
                self.constants.append(numpy_helper.from_array(value, one))
            names.append(one)
        name = output or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [name], **attributes))
        return name

    def columns(self, value: str, start: int, stop: int, output: str | None = None) -> str:
        """Columns of (N, C)."""
        return self("Slice", value, [start], [stop], [1], output=output)

    def clip(self, value: str, high: float, low: float | None = None) -> str:
        """Clips to [low, high], by default to [-high, high]."""
        return self("Clip", value, -high if low is None else low, high)

    def double(self, value: str) -> str:
        """Converts to double precision."""
        from onnx import TensorProto

        return self("Cast", value, to=TensorProto.DOUBLE)


def _port(name: str, width: int | None) -> onnx.ValueInfoProto:
    """A port of double precision, (N, width) or (N,)."""
    from onnx import TensorProto, helper

    shape: list[str | int | None] = ["N"] if width is None else ["N", width]
    return helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape, _DESCRIPTIONS[name])


def _inputs(
    nodes: _Nodes, ports: Iterable[str], is_used: np.ndarray, feature_unit: float
) -> tuple[str, str]:
    """x, (N, n_x), and which rows the maps can take, (N, 1)."""
    parts = list(ports)
    if not is_used.all():
        parts[0] = nodes("Gather", "state", np.flatnonzero(is_used), axis=1)
    if "features" in ports and feature_unit:
        # Runtimes have no asinh of double precision.
        u = nodes("Div", "features", feature_unit)
        root = nodes("Sqrt", nodes("Add", nodes("Mul", u, u), 1.0))
        size = nodes("Log", nodes("Add", nodes("Abs", u), root))
        parts.append(nodes("Mul", nodes("Sign", u), size))
    x = nodes("Concat", *parts, axis=1, output="x")
    # False for NaN.
    is_small = nodes.double(nodes("Less", nodes("Abs", x), INPUT_LIMIT))
    is_usable = nodes("Greater", nodes("ReduceMin", is_small, axes=[1], keepdims=1), 0.5)
    return x, is_usable


def _maps(nodes: _Nodes, x: str, embedding: Embedding) -> tuple[str, str | None, str | None, str]:
    """y (K, N, 2), safety logits (K, N, 1), mean margins (N, n_c) and activations (K, N, n)."""
    from onnx import TensorProto

    weights = embedding.weights

    def layer(name: str, z: str) -> str:
        bias = embedding.centred_bias if name == "trunk.0" else weights[f"{name}.bias"]
        return nodes("Add", nodes("MatMul", z, weights[f"{name}.weight"]), bias[:, None])

    z = x
    if np.isfinite(embedding.input_range).any():
        low, high = embedding.input_range.astype(float)
        z = nodes("Max", nodes("Min", z, high), low)
    z = nodes("Cast", nodes("Sub", z, embedding.centre), to=TensorProto.FLOAT)
    for i in range(embedding.num_layers):
        z = nodes("Relu", layer(f"trunk.{i}", z))
    output = layer("output", z)
    y = nodes("Slice", output, [0], [2], [2])
    logit = margins = None
    if embedding.has_safety_head:
        logit = nodes.double(layer("safety.1", nodes("Relu", layer("safety.0", y))))
    if embedding.num_margins:
        margins = nodes.double(nodes("Slice", output, [2], [2 + embedding.num_margins], [2]))
        margins = nodes("ReduceMean", margins, axes=[0], keepdims=0)
    return nodes.double(y), logit, margins, z


def _novelty(nodes: _Nodes, x: str, novelty: Novelty) -> str:
    """The largest distance in units of its limit, (N, 1), in double precision."""
    of = novelty.quadratic
    offset = nodes("Sub", x, of.mean)
    entries = nodes("Concat", offset, nodes("MatMul", offset, of.axes), axis=1)
    inverse = novelty.inverse_limits
    terms = of.terms * inverse[:NUM_QUADRATIC]
    shares = nodes("MatMul", nodes("Mul", entries, entries), terms)
    if len(inverse) > NUM_QUADRATIC:
        scale = novelty.inverse_half_width * np.sqrt(inverse[-1])
        outside = nodes("Mul", nodes("Sub", x, novelty.centre), scale)
        shares = nodes("Concat", shares, nodes("Mul", outside, outside), axis=1)
    largest = nodes("ReduceMax", shares, axes=[1], keepdims=1)
    # Of inputs that are not finite, some entries are NaN.
    is_finite = nodes("Less", largest, np.inf)
    return nodes("Sqrt", nodes("Where", is_finite, nodes("Max", largest, 0.0), np.inf))


def _cell_weights(nodes: _Nodes, y: str, grid: Grid) -> tuple[str, str]:
    """Weights of the R cells along each axis at y, (K, N, 2, R); 1 inside the grid, (K, N, 1).

    One or two weights of an axis are not zero; all of them are outside the grid.
    """
    resolution, last = grid.resolution, grid.resolution - 1
    position = nodes("Div", nodes("Add", y, grid.half_width), grid.cell_length)
    # False for NaN.
    is_within = nodes(
        "And", nodes("GreaterOrEqual", position, 0.0), nodes("Less", position, float(resolution))
    )
    inside = nodes("ReduceMin", nodes.double(is_within), axes=[2], keepdims=1)
    position = nodes("Where", nodes("Greater", inside, 0.0), position, 0.0)
    cells = np.arange(resolution, dtype=float)
    if grid.interpolates:
        position = nodes.clip(nodes("Sub", position, 0.5), float(last), 0.0)
        distance = nodes("Abs", nodes("Sub", nodes("Unsqueeze", position, [3]), cells))
        weights = nodes("Max", nodes("Sub", 1.0, distance), 0.0)
    else:
        cell = nodes("Unsqueeze", nodes("Floor", position), [3])
        weights = nodes.double(nodes("Equal", cell, cells))
    return nodes("Mul", weights, nodes("Unsqueeze", inside, [3])), inside


def _read_grid(nodes: _Nodes, weights: str, values: np.ndarray) -> str:
    """The weighted sum of the cells' values (K, R*R, C) over cells and maps, (N, C)."""
    num_members, num_cells, num_columns = values.shape
    resolution = math.isqrt(num_cells)
    first, second = (nodes("Slice", weights, [axis], [axis + 1], [2]) for axis in range(2))
    along = nodes("MatMul", first, values.reshape(num_members, 1, resolution, -1))
    along = nodes("Reshape", along, [0, 0, resolution, num_columns])
    return nodes("ReduceSum", nodes("MatMul", second, along), [0, 2], keepdims=0)


def _heads(nodes: _Nodes, logit: str | None, margins: str | None, base_logit: BaseLogit) -> str:
    """z and -m / margin_unit, (N, 2); zero for a missing head."""
    columns = []
    if logit is not None:
        clipped = nodes.clip(logit, LOGIT_LIMIT)
        columns.append(nodes("ReduceMean", clipped, axes=[0], keepdims=0))
    if margins is not None:
        low, high = base_logit.margin_range
        smallest = nodes.clip(nodes("ReduceMin", margins, axes=[1], keepdims=1), high, low)
        columns.append(nodes("Div", smallest, -base_logit.margin_unit))
    if len(columns) == 1:
        zero = nodes("Mul", columns[0], 0.0)
        columns.insert(0 if logit is None else 1, zero)
    return nodes("Concat", *columns, axis=1)


def _trees(nodes: _Nodes, x: str, trees: Trees) -> str:
    """The clipped logit of the trees, (N, 1).

    As `Trees.evaluate`, with counts of the nodes that exclude a leaf: the first leaf without any is
    the first of the smallest count.
    """
    from onnx import TensorProto

    arrays = trees.arrays
    num_trees, num_leaves = arrays["value"].shape
    # Trees first: (T, M) and (T, M, M + 1).
    feature, threshold = arrays["feature"].T.astype(np.int64), arrays["threshold"].T
    bits = arrays["left"].T[..., None] >> np.arange(num_leaves, dtype=np.uint32) & 1
    single = nodes("Cast", x, to=TensorProto.FLOAT)
    is_right = nodes("Greater", nodes("Gather", single, feature, axis=1), threshold)
    is_right = nodes("Unsqueeze", nodes("Cast", is_right, to=TensorProto.FLOAT), [2])
    excludes = nodes("Cast", bits.astype(np.uint8), to=TensorProto.FLOAT)
    leaf = nodes("ArgMin", nodes("MatMul", is_right, excludes), axis=3, keepdims=0)
    leaf = nodes("Add", nodes("Squeeze", leaf, [2]), num_leaves * np.arange(num_trees))
    found = nodes.double(nodes("Gather", arrays["value"].ravel(), leaf))
    return nodes.clip(nodes("ReduceSum", found, [1], keepdims=1), LOGIT_LIMIT)


def _fall(
    nodes: _Nodes, margins: str | None, unsafe_logit: str, x: str, fall_logit: FallLogit | None
) -> str | None:
    """The probability of a fall, (N, 1)."""
    if fall_logit is None or margins is None:
        return None
    columns = nodes("Gather", x, np.array(fall_logit.columns, dtype=np.int64), axis=1)
    inputs = nodes("Concat", margins, unsafe_logit, columns, axis=1)
    logit = nodes("MatMul", inputs, np.array(fall_logit.weights)[:, None])
    return nodes("Sigmoid", nodes("Add", logit, fall_logit.offset))


def _shift(nodes: _Nodes, heads: str, activations: str, guard: str, correction: Correction) -> str:
    """The shift of the base logit by feedback, (N, 1), see `Correction.shift`."""
    shift = nodes("Add", nodes("MatMul", heads, correction.change[1:, None]), correction.change[0])
    if correction.hidden.any():
        added = nodes("MatMul", nodes.double(activations), correction.hidden[:, :-1, None])
        added = nodes("ReduceSum", added, [0], keepdims=0)
        added = nodes("Add", added, correction.hidden[:, -1].sum())
        low, high = correction.hidden_range
        shift = nodes("Add", shift, nodes.clip(added, high, low))
    shift = nodes.clip(shift, SHIFT_LIMIT)
    lessened = nodes("Mul", nodes("Sub", 1.0, guard), shift)
    return nodes("Where", nodes("Less", shift, 0.0), lessened, shift)
