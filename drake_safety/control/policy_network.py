"""Networks of locomotion policies: ONNX and TorchScript files, and what they say of policies."""

from __future__ import annotations

import ast
import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import FiniteFloat

from drake_safety.extras import require_extra
from drake_safety.files.schema import Bounds, load_typed

_MOST = 1_000_000_000  # Bytes of a file.
_SUPPORTED = (
    "supported are one observation, an action, and as memory further inputs and outputs of ONNX in "
    "pairs of one shape, such as h_in and h_out, or buffers of TorchScript"
)
_Memory = Mapping[str, np.ndarray]


@dataclass(kw_only=True)
class PolicyMetadata:
    """What an ONNX file says of its policy; empty where it says nothing.

    Attributes:
        joints: Joint names in the network's order.
        stiffness, damping: Servo gains by regular expression [N·m/rad, N·m·s/rad].
        default_positions, action_scale: As in ``policy.yaml``, by regular expression [rad].
        observation: As in ``policy.yaml``, but terms have only the keys that the file states.
        command: Lowest and highest v_x, v_y and ω_z by name [m/s, rad/s].
        unread: Entries that do not fit, and why.
    """

    joints: list[str] = field(default_factory=list)
    stiffness: dict[str, float] = field(default_factory=dict)
    damping: dict[str, float] = field(default_factory=dict)
    default_positions: dict[str, float] = field(default_factory=dict)
    action_scale: dict[str, float] = field(default_factory=dict)
    observation: list[dict[str, Any]] = field(default_factory=list)
    command: dict[str, list[float]] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


# Keys of Holosoma, then of Isaac Lab and mjlab.
_KEYS = {
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
    "scale": ("observation_terms_scale",),
    "clip": ("observation_terms_clip",),
    "history": ("observation_history_lengths", "observation_terms_history_length"),
    "command": ("command_ranges",),
}
_VELOCITIES = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "ang_vel_yaw")
TERM_NAMES = {
    "command": "velocity_commands",
    "keyboard_velocity_commands": "velocity_commands",
    "joint_pos": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
    "actions": "last_action",
}
"""Registered terms by the names of Isaac Lab's and mjlab's tasks, where these differ."""


def read_metadata(raw: Mapping[str, str]) -> PolicyMetadata:
    """Reads the entries of an ONNX file's metadata that describe its policy.

    Values are JSON, Python's, or words and numbers between commas. Numbers are one for all joints,
    one for each, or by regular expression.
    """
    joints = _words(raw.get("dof_names", raw.get("joint_names", "")))
    names = _words(raw.get("observation_names", ""))
    terms: list[dict[str, Any]] = [{"name": TERM_NAMES.get(name, name)} for name in names]
    found = PolicyMetadata(joints=joints, observation=terms)
    for name, keys in _KEYS.items():
        text = next((raw[key] for key in keys if raw.get(key)), "")
        value = _parsed(text)
        expected = f"a value for each of the terms {names}"
        try:
            if text and name == "command":
                expected = "the lowest and highest velocity by name"
                stated = {key: pair for key, pair in dict(value).items() if key in _VELOCITIES}
                found.command = load_typed(dict[str, Bounds[FiniteFloat]], stated, name)
            elif text and hasattr(found, name):
                expected = f"a number for each of the joints {joints}, one for all or by regular "
                expected += "expression"
                setattr(found, name, _by_joint(value, joints))
            elif text and names:
                values = _by_term(value, names, terms, name)
                for term, one in list(zip(terms, values, strict=True)):
                    term[name] = one
        except (KeyError, TypeError, ValueError, re.error):
            found.unread.append(f"its metadata '{name}' must be {expected}; got {value}")
    return found


