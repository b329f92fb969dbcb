"""An assessment as one ONNX graph, which runs without this package and without Drake."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.atomic import write_file
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, empty
from drake_safety.learning.grid import Grid
from drake_safety.learning.novelty import NUM_QUADRATIC, Novelty
from drake_safety.learning.prediction import (
    LOGIT_LIMIT,
    SHIFT_LIMIT,
    Correction,
    Model,
    unknown_above,
)
from drake_safety.learning.segments import installed_versions
from drake_safety.learning.trained_maps import INPUT_LIMIT, Embedding
from drake_safety.learning.trees import Trees

if TYPE_CHECKING:
    import onnx


SCHEMA_VERSION = 1  # Of the graph's ports and of its metadata.
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
    "embedding": "Place of the input in the first map.",
    "fall_probability": "Probability of a fall; 1 for inputs that are not finite, NaN if it was "
    "not learned.",
}
_OUTPUTS = list(_DESCRIPTIONS)[3:]
_UNITS = "those of the recorded ports: SI and radians (m, m/s, rad, rad/s, N, N·m) in the tasks of "
_UNITS += "drake_safety"


class _Graph:
    """Nodes and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(
        self, operator: str, *inputs: Any, output: str | None = None, **attributes: Any
    ) -> _Value:
        """Adds a node and returns its output; inputs that are no values become constants."""
        from onnx import helper, numpy_helper

        names = []
        for given in inputs:
            if isinstance(given, _Value):
                names.append(given.name)
                continue
            value = np.ascontiguousarray(given).reshape(np.shape(given))
            names.append(f"constant_{len(self.constants)}")
            self.constants.append(numpy_helper.from_array(value, names[-1]))
        name = output or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [name], **attributes))
        return _Value(self, name)


class _Value:
    """A value of a graph: its operators and methods add the node that has it as first input."""

    def __init__(self, graph: _Graph, name: str):
        self.graph, self.name = graph, name

    def __getattr__(self, operator: str) -> Callable[..., _Value]:
        return lambda *others, **options: self.graph.node(operator, self, *others, **options)

    def __add__(self, other: Any) -> _Value:
        return self.Add(other)

    def __sub__(self, other: Any) -> _Value:
        return self.Sub(other)

    def __rsub__(self, other: float) -> _Value:
        return self.graph.node("Sub", other, self)

    def __mul__(self, other: Any) -> _Value:
        return self.Mul(other)

    def __truediv__(self, other: Any) -> _Value:
        return self.Div(other)

    def __matmul__(self, other: Any) -> _Value:
        return self.MatMul(other)

    def part(self, start: int, stop: int, *, axis: int, output: str | None = None) -> _Value:
        """Entries along an axis."""
        return self.Slice([start], [stop], [axis], output=output)

    def double(self) -> _Value:
        return self.Cast(to=11)  # onnx.TensorProto.DOUBLE

    def single(self) -> _Value:
        return self.Cast(to=1)  # onnx.TensorProto.FLOAT


def write(path: Path, assessment: Any) -> None:
    """Writes `SafetyAssessment.predict` as one ONNX file, atomically and with the same bytes."""
    require_extra("onnx", f"export to '{path}'")
    import onnx

    info, parameters = assessment.info_, assessment.parameters
    ports = ["state", "desired_preview", *["features"] * assessment.columns_.has_features]
    contract, graph = _contract(assessment, ports), _Graph()
    _add_prediction(graph, assessment.model, ports, parameters.feature_unit)
    widths = info.widths | dict.fromkeys(("safety_probability", "novelty", "fall_probability"))
    widths |= dict.fromkeys(("cause_probability", "predicted_margins"), info.widths["margins"])
    widths |= {"belief": 3, "embedding": 2}

    def described(names: Iterable[str]) -> list[onnx.ValueInfoProto]:
        """Ports of double precision, (N, width) or (N,)."""
        return [
            onnx.helper.make_tensor_value_info(
                *(name, onnx.TensorProto.DOUBLE),
                ["N"] if widths[name] is None else ["N", widths[name]],
                _DESCRIPTIONS[name],
            )
            for name in names
        ]

    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes, "gamma", described(ports), described(_OUTPUTS), graph.constants
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="drake_safety",
        producer_version=contract["drake_safety"],
    )
    onnx.helper.set_model_props(model, {name: json.dumps(v) for name, v in contract.items()})
    onnx.checker.check_model(model, full_check=True)
    write_file(path, model.SerializeToString(deterministic=True))


