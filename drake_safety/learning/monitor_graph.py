"""One step of a `ChangeDetector` as nodes of a graph, with its memory as input and output."""

import itertools

import numpy as np

from drake_safety.learning.change_detector import (
    LEAST_JUDGED,
    MOST_INNOVATION,
    RECOVERED_LEVEL,
    RECOVERY_S,
    SETTLING_S,
    TIME_CONSTANTS_S,
    ChangeDetector,
)
from drake_safety.learning.graph_nodes import Graph, Value
from drake_safety.learning.state_predictor import HIDDEN_SIZES, LARGEST_INPUT, StatePredictor

DESCRIPTIONS = {
    "hold": "1 while a known disturbance acts, else 0.",
    "memory": "Memory of the monitor: `next_memory` of the last step, 0 at the start.",
    "alarm": "1 during an alarm, else 0.",
    "levels": "Level of each monitored state; an alarm rises above 1.",
    "innovation": "Error of the predicted change of each monitored state, in standard deviations; "
    "NaN where the step is not judged.",
    "judged_share": "Share of inputs that could be judged over two seconds.",
    "cause": "Index of the alarm's cause among the `causes`; -1 without an alarm.",
    "next_memory": "Memory for the next step; all zeros at the start.",
}
_NUM_CHARTS = 2 * len(TIME_CONSTANTS_S)


def cause_names(detector: ChangeDetector, state_names: list[str]) -> list[str]:
    """Meaning of each index of the port `cause`."""
    charts = itertools.product(("mean", "irregularity"), TIME_CONSTANTS_S, detector.watched)
    names = [f"{state_names[i]}, {kind} over {2.0 * t:g} s" for kind, t, i in charts]
    return [*names, "inputs frozen", "blind"]


def memory_sizes(detector: ChangeDetector) -> dict[str, int]:
    """Entries of each part of the memory, in order."""
    n_w, n_u = len(detector.watched), len(detector.columns)
    arrays = {"state": n_w, "x": n_u, "previous": n_u, "charts": _NUM_CHARTS * n_w, "levels": n_w}
    numbers = "num_finite", "num_lost", "repeats", "lost_share", "alarm", "below_s", "cause"
    return arrays | dict.fromkeys((*numbers, "wait_s"), 1)