def _by_joint(value: Any, joints: list[str]) -> dict[str, float]:
    if isinstance(value, list):
        value = dict(zip(map(re.escape, joints), value, strict=True))
    elif not isinstance(value, dict):
        value = {".*": value}
    numbers = {re.compile(pattern).pattern: float(number) for pattern, number in value.items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError(value)
    return numbers


def _by_term(value: Any, names: list[str], terms: list[dict[str, Any]], key: str) -> list[Any]:
    """Values of a key of ``policy.yaml``; several numbers of a term are between semicolons."""
    value = [value[name] for name in names] if isinstance(value, dict) else value
    texts = value if isinstance(value, list) else [value]
    numbers = [[float(x) for x in str(text).split(";")] for text in texts]
    if key == "history":
        return [max(1, int(length)) for (length,) in numbers]
    if key == "clip":
        clips = zip(terms, numbers, strict=True)
        return [limit(low, high, term.get("scale", [1.0])) for term, (low, high) in clips]
    return numbers


def limit(low: float, high: float, factors: list[float], who: str = "") -> float:
    """Returns the largest absolute value after scaling by factors, of limits before it."""
    limits = {abs(high * factor) for factor in factors}
    if low != -high or len(limits) != 1:
        raise ValueError(
            f"{who} clip must be symmetric, with one scale; got {[low, high]} and {factors}"
        )
    return limits.pop()


def _words(text: str) -> list[str]:
    """Names between commas, or in a list."""
    words = (word.strip(" \n\"'") for word in text.strip("[] \n").split(","))
    return [word for word in words if word]


def _parsed(text: str) -> Any:
    for read in (json.loads, ast.literal_eval):
        with suppress(TypeError, ValueError, SyntaxError, MemoryError, RecursionError):
            value = read(text)
            return list(value) if isinstance(value, tuple) else value
    return text.split(",")


class PolicyNetwork:
    """A network that maps an observation (n_o,) and its memory (n_m,) to an action (n_a,).

    Args:
        evaluate: Maps a batch (1, n_o) of float32 and parts of the memory by name to the action and
            the new parts.
        widths: Of observation and action; None where the file does not say them.
        start: All that may be memory, at the start.

    Attributes:
        initial_memory: (n_m,), known after :meth:`check`; n_m is 0 without a memory.
    """

    def __init__(
        self,
        path: Path,
        evaluate: Callable[[np.ndarray, _Memory], tuple[np.ndarray, _Memory]],
        widths: tuple[int | None, int | None],
        metadata: PolicyMetadata | None = None,
        start: _Memory | None = None,
    ):
        self.path = path
        self.widths = widths
        self.metadata = metadata or PolicyMetadata()
        self._evaluate = evaluate
        self._start = dict(start or {})
        self.initial_memory = np.zeros(0)

    def __call__(
        self, observation: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the action (n_a,) for an observation (n_o,), and the new memory (n_m,)."""
        ends = np.cumsum([part.size for part in self._start.values()])
        pairs = zip(self._start.items(), np.split(memory, ends), strict=False)
        given = {name: new.reshape(one.shape).astype(one.dtype) for (name, one), new in pairs}
        batch = np.asarray(observation, dtype=np.float32)[np.newaxis]
        action, after = self._evaluate(batch, given)
        return np.asarray(action, dtype=float).reshape(-1), _flat(after[name] for name in given)

    def check(self, who: str, num_inputs: int, num_outputs: int, terms: str) -> None:
        """Checks the widths of the network, and that it remembers nothing but its memory."""
        seen, acting = self.widths
        if seen not in (None, num_inputs):
            raise ValueError(
                f"{who}: the network expects an observation of {seen} entries; the terms have "
                f"{num_inputs}: {terms}"
            )
        probe = np.linspace(-1.0, 1.0, num_inputs, dtype=np.float32)
        try:
            _, after = self._evaluate(probe[np.newaxis], self._start)
            # What does not change is no memory, and what grows has no place in a Context.
            self._start = {
                name: part
                for name, part in self._start.items()
                if part.shape == after[name].shape and part.tobytes() != after[name].tobytes()
            }
            self.initial_memory = _flat(self._start.values())
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
        if not np.isfinite(action).all():
            raise ValueError(
                f"{who}: the network returns {np.sum(~np.isfinite(action))} of {num_outputs} "
                "actions that are not finite, for an observation that is: it is damaged, or its "
                "training has diverged"
            )
        if action.tobytes() != again.tobytes():
            raise ValueError(
                f"{who}: the network answers the same observation differently after another, "
                f"though its memory of {len(self._start)} buffers was set back: it draws random "
                f"numbers, or has a memory that is no buffer of a fixed size; {_SUPPORTED}"
            )


def _flat(parts: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *map(np.ravel, parts)])


def load_network(path: Path) -> PolicyNetwork:
    """Loads a network from an ONNX (``.onnx``) or TorchScript (``.pt``, ``.jit``) file.

    Raises:
        MissingExtraError: The package that evaluates it is not installed.
        ValueError: The file does not exist, is of another kind, or cannot be read.
    """
    if path.suffix not in LOADERS:
        raise ValueError(
            f"{path}: a policy's network is one of {list(LOADERS)}; got '{path.suffix}'"
        )
    if not path.is_file() or path.stat().st_size > _MOST:
        raise ValueError(f"{path}: the policy's network does not exist")
    return LOADERS[path.suffix](path)


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

    with _reading(path, "an ONNX network"):
        model = onnx.load(str(path), load_external_data=False)
        # Those of constants and of inner graphs, too.
        weights = [*onnx.external_data_helper._get_all_tensors(model)]
    entries = (entry for weight in weights for entry in weight.external_data)
    names = sorted({entry.value for entry in entries if entry.key == "location"})
    files = {name: path.parent / name for name in names}
    lost = [n for n, file in files.items() if {"/", ".."} & {*Path(n).parts} or not file.is_file()]
    if lost:
        raise ValueError(
            f"{path}: its weights are in {names}, as paths from its folder; there is no "
            f"{', '.join(lost)}"
        )
    return [path, *files.values()]


@contextmanager
def _reading(path: Path, what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # Those of onnxruntime and protobuf have no common base but this.
        raise ValueError(f"{path}: not {what}: {str(error).splitlines()[0][:200]}") from error


def _load_onnx(path: Path) -> PolicyNetwork:
    require_extra("walking", f"ONNX network {path}", "onnxruntime")
    import onnxruntime

    network_files(path)  # Names those that are missing.
    options = onnxruntime.SessionOptions()
    # A thread pool costs more than the network, and would make sums depend on its size.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    with _reading(path, "an ONNX network"):
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shapes = {one.name: _shape(one) for one in outputs}
    # Such as h_out after h_in, or hn after h0.
    pairs = ((one, one.name.replace("_in", "_out")) for one in inputs)
    names = [(one, name) for one, out in pairs for name in (out, re.sub("0$", "n", out))]
    after = {one.name: name for one, name in names if shapes.get(name) == _shape(one)}
    memory = [one for one in inputs if one.name in after]
    seen = [one for one in inputs if one.name not in after]
    acting = [one for one in outputs if one.name not in after.values()]
    if len(seen) != 1 or not acting:
        raise ValueError(
            f"{path}: got inputs {[f'{one.name} {one.shape} {one.type}' for one in inputs]} and "
            f"outputs {[f'{one.name} {one.shape}' for one in outputs]}; {_SUPPORTED}"
        )
    (observed,) = seen
    start = {one.name: np.zeros(_shape(one), np.float32) for one in memory}
    lasts = (one.shape[-1] if one.shape else None for one in (observed, acting[0]))
    num_seen, num_acting = (size if isinstance(size, int) else None for size in lasts)

    def evaluate(batch: np.ndarray, parts: _Memory) -> tuple[np.ndarray, _Memory]:
        given = {**start, **parts, observed.name: batch.reshape(*_shape(observed)[:-1], -1)}
        action, *new = session.run([acting[0].name, *after.values()], given)
        return action, dict(zip(start, new, strict=True))

    metadata = read_metadata(session.get_modelmeta().custom_metadata_map)
    return PolicyNetwork(path, evaluate, (num_seen, num_acting), metadata, start)


def _shape(one: Any) -> list[int]:
    """A shape for one robot: a size that varies is that of the batch."""
    return [size if isinstance(size, int) else 1 for size in one.shape]


def _load_torchscript(path: Path) -> PolicyNetwork:
    require_extra("train", f"TorchScript network {path}", "torch")
    import torch

    with _reading(path, "a TorchScript network"), warnings.catch_warnings():
        # Torch deprecates the format, in which policies are nevertheless published.
        warnings.simplefilter("ignore", DeprecationWarning)
        module = torch.jit.load(str(path), map_location="cpu").eval()
    arguments = [one.name for one in module.forward.schema.arguments[1:]]
    if len(arguments) != 1:
        raise ValueError(f"{path}: got inputs {arguments}; {_SUPPORTED}")
    for reset in ("reset", "reset_memory"):
        # Without one, or with one of several robots, the file has the start.
        with suppress(AttributeError, RuntimeError):
            getattr(module, reset)()

    def evaluate(batch: np.ndarray, parts: _Memory) -> tuple[np.ndarray, _Memory]:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # As for ONNX.
        try:
            with torch.inference_mode():
                buffers = dict(module.named_buffers())
                for name, part in parts.items():
                    buffers[name].copy_(torch.from_numpy(part))
                action = module(torch.from_numpy(batch)).numpy()
                buffers = dict(module.named_buffers())  # The script may have replaced them.
                return action, {name: buffers[name].numpy().copy() for name in parts}
        finally:
            torch.set_num_threads(threads)

    start = {name: buffer.numpy().copy() for name, buffer in module.named_buffers()}
    return PolicyNetwork(path, evaluate, (None, None), start=start)


LOADERS: dict[str, Callable[[Path], PolicyNetwork]] = {
    ".onnx": _load_onnx,
    ".pt": _load_torchscript,
    ".jit": _load_torchscript,
}
"""Readers of networks by the ends of their files' names."""