def _contract(assessment: Any, ports: Iterable[str]) -> dict[str, Any]:
    """What the file is, by the name of the entry of its metadata."""
    info, parameters = assessment.info_, assessment.parameters
    adaptation, calibrations = assessment.adaptation_, assessment.calibrations_.values()
    preview = [f"{name} [{k}]" for k in range(info.horizon) for name in info.output_names]
    columns = info.columns | {"desired_preview": preview}
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
        "calibrations": [asdict(each) | {"promise": each.promise} for each in calibrations],
    }


def _add_prediction(graph: _Graph, model: Model, ports: Iterable[str], feature_unit: float) -> None:
    """Adds `Model.predict`; the outputs have the names of the ports."""
    base_logit, correction, embedding = model.base_logit, model.correction, model.embedding
    num_causes = model.num_causes
    parts = [_Value(graph, name) for name in ports]
    if "features" in ports and feature_unit:
        # Runtimes have no asinh of double precision.
        u = parts[-1] / feature_unit
        root = (u * u + 1.0).Sqrt()
        size = (u.Abs() + root).Log()
        parts.append(u.Sign() * size)
    x = graph.node("Concat", *parts, axis=1, output="x")
    is_small = x.Abs().Less(INPUT_LIMIT).double()  # False for NaN.
    is_usable = is_small.ReduceMin(axes=[1], keepdims=1).Greater(0.5)
    usable = is_usable.Where(x, 0.0)
    y, head, activations = _maps(usable, embedding)
    share = _novelty(x, model.novelty)
    is_known = is_usable.And(share.LessOrEqual(1.0))
    weights, inside = _cell_weights(y, model.grid)
    nothing = empty((), num_causes)
    # Relative to the empty belief, which a map contributes whose output lies outside its grid.
    masses = _read_grid(weights, (model.beliefs - nothing) / embedding.num_members) + nothing
    masses = is_known.Where(masses, nothing, output="masses")
    masses.part(0, 3, axis=1, output="belief")
    masses.part(3, 3 + num_causes, axis=1, output="cause_probability")
    nan = np.full(num_causes, np.nan)
    margins = nan if head is None else head[1]
    is_usable.Where(margins, nan, output="predicted_margins")
    share.Squeeze([1], output="novelty")
    is_usable.Where(y.Gather(np.array(0), axis=0), np.full(2, np.nan), output="embedding")
    safe, uncertainty = (masses.part(i, i + 1, axis=1) for i in (SAFE, UNCERTAINTY))
    probability, fall = safe, None
    if base_logit is not None and head is not None:
        z = head[0].Clip(-LOGIT_LIMIT, LOGIT_LIMIT).ReduceMean(axes=[0], keepdims=0)
        smallest = head[1].ReduceMin(axes=[1], keepdims=1).Clip(*base_logit.margin_range)
        heads = z.Concat(smallest / -base_logit.margin_unit, axis=1)
        if model.trees is not None:
            heads = heads.Concat(_trees(usable, model.trees), axis=1)
        slopes = np.array(base_logit.slopes[: 2 if model.trees is None else 3], dtype=float)
        unsafe_logit = heads @ slopes[:, None] + base_logit.offset
        unsafe_logit = unsafe_logit.Clip(-LOGIT_LIMIT, LOGIT_LIMIT)
        if correction.is_any:
            guard = _read_grid(weights, correction.guard[..., None])
            guard = guard / inside.ReduceSum([0], keepdims=0).Max(1.0)
            unsafe_logit = unsafe_logit + _shift(heads, activations, guard, correction)
        probability = unsafe_logit.Neg().Sigmoid()
        if model.fall_logit is not None:
            columns = usable.Gather(np.array(model.fall_logit.columns, dtype=np.int64), axis=1)
            fall_inputs = head[1].Concat(unsafe_logit, columns, axis=1)
            fall = fall_inputs @ np.array(model.fall_logit.weights)[:, None]
            fall = (fall + model.fall_logit.offset).Sigmoid()
    is_known = uncertainty.LessOrEqual(unknown_above(model.initial_uncertainty))
    is_known.Where(probability, 0.0).Squeeze([1], output="safety_probability")
    # Without it, NaN of N rows.
    fall = safe * np.nan if fall is None else is_usable.Where(fall, 1.0)
    fall.Squeeze([1], output="fall_probability")


def _maps(x: _Value, embedding: Embedding) -> tuple[_Value, tuple[_Value, _Value] | None, _Value]:
    """y (K, N, 2), safety logits (K, N, 1) and mean margins (N, n_c), activations (K, N, n)."""
    weights = embedding.weights

    def layer(name: str, z: _Value) -> _Value:
        bias = embedding.centred_bias if name == "trunk.0" else weights[f"{name}.bias"]
        return z @ weights[f"{name}.weight"] + bias[:, None]

    z = x
    if np.isfinite(embedding.input_range).any():
        low, high = embedding.input_range.astype(float)
        z = z.Min(high).Max(low)
    z = (z - embedding.centre).single()
    for i in range(embedding.num_layers):
        z = layer(f"trunk.{i}", z).Relu()
    output = layer("output", z)
    y = output.part(0, 2, axis=2)
    heads = None
    if embedding.has_heads:
        logit = layer("safety.1", layer("safety.0", y).Relu()).double()
        margins = output.part(2, 2 + embedding.num_margins, axis=2).double()
        heads = logit, margins.ReduceMean(axes=[0], keepdims=0)
    return y.double(), heads, z


