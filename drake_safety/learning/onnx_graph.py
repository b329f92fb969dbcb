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
from drake_safety.learning.beliefs import EMPTY, SAFE, UNCERTAINTY, empty
from drake_safety.learning.graph_nodes import Graph, Value
from drake_safety.learning.grid import Grid
from drake_safety.learning.monitor_graph import DESCRIPTIONS as _OF_MONITOR
from drake_safety.learning.monitor_graph import add_monitor, cause_names, memory_sizes
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


SCHEMA_VERSION = 1  # Version of the graph's ports and metadata.
OPSET = 17
_IR_VERSION = 8  # As old as the opset, so that old runtimes read the file.
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
_DESCRIPTIONS |= _OF_MONITOR | {
    "margins": "Signed margins of the measured state; negative is outside the safe set.",
    "belief_without_alarm": "The belief if there were no alarm.",
    "probability_without_alarm": "The probability if there were no alarm.",
}
_CHECKED = ("belief", "safety_probability", "cause_probability")
"""Outputs that margins and alarm change."""
PARTS = {
    "gamma": ([], _OUTPUTS),
    "assessor": (
        ["margins", "alarm"],
        [*_OUTPUTS, "belief_without_alarm", "probability_without_alarm"],
    ),
    "monitor": (["hold", "memory"], list(_OF_MONITOR)[2:]),
}
"""Inputs beside Γ's, and outputs, by part.

Parts: Γ alone; Γ with margins and alarm as in `SafetyAssessor`; one step of a `ChangeMonitor`.
"""
_UNITS = "as in the recorded ports: SI and radians (m, m/s, rad, rad/s, N, N·m) in the tasks of "
_UNITS += "drake_safety"


def write(path: Path, assessment: Any, part: str = "gamma") -> None:
    """Writes a part as one ONNX file, atomically and with the same bytes."""
    require_extra("onnx", f"export to '{path}'")
    if part not in PARTS:
        raise ValueError(f"export to '{path}': part must be one of {list(PARTS)}; got '{part}'")
    write_file(path, make_model(assessment, part).SerializeToString(deterministic=True))


def make_model(assessment: Any, part: str, rows: int | str = "N") -> onnx.ModelProto:
    """Makes the graph of a part; by default it takes any number of rows."""
    import onnx

    info, detector, graph = assessment.info_, assessment.detector_, Graph()
    ports = ["state", "desired_preview"]
    # The monitor reads the place of the features among all columns.
    if assessment.columns_.has_features or (part == "monitor" and info.feature_names):
        ports.append("features")
    further, outputs = PARTS[part]
    contract = _contract(assessment, [*ports, *further])
    if part == "monitor":
        add_monitor(graph, detector, ports)
        monitored = [info.state_names[i] for i in detector.watched]
        contract |= {"step_s": detector.step_s, "monitored": monitored}
        contract |= {"causes": cause_names(detector, info.state_names)}
    else:
        inner = "_of_gamma" if part == "assessor" else ""
        feature_unit = assessment.parameters.feature_unit
        _add_prediction(graph, assessment.model, ports, feature_unit, inner)
        if inner:
            _add_checks(graph, inner, len(info.constraint_names))
    widths = info.widths | dict.fromkeys(outputs) | {"embedding": 2, "belief": 3}
    widths |= dict.fromkeys(("cause_probability", "predicted_margins"), info.widths["margins"])
    widths |= dict.fromkeys(("levels", "innovation"), len(detector.watched))
    widths |= {"hold": 1, "belief_without_alarm": 3}
    widths |= dict.fromkeys(("memory", "next_memory"), sum(memory_sizes(detector).values()))
    if part == "assessor":
        widths["alarm"] = 1

    def described(names: Iterable[str]) -> list[onnx.ValueInfoProto]:
        """Ports of double precision, (N, width) or (N,)."""
        return [
            onnx.helper.make_tensor_value_info(
                *(name, onnx.TensorProto.DOUBLE),
                [rows] if widths[name] is None else [rows, widths[name]],
                _DESCRIPTIONS[name],
            )
            for name in names
        ]

    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            *(graph.nodes, part, described([*ports, *further]), described(outputs)),
            graph.constants,
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="drake_safety",
        producer_version=contract["drake_safety"],
    )
    onnx.helper.set_model_props(model, {name: json.dumps(v) for name, v in contract.items()})
    onnx.checker.check_model(model, full_check=True)
    return model


def _contract(assessment: Any, ports: Iterable[str]) -> dict[str, Any]:
    """Metadata of the file, by entry."""
    info, parameters = assessment.info_, assessment.parameters
    adaptation, calibrations = assessment.adaptation_, assessment.calibrations_.values()
    preview = [f"{name} [{k}]" for k in range(info.horizon) for name in info.output_names]
    columns = info.columns | {"desired_preview": preview, "margins": info.constraint_names}
    memory = memory_sizes(assessment.detector_).items()
    columns |= {"alarm": ["alarm"], "hold": ["hold"]}
    columns |= {"memory": [f"{name} [{i}]" for name, size in memory for i in range(size)]}
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


def _add_prediction(
    graph: Graph, model: Model, ports: Iterable[str], feature_unit: float, inner: str
) -> None:
    """Adds `Model.predict`; outputs are named like ports, `_CHECKED` outputs with a suffix."""
    base_logit, correction, embedding = model.base_logit, model.correction, model.embedding
    num_causes = model.num_causes
    parts = [Value(graph, name) for name in ports]
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
    masses.part(0, 3, axis=1, output="belief" + inner)
    masses.part(3, 3 + num_causes, axis=1, output="cause_probability" + inner)
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
    is_known.Where(probability, 0.0).Squeeze([1], output="safety_probability" + inner)
    # Without it, NaN of N rows.
    fall = safe * np.nan if fall is None else is_usable.Where(fall, 1.0)
    fall.Squeeze([1], output="fall_probability")


