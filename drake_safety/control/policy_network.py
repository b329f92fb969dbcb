"""Networks of locomotion policies: ONNX and TorchScript files, with or without a memory."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.control.policy_metadata import PolicyMetadata, read_metadata
from drake_safety.extras import require_extra

_MOST = 1_000_000_000  # Bytes of a file.
_SUPPORTED = (
    "supported are one observation, an action, and as memory further inputs and outputs of ONNX in "
    "pairs of one shape, such as h_in and h_out, or buffers of TorchScript"
)
_OF_NEXT = {"in": "out", "ins": "outs", "0": "n"}
"""What an input's name has of memory, and its output's in that place: h_in, h_out or h0, hn."""
_DTYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64}


class PolicyNetwork:
    """A network that maps an observation (n_o,) and its memory (n_m,) to an action (n_a,).

    Args:
        evaluate: Takes a batch (1, n_o) of float32 and the parts of the memory, and returns the
            action and the new parts.
        widths: Of observation and action; None where the file does not say them.
        find_memory: Returns the parts of the memory at the start, for a batch.

    Attributes:
        initial_memory: The memory at the start, (n_m,), known after :meth:`check`; n_m is 0 for a
            network without one.
    """

    def __init__(
        self,
        path: Path,
        evaluate: Callable[..., Sequence[np.ndarray]],
        widths: tuple[int | None, int | None],
        metadata: PolicyMetadata | None = None,
        find_memory: Callable[[np.ndarray], list[np.ndarray]] = lambda batch: [],
    ):
        self.path = path
        self.widths = widths
        self.metadata = metadata or PolicyMetadata()
        self._evaluate = evaluate
        self._find_memory = find_memory
        self._parts: list[np.ndarray] = []
        self.initial_memory = np.zeros(0)

    def __call__(
        self, observation: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the action (n_a,) for an observation (n_o,), and the new memory (n_m,)."""
        ends = np.cumsum([part.size for part in self._parts])
        parts = [
            values.reshape(part.shape).astype(part.dtype)
            for part, values in zip(self._parts, np.split(memory, ends), strict=False)
        ]
        action, *parts = self._evaluate(_batch(observation), *parts)
        return np.asarray(action, dtype=float).reshape(-1), _flat(parts)

    def check(self, who: str, num_inputs: int, num_outputs: int, terms: str) -> None:
        """Checks the widths of the network, and that it remembers nothing but its memory."""
        seen, acting = self.widths
        if seen not in (None, num_inputs):
            raise ValueError(
                f"{who}: the network expects an observation of {seen} entries; the terms have "
                f"{num_inputs}: {terms}"
            )
        probe = np.linspace(-1.0, 1.0, num_inputs)
        try:
            self._parts = self._find_memory(_batch(probe))
            self.initial_memory = _flat(self._parts)
            action, later = self(probe, self.initial_memory)
            self(probe, later)
            again, _ = self(probe, self.initial_memory)
        except Exception as error:  # Those of onnxruntime have no common base but this.
            raise ValueError(
                f"{who}: the network takes no observation of {num_inputs} entries ({terms}): "
                f"{str(error).splitlines()[0]}"
            ) from error
        if action.shape != (num_outputs,) or acting not in (None, num_outputs):
            raise ValueError(
                f"{who}: the network returns {action.size} actions, expected one for each of "
                f"{num_outputs} joints"
            )
        if action.tobytes() != again.tobytes():
            raise ValueError(
                f"{who}: the network answers the same observation differently after another, "
                f"though its memory of {len(self._parts)} buffers was set back: it draws random "
                f"numbers, or has a memory that is no buffer of a fixed size; {_SUPPORTED}"
            )


def _batch(observation: np.ndarray) -> np.ndarray:
    return np.asarray(observation, dtype=np.float32)[np.newaxis]


def _flat(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *map(np.ravel, parts)])


def load_network(path: Path) -> PolicyNetwork:
    """Loads a network from an ONNX (``.onnx``) or TorchScript (``.pt``, ``.jit``) file.

    Raises:
        MissingExtraError: The package that evaluates it is not installed.
        ValueError: The file does not exist, is of another kind, or cannot be read.
    """
    loaders = {".onnx": _load_onnx, ".pt": _load_torchscript, ".jit": _load_torchscript}
    if path.suffix not in loaders:
        raise ValueError(
            f"{path}: a policy's network is one of {list(loaders)}; got '{path.suffix}'"
        )
    if not path.is_file() or path.stat().st_size > _MOST:
        raise ValueError(f"{path}: the policy's network does not exist")
    return loaders[path.suffix](path)


def network_files(path: Path) -> list[Path]:
    """Returns a network's file, and those with the weights of an ONNX network (external data).

    Raises:
        ValueError: A file of weights does not exist, or is not below the folder of the network.
    """
    # Without the key of external data in it, nothing needs to be parsed.
    if path.suffix != ".onnx" or not path.is_file() or b"location" not in path.read_bytes():
        return [path]
    require_extra("walking", f"ONNX network {path} with weights in other files", "onnx")
    import onnx
    from onnx import external_data_helper as external

    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception as error:  # Of protobuf, which need not be installed.
        raise ValueError(f"{path}: not an ONNX network: {str(error)[:200]}") from error
    tensors = filter(external.uses_external_data, external._get_all_tensors(model))
    names = sorted({external.ExternalDataInfo(tensor).location for tensor in tensors})
    lost = [
        name
        for name in map(Path, names)
        if name.is_absolute() or ".." in name.parts or not (path.parent / name).is_file()
    ]
    if lost:
        raise ValueError(
            f"{path}: its weights are in {names}, as paths from its folder; there is no "
            f"{', '.join(map(str, lost))}"
        )
    return [path, *(path.parent / name for name in names)]