def _novelty(x: _Value, novelty: Novelty) -> _Value:
    """The largest distance in units of its limit, (N, 1), in double precision."""
    quadratic, inverse = novelty.quadratic, novelty.inverse_limits
    offset = x - quadratic.mean
    entries = offset.Concat(offset @ quadratic.axes, axis=1)
    shares = entries * entries @ (quadratic.terms * inverse[:NUM_QUADRATIC])
    if inverse[-1] > 0.0:
        outside = (x - novelty.centre) * (novelty.inverse_half_width * np.sqrt(inverse[-1]))
        shares = shares.Concat(outside * outside, axis=1)
    largest = shares.ReduceMax(axes=[1], keepdims=1)
    # Of inputs that are not finite, some entries are NaN.
    return largest.Less(np.inf).Where(largest.Max(0.0), np.inf).Sqrt()


def _cell_weights(y: _Value, grid: Grid) -> tuple[_Value, _Value]:
    """Weights of the R cells along each axis at y, (K, N, 2, R); 1 inside the grid, (K, N, 1)."""
    resolution = float(grid.resolution)
    position = (y + grid.half_width) / grid.cell_length
    is_within = position.GreaterOrEqual(0.0).And(position.Less(resolution))
    inside = is_within.double().ReduceMin(axes=[2], keepdims=1)
    position = inside.Greater(0.0).Where(position, 0.0)
    cells = np.arange(resolution)
    if grid.interpolates:
        position = (position - 0.5).Clip(0.0, resolution - 1.0)
        weights = (1.0 - (position.Unsqueeze([3]) - cells).Abs()).Max(0.0)
    else:
        weights = position.Floor().Unsqueeze([3]).Equal(cells).double()
    return weights * inside.Unsqueeze([3]), inside


def _read_grid(weights: _Value, values: np.ndarray) -> _Value:
    """The weighted sum of the cells' values (K, R*R, C) over cells and maps, (N, C)."""
    num_members, num_cells, num_columns = values.shape
    resolution = math.isqrt(num_cells)
    first, second = (weights.part(axis, axis + 1, axis=2) for axis in range(2))
    along = first @ values.reshape(num_members, 1, resolution, -1)
    along = along.Reshape([0, 0, resolution, num_columns])
    return (second @ along).ReduceSum([0, 2], keepdims=0)


def _trees(x: _Value, trees: Trees) -> _Value:
    """The clipped logit of the trees, (N, 1), from counts of the nodes that exclude a leaf."""
    arrays = trees.arrays
    num_trees, num_leaves = arrays["value"].shape
    # Trees first: (T, M) and (T, M, M + 1).
    feature, threshold = arrays["feature"].T.astype(np.int64), arrays["threshold"].T
    bits = arrays["left"].T[..., None] >> np.arange(num_leaves, dtype=np.uint32) & 1
    is_right = x.single().Gather(feature, axis=1).Greater(threshold)
    is_right = is_right.single().Unsqueeze([2])
    excludes = x.graph.node("Cast", bits.astype(np.uint8), to=1)
    leaf = (is_right @ excludes).ArgMin(axis=3, keepdims=0)
    leaf = leaf.Squeeze([2]) + num_leaves * np.arange(num_trees)
    logits = x.graph.node("Gather", arrays["value"].ravel(), leaf).double()
    return logits.ReduceSum([1], keepdims=1).Clip(-LOGIT_LIMIT, LOGIT_LIMIT)


def _shift(heads: _Value, activations: _Value, guard: _Value, correction: Correction) -> _Value:
    """The shift of the base logit by feedback, (N, 1), see `Correction.shift`."""
    hidden = correction.hidden
    shift = heads @ correction.change[1:, None] + correction.change[0]
    if hidden.any():
        added = (activations.double() @ hidden[:, :-1, None]).ReduceSum([0], keepdims=0)
        shift = shift + (added + hidden[:, -1].sum()).Clip(*correction.hidden_range)
    shift = shift.Clip(-SHIFT_LIMIT, SHIFT_LIMIT)
    lessened = (1.0 - guard) * shift
    return shift.Less(0.0).Where(lessened, shift)