def _add_checks(graph: Graph, inner: str, num_causes: int) -> None:
    """Adds what a `SafetyAssessor` makes of Γ by the measured margins and an alarm."""
    belief, probability, cause = (Value(graph, name + inner) for name in _CHECKED)
    margins, alarm = Value(graph, "margins"), Value(graph, "alarm")
    is_finite = margins.Abs().Less(np.inf)  # Not for NaN.
    is_inside = is_finite.And(margins.GreaterOrEqual(0.0)).double()
    is_inside = is_inside.ReduceMin(axes=[1], keepdims=1).Greater(0.5)
    are_finite = is_finite.double().ReduceMin(axes=[1], keepdims=1).Greater(0.5)
    violated = are_finite.Where(margins, is_finite.double()).ArgMin(axis=1, keepdims=1)
    safe, unsafe, unknown = (belief.part(i, i + 1, axis=1) for i in range(3))
    is_violated = violated.double().Equal(np.arange(num_causes, dtype=float)).double()
    cause = is_inside.Where(cause, cause + is_violated * safe)
    outside = graph.node("Concat", safe * 0.0, unsafe + safe, unknown, axis=1)
    belief = is_inside.Where(belief, outside, output="belief_without_alarm")
    probability = is_inside.Where(probability.Unsqueeze([1]), 0.0)
    probability.Squeeze([1], output="probability_without_alarm")
    is_silent = alarm.Greater(-np.inf).And(alarm.LessOrEqual(0.5))
    is_silent.Where(belief, EMPTY, output="belief")
    is_silent.Where(probability, 0.0).Squeeze([1], output="safety_probability")
    is_silent.Where(cause, 0.0, output="cause_probability")


def _maps(x: Value, embedding: Embedding) -> tuple[Value, tuple[Value, Value] | None, Value]:
    """y (K, N, 2), safety logits (K, N, 1) and mean margins (N, n_c), activations (K, N, n)."""
    weights = embedding.weights

    def layer(name: str, z: Value) -> Value:
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


def _novelty(x: Value, novelty: Novelty) -> Value:
    """The largest distance in units of its limit, (N, 1), in double precision."""
    quadratic, inverse = novelty.quadratic, novelty.inverse_limits
    offset = x - quadratic.mean
    entries = offset.Concat(offset @ quadratic.axes, axis=1)
    shares = entries * entries @ (quadratic.terms * inverse[:NUM_QUADRATIC])
    if inverse[-1] > 0.0:
        outside = (x - novelty.centre) * (novelty.inverse_half_width * np.sqrt(inverse[-1]))
        shares = shares.Concat(outside * outside, axis=1)
    largest = shares.ReduceMax(axes=[1], keepdims=1)
    # Inputs that are not finite make some entries NaN.
    return largest.Less(np.inf).Where(largest.Max(0.0), np.inf).Sqrt()


def _cell_weights(y: Value, grid: Grid) -> tuple[Value, Value]:
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


def _read_grid(weights: Value, values: np.ndarray) -> Value:
    """The weighted sum of the cells' values (K, R*R, C) over cells and maps, (N, C)."""
    num_members, num_cells, num_columns = values.shape
    resolution = math.isqrt(num_cells)
    first, second = (weights.part(axis, axis + 1, axis=2) for axis in range(2))
    along = first @ values.reshape(num_members, 1, resolution, -1)
    along = along.Reshape([0, 0, resolution, num_columns])
    return (second @ along).ReduceSum([0, 2], keepdims=0)


def _trees(x: Value, trees: Trees) -> Value:
    """The clipped logit of the trees, (N, 1), from counts of the nodes that exclude a leaf."""
    arrays = trees.arrays
    num_trees, num_leaves = arrays["value"].shape
    # Trees first: (T, M) and (T, M, M + 1).
    feature, threshold = arrays["feature"].T.astype(np.int64), arrays["threshold"].T
    bits = arrays["left"].T[..., None] >> np.arange(num_leaves, dtype=np.uint32) & 1
    is_right = x.single().Gather(feature, axis=1).Greater(threshold)
    is_right = is_right.Cast(to=2).Unsqueeze([2])  # onnx.TensorProto.UINT8
    leaf = is_right.MatMulInteger(bits.astype(np.uint8)).ArgMin(axis=3, keepdims=0)
    leaf = leaf.Squeeze([2]) + num_leaves * np.arange(num_trees)
    logits = x.graph.node("Gather", arrays["value"].ravel(), leaf).double()
    return logits.ReduceSum([1], keepdims=1).Clip(-LOGIT_LIMIT, LOGIT_LIMIT)


def _shift(heads: Value, activations: Value, guard: Value, correction: Correction) -> Value:
    """The shift of the base logit by feedback, (N, 1), see `Correction.shift`."""
    hidden = correction.hidden
    shift = heads @ correction.change[1:, None] + correction.change[0]
    if hidden.any():
        added = (activations.double() @ hidden[:, :-1, None]).ReduceSum([0], keepdims=0)
        shift = shift + (added + hidden[:, -1].sum()).Clip(*correction.hidden_range)
    shift = shift.Clip(-SHIFT_LIMIT, SHIFT_LIMIT)
    lessened = (1.0 - guard) * shift
    return shift.Less(0.0).Where(lessened, shift)