def add_monitor(graph: Graph, detector: ChangeDetector, ports: list[str]) -> None:
    """Adds one step of a `ChangeMonitor`; `ports` name state, preview and features."""
    n_w, sizes = len(detector.watched), memory_sizes(detector)
    ends = [0, *itertools.accumulate(sizes.values())]
    memory = Value(graph, "memory")
    old = {
        name: memory.part(*ends_of, axis=1)
        for name, ends_of in zip(sizes, itertools.pairwise(ends), strict=True)
    }
    row = graph.node("Concat", *(Value(graph, name) for name in ports), axis=1)
    x, state = row.Gather(detector.columns, axis=1), row.Gather(detector.watched, axis=1)
    new = {"state": state, "x": x, "previous": old["x"]}

    is_held = Value(graph, "hold").Greater(0.5)
    new["wait_s"] = is_held.Where(SETTLING_S, (old["wait_s"] - detector.step_s).Max(0.0))
    is_waiting = new["wait_s"].Greater(1e-9)

    is_finite = (x * x).ReduceSum([1], keepdims=1).Less(np.inf)  # Not for NaN.
    is_charted = is_finite.And(old["num_finite"].Greater(1.5))
    is_lost = is_finite.Not().Or(old["num_lost"].Greater(0.5))
    new["num_finite"] = is_finite.Where((old["num_finite"] + 1.0).Min(2.0), 0.0)
    new["num_lost"] = is_finite.Where((old["num_lost"] - 1.0).Max(0.0), 2.0)
    change = is_lost.double() - old["lost_share"]
    new["lost_share"] = old["lost_share"] + change * float(detector.rates[-1])

    error = _error(detector.predictor, old["x"], old["previous"], state - old["state"])
    innovation = (error / detector.deviation).Max(-MOST_INNOVATION).Min(MOST_INNOVATION)
    values = innovation, innovation * innovation - 1.0
    every = graph.node("Concat", *(v for v in values for _ in TIME_CONSTANTS_S), axis=1)
    rates = np.tile(np.repeat(detector.rates, n_w), 2)
    charts = old["charts"] + (every - old["charts"]) * rates
    new["charts"] = is_charted.Where(charts, old["charts"])

    is_repeated = x.Equal(old["x"]).double().ReduceMin(axes=[1], keepdims=1).Greater(0.5)
    is_repeated = is_repeated.And(old["num_finite"].Greater(0.5))
    new["repeats"] = is_repeated.Where(old["repeats"] + 1.0, 0.0)
    means, squares = (new["charts"].part(*e, axis=1) for e in ((0, 3 * n_w), (3 * n_w, 6 * n_w)))
    ratio = means.Abs().Concat(squares, axis=1) / detector.limits.ravel()
    concerns_all = new["repeats"] / float(detector.longest_repeat)
    concerns_all = concerns_all.Max(new["lost_share"] / (1.0 - LEAST_JUDGED))
    levels = ratio.Reshape([0, _NUM_CHARTS, n_w]).ReduceMax(axes=[1], keepdims=0).Max(concerns_all)

    highest = levels.ReduceMax(axes=[1], keepdims=1)
    is_above = highest.LessOrEqual(detector.alarm_level).Not()
    below_s = highest.Less(RECOVERED_LEVEL).Where(old["below_s"] + detector.step_s, 0.0)
    is_over = below_s.Greater(RECOVERY_S - 0.5 * detector.step_s).Or(old["alarm"].Less(0.5))
    is_judged = is_lost.Or(is_charted)
    new["levels"] = is_judged.Where(levels, old["levels"])
    new["alarm"] = is_judged.Where(is_above.Or(is_over.Not()).double(), old["alarm"])
    new["below_s"] = is_judged.Where(is_above.Or(is_over).Where(0.0, below_s), old["below_s"])
    # From 1 on, 0 for none.
    cause = new["repeats"].Greater(float(detector.longest_repeat))
    cause = cause.Where(6.0 * n_w + 1.0, ratio.ArgMax(axis=1, keepdims=1).double() + 1.0)
    cause = new["lost_share"].Greater(1.0 - LEAST_JUDGED).Where(6.0 * n_w + 2.0, cause)
    new["cause"] = new["alarm"].Greater(old["alarm"]).Where(cause, old["cause"])

    for name in sizes:
        if name in ("num_finite", "num_lost", "repeats"):
            new[name] = is_waiting.Where(0.0, new[name])
        elif name != "wait_s":
            new[name] = is_waiting.Where(old[name], new[name])
    graph.node("Concat", *(new[name] for name in sizes), axis=1, output="next_memory")
    is_innovation = is_charted.And(is_waiting.Not())
    is_innovation.Where(innovation, np.full(n_w, np.nan), output="innovation")
    (new["levels"] + 0.0).Identity(output="levels")
    alarm = new["alarm"].Greater(0.5)
    alarm.double().Squeeze([1], output="alarm")
    alarm.Where(new["cause"] - 1.0, -1.0).Squeeze([1], output="cause")
    (1.0 - new["lost_share"]).Squeeze([1], output="judged_share")


def _error(predictor: StatePredictor, x: Value, previous: Value, change: Value) -> Value:
    """`StatePredictor.error` of rows, (N, n_w)."""
    w, num_inputs = predictor.weights, len(predictor.mean)
    z = (x.Concat(previous, axis=1) - np.tile(predictor.mean, 2)) / np.tile(predictor.scale, 2)
    z = z.Max(-LARGEST_INPUT).Min(LARGEST_INPUT)
    newest = z.part(0, num_inputs, axis=1)
    beyond = (newest - predictor.high).Max(predictor.low - newest)
    divisor = (beyond.ReduceMax(axes=[1], keepdims=1).Max(0.0) + 1.0).Sqrt()
    z = z.single()
    hidden, one = z, np.float32(1.0)
    for i in range(len(HIDDEN_SIZES)):
        hidden = hidden @ w[f"hidden.{i}.weight"] + w[f"hidden.{i}.bias"]
        hidden = hidden / (hidden.Max(np.float32(-80.0)).Neg().Exp() + one)
    output = hidden @ w["output.weight"] + (z @ w["linear.weight"] + w["linear.bias"])
    return (change - output.double() * predictor.unit) / divisor
