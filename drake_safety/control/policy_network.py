"""Networks of locomotion policies: ONNX and TorchScript files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.extras import require_extra

_MOST = 1_000_000_000  # Bytes of a file.


@dataclass(kw_only=True)
class PolicyMetadata:
    """What an ONNX file says of its policy; empty where it says nothing.

    Attributes:
        joints: Joint names in the network's order.
        stiffness, damping: Servo gains in that order [N·m/rad, N·m·s/rad].
        default_positions: Joint positions at zero action [rad].
        action_scale: Joint positions per unit of action [rad].
        command: Lowest and highest v_x, v_y and ω_z by name.
    """

    joints: list[str] = field(default_factory=list)
    stiffness: list[float] = field(default_factory=list)
    damping: list[float] = field(default_factory=list)
    default_positions: list[float] = field(default_factory=list)
    action_scale: list[float] = field(default_factory=list)
    command: dict[str, list[float]] = field(default_factory=dict)


# Keys of Holosoma and of Isaac Lab.
_KEYS: dict[str, tuple[str, ...]] = {
    "joints": ("dof_names", "joint_names"),
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
    "command": ("command_ranges",),
}


class PolicyNetwork:
    """A network that maps an observation (n_o,) to an action (n_a,).

    ``evaluate`` takes a batch (1, n_o) of float32; widths that the file does not say are None.
    """

    def __init__(
        self,
        path: Path,
        evaluate: Callable[[np.ndarray], np.ndarray],
        widths: tuple[int | None, int | None],
        metadata: PolicyMetadata | None = None,
    ):
        self.path = path
        self.widths = widths
        self.metadata = metadata or PolicyMetadata()
        self._evaluate = evaluate

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns the action (n_a,) for an observation (n_o,)."""
        batch = np.asarray(observation, dtype=np.float32)[np.newaxis]
        return np.asarray(self._evaluate(batch), dtype=float).reshape(-1)

    def check(self, who: str, num_inputs: int, num_outputs: int, terms: str) -> None:
        """Checks the widths of the network."""
        seen, acting = self.widths
        if seen not in (None, num_inputs):
            raise ValueError(
                f"{who}: the network expects an observation of {seen} entries; the terms have "
                f"{num_inputs}: {terms}"
            )
        try:
            action = self(np.zeros(num_inputs))
        except (RuntimeError, ValueError) as error:
            raise ValueError(
                f"{who}: the network takes no observation of {num_inputs} entries ({terms}): "
                f"{str(error).splitlines()[0]}"
            ) from error
        if action.shape != (num_outputs,) or acting not in (None, num_outputs):
            raise ValueError(
                f"{who}: the network returns {action.size} actions, expected one for each of "
                f"{num_outputs} joints"
            )


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


def _load_onnx(path: Path) -> PolicyNetwork:
    require_extra("walking", f"ONNX network {path}")
    import onnxruntime

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
    if len(inputs) != 1 or not outputs:
        raise ValueError(
            f"{path}: a policy has one input, the observation; got {[one.name for one in inputs]}"
        )
    name, first = inputs[0].name, [outputs[0].name]
    return PolicyNetwork(
        path,
        lambda batch: session.run(first, {name: batch})[0],
        (_width(inputs[0].shape), _width(outputs[0].shape)),
        _read_metadata(path, session.get_modelmeta().custom_metadata_map),
    )


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

    def evaluate(batch: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return module(torch.from_numpy(batch)).numpy()

    return PolicyNetwork(path, evaluate, (None, None))


def _width(shape: list[Any]) -> int | None:
    return shape[-1] if shape and isinstance(shape[-1], int) else None


def _read_metadata(path: Path, raw: dict[str, str]) -> PolicyMetadata:
    """Reads the entries of metadata that describe the policy."""
    found: dict[str, Any] = {}
    for entry, keys in _KEYS.items():
        for key in keys:
            if key in raw:
                found[entry] = _parsed(raw[key])
    metadata = PolicyMetadata(**{name: value for name, value in found.items() if value})
    for name in ("stiffness", "damping", "default_positions", "action_scale"):
        values = getattr(metadata, name)
        is_numbers = isinstance(values, list) and all(
            isinstance(x, int | float) and np.isfinite(x) for x in values
        )
        if values and not (is_numbers and len(values) == len(metadata.joints)):
            raise ValueError(
                f"{path}: metadata '{name}' must be a number for each of the joints "
                f"{metadata.joints}; got {values}"
            )
    return metadata


def _parsed(text: str) -> Any:
    """JSON, or Isaac Lab's words and numbers between commas."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        words = [word.strip() for word in text.split(",")]
    try:
        return [float(word) for word in words]
    except ValueError:
        return words
