"""Nodes of an ONNX graph, written as arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import onnx


class Graph:
    """Nodes and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(
        self, operator: str, *inputs: Any, output: str | None = None, **attributes: Any
    ) -> Value:
        """Adds a node and returns its output; inputs other than a `Value` become constants."""
        from onnx import helper, numpy_helper

        names = []
        for given in inputs:
            if isinstance(given, Value):
                names.append(given.name)
                continue
            value = np.ascontiguousarray(given).reshape(np.shape(given))
            names.append(f"constant_{len(self.constants)}")
            self.constants.append(numpy_helper.from_array(value, names[-1]))
        name = output or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [name], **attributes))
        return Value(self, name)


def _arithmetic(operator: str) -> Callable[[Value, Any], Value]:
    return lambda value, other: value.graph.node(operator, value, other)


class Value:
    """A value of a graph: its operators and methods add the node that has it as first input."""

    __array_ufunc__ = None  # Arrays leave arithmetic to it.

    def __init__(self, graph: Graph, name: str):
        self.graph, self.name = graph, name

    def __getattr__(self, operator: str) -> Callable[..., Value]:
        return lambda *others, **options: self.graph.node(operator, self, *others, **options)

    __add__ = _arithmetic("Add")
    __sub__ = _arithmetic("Sub")
    __mul__ = _arithmetic("Mul")
    __truediv__ = _arithmetic("Div")
    __matmul__ = _arithmetic("MatMul")

    def __rsub__(self, other: Any) -> Value:
        return self.graph.node("Sub", other, self)

    def part(self, start: int, stop: int, *, axis: int, output: str | None = None) -> Value:
        """Entries along an axis."""
        return self.Slice([start], [stop], [axis], output=output)

    def double(self) -> Value:
        """In double precision."""
        return self.Cast(to=11)  # onnx.TensorProto.DOUBLE

    def single(self) -> Value:
        """In single precision."""
        return self.Cast(to=1)  # onnx.TensorProto.FLOAT