def _load_onnx(path: Path) -> PolicyNetwork:
    require_extra("walking", f"ONNX network {path}", "onnxruntime")
    import onnxruntime

    network_files(path)  # Names those that are missing.
    options = onnxruntime.SessionOptions()
    # A thread pool costs more than the network, and would make sums depend on its size.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # Its exceptions have no common base but this.
        raise ValueError(
            f"{path}: not an ONNX network: {str(error).splitlines()[0][:200]}"
        ) from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shapes = {one.name: one.shape for one in outputs}
    after = {one.name: _name_after(one.name) for one in inputs}
    memory = [one for one in inputs if _fits(one.shape, shapes.get(after[one.name], []))]
    seen = [one for one in inputs if one not in memory]
    names = [after[one.name] for one in memory]
    acting = [one for one in outputs if one.name not in names]
    if len(seen) != 1 or not acting or any(one.type not in _DTYPES for one in inputs):
        raise ValueError(
            f"{path}: got inputs {[f'{one.name} {one.shape} {one.type}' for one in inputs]} and "
            f"outputs {[f'{one.name} {one.shape}' for one in outputs]}; {_SUPPORTED}"
        )
    (observed,) = seen
    axes = (1,) * (len(observed.shape) - 1)

    def evaluate(batch: np.ndarray, *parts: np.ndarray) -> list[np.ndarray]:
        given = {one.name: part for one, part in zip(memory, parts, strict=True)}
        given[observed.name] = batch.astype(_DTYPES[observed.type]).reshape(*axes, -1)
        return session.run([acting[0].name, *names], given)

    return PolicyNetwork(
        path,
        evaluate,
        (_width(observed.shape), _width(acting[0].shape)),
        read_metadata(session.get_modelmeta().custom_metadata_map),
        lambda batch: [np.zeros(_fixed(one.shape), _DTYPES[one.type]) for one in memory],
    )


def _fixed(shape: list[Any]) -> list[int]:
    """A shape for one robot: a size that varies is that of the batch."""
    return [size if isinstance(size, int) else 1 for size in shape]


def _fits(shape: list[Any], other: list[Any]) -> bool:
    pairs = zip(shape, other, strict=False)
    return len(shape) == len(other) > 0 and all(
        a == b or str in {type(a), type(b)} for a, b in pairs
    )


def _name_after(name: str) -> str:
    """The output of an input of memory: h_out of h_in."""
    return re.sub(r"(?<![A-Za-z])ins?(?![A-Za-z])|0$", lambda found: _OF_NEXT[found[0]], name)


def _load_torchscript(path: Path) -> PolicyNetwork:
    require_extra("train", f"TorchScript network {path}", "torch")
    import torch

    try:
        with warnings.catch_warnings():
            # Torch deprecates the format, in which policies are nevertheless published.
            warnings.simplefilter("ignore", DeprecationWarning)
            module = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"{path}: not a TorchScript network: {str(error).splitlines()[0][:200]}"
        ) from error
    arguments = [one.name for one in module.forward.schema.arguments[1:]]
    if len(arguments) != 1:
        raise ValueError(f"{path}: got inputs {arguments}; {_SUPPORTED}")
    memory: list[str] = []  # Names of buffers.

    @contextmanager
    def inference() -> Iterator[None]:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # As for ONNX.
        try:
            with torch.inference_mode():
                yield
        finally:
            torch.set_num_threads(threads)

    def copies() -> dict[str, np.ndarray]:
        return {name: buffer.numpy().copy() for name, buffer in module.named_buffers()}

    def evaluate(batch: np.ndarray, *parts: np.ndarray) -> list[np.ndarray]:
        with inference():
            if not memory:
                return [module(torch.from_numpy(batch)).numpy()]
            buffers = dict(module.named_buffers())
            for name, part in zip(memory, parts, strict=True):
                buffers[name].copy_(torch.from_numpy(part))
            action = module(torch.from_numpy(batch)).numpy()
            buffers = dict(module.named_buffers())  # The script may have replaced them.
            return [action, *(buffers[name].numpy().copy() for name in memory)]

    def find_memory(batch: np.ndarray) -> list[np.ndarray]:
        """The buffers that an evaluation changes, as they are before it and after a reset."""
        with inference():
            for reset in ("reset", "reset_memory"):
                # Without one, or with one of several robots, the file has the start.
                with suppress(AttributeError, RuntimeError):
                    getattr(module, reset)()
            before = copies()
            module(torch.from_numpy(batch))
            after = copies()
            memory[:] = [
                name
                for name, value in before.items()
                if value.shape == after[name].shape and value.tobytes() != after[name].tobytes()
            ]
            return [before[name] for name in memory]

    return PolicyNetwork(path, evaluate, (None, None), find_memory=find_memory)


def _width(shape: list[Any]) -> int | None:
    return shape[-1] if shape and isinstance(shape[-1], int) else None
