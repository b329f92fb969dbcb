"""Networks of locomotion policies: ONNX and TorchScript files, and what they say of policies."""

import ast
import json
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import FiniteFloat

from drake_safety.extras import require_extra
from drake_safety.files.schema import Pattern, load_typed

_SUPPORTED = (
    "expected one observation, one action, and as memory further inputs and outputs of ONNX in "
    "pairs of one shape, such as h_in and h_out, or buffers of TorchScript"
)
_SCRIPT = "TorchScript: code of its author, which runs here"
_KINDS = {".onnx": "ONNX, which is not code", ".pt": _SCRIPT, ".jit": _SCRIPT}
_Memory = Mapping[str, np.ndarray]


@dataclass(kw_only=True)
class PolicyMetadata:
    """Entries of ``policy.yaml`` in an ONNX file's metadata; empty if absent."""

    joints: list[str] = field(default_factory=list)
    stiffness: dict[str, float] = field(default_factory=dict)
    damping: dict[str, float] = field(default_factory=dict)
    default_positions: dict[str, float] = field(default_factory=dict)
    action_scale: dict[str, float] = field(default_factory=dict)
    observation: list[dict[str, Any]] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)  # Entries that do not fit, and why.


# Keys of Holosoma, then of Isaac Lab and mjlab.
_KEYS = {
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
    "scale": ("observation_terms_scale",),
    "clip": ("observation_terms_clip",),
    "history": ("observation_history_lengths", "observation_terms_history_length"),
}
# Registered terms by the names of Isaac Lab's and mjlab's tasks, where these differ.
TERM_NAMES = {
    "command": "velocity_commands",
    "keyboard_velocity_commands": "velocity_commands",
    "joint_pos": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
    "actions": "last_action",
}


def read_metadata(raw: Mapping[str, str]) -> PolicyMetadata:
    """Reads an ONNX file's metadata: numbers for all joints, for each, or by regular expression."""
    joints = _words(raw.get("dof_names", raw.get("joint_names", "")))
    names = _words(raw.get("observation_names", ""))
    terms: list[dict[str, Any]] = [{"name": TERM_NAMES.get(name, name)} for name in names]
    metadata = PolicyMetadata(joints=joints, observation=terms)
    for name, keys in _KEYS.items():
        text = next((raw[key] for key in keys if raw.get(key)), "")
        is_of_terms = name in ("scale", "clip", "history")
        if not text or (is_of_terms and not names):
            continue
        value = _parsed(text)
        try:
            if is_of_terms:
                values = _by_term(value, names, terms, name)
                for term, term_value in list(zip(terms, values, strict=True)):
                    term[name] = term_value
            else:
                if isinstance(value, list):
                    value = dict(zip(map(re.escape, joints), value, strict=True))
                by_joint = value if isinstance(value, dict) else {".*": value}
                setattr(metadata, name, load_typed(dict[Pattern, FiniteFloat], by_joint, name))
        except (KeyError, TypeError, ValueError):
            whose = f"the terms {names}" if is_of_terms else f"the joints {joints}"
            metadata.unread.append(f"its metadata '{name}' do not fit {whose}; got {value}")
    return metadata


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


def limit(low: float, high: float, factors: list[float]) -> float:
    """The largest absolute value after scaling by factors, of limits before it."""
    limits = {abs(high * factor) for factor in factors}
    if low != -high or len(limits) != 1:
        raise ValueError("a clip must be symmetric, with one scale")
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


@dataclass(eq=False)
class PolicyNetwork:
    """A network that maps an observation (n_o,) and its memory (n_m,) to an action (n_a,)."""

    path: Path
    # Maps a batch and parts of the memory by name to the action and the new parts.
    evaluate: Callable[[np.ndarray, _Memory], tuple[np.ndarray, _Memory]]
    widths: tuple[int | None, int | None]  # Observation and action; None if unknown.
    metadata: PolicyMetadata = field(default_factory=PolicyMetadata)
    # The memory at the start by name; all that may be memory until it is checked.
    start: _Memory = field(default_factory=dict)
    shape: tuple[int, ...] = (1, -1)  # A batch of one observation.
    dtype: Any = np.float32
    outputs: list[str] = field(default_factory=list)  # Names and shapes, the action first.

    @property
    def initial_memory(self) -> np.ndarray:
        """The memory at the start, (n_m,); n_m is 0 without a memory."""
        return _flat(self.start.values())

    def __call__(
        self, observation: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the action (n_a,) for an observation (n_o,), and the new memory (n_m,)."""
        ends = np.cumsum([part.size for part in self.start.values()])
        parts = zip(self.start.items(), np.split(memory, ends), strict=False)
        given = {name: new.reshape(old.shape).astype(old.dtype) for (name, old), new in parts}
        batch = np.asarray(observation, dtype=self.dtype).reshape(self.shape)
        action, after = self.evaluate(batch, given)
        return np.asarray(action, dtype=float).reshape(-1), _flat(after[name] for name in given)

    def check(
        self, who: str, num_inputs: int, num_outputs: int, terms: str, num_samples: int = 1
    ) -> None:
        """Checks widths and actions of the network, and that it remembers only its memory.

        An observation of several samples may be an array (1, num_samples, n) for it.
        """
        width, num_acting = self.widths
        if width not in (None, num_inputs):
            what = f"the network expects an observation of {width} entries; the terms have"
            hint = "'joints' of a term name joints that it does not move"
            raise ValueError(f"{who}: {what} {num_inputs}: {terms}. {hint}")
        probe = np.linspace(-1.0, 1.0, num_inputs, dtype=np.float32)
        try:
            _, after = self.evaluate(probe.astype(self.dtype).reshape(self.shape), self.start)
            # A constant part is not memory, and a growing part does not fit into a Context.
            self.start = {
                name: part
                for name, part in self.start.items()
                if part.shape == after[name].shape and part.tobytes() != after[name].tobytes()
            }
            action, later = self(probe, self.initial_memory)
            self(probe, later)
            again, _ = self(probe, self.initial_memory)
        except Exception as error:  # Errors of onnxruntime have no common base but this.
            if self.shape == (1, -1) and num_samples > 1:
                self.shape = (1, num_samples, -1)
                return self.check(who, num_inputs, num_outputs, terms, num_samples)
            what = f"the network takes no observation of {num_inputs} entries ({terms})"
            raise ValueError(f"{who}: {what}: {_reason(error)}") from error
        if action.shape != (num_outputs,) or num_acting not in (None, num_outputs):
            what = f"expected {num_outputs}; its outputs are {self.outputs}, the first the action"
            raise ValueError(f"{who}: the network returns {action.size} actions, {what}")
        if not np.isfinite(action).all():
            count = f"{np.sum(~np.isfinite(action))} of {num_outputs} actions"
            raise ValueError(f"{who}: the network returns {count} that are not finite")
        if action.tobytes() != again.tobytes():
            what = "the network answers the same observation differently after another"
            why = "it draws random numbers, or has a memory that is not read"
            raise ValueError(f"{who}: {what}: {why}; {_SUPPORTED}")


def _reason(error: Exception) -> str:
    """The line of an error that says why; TorchScript puts tracebacks before it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    reasons = [line for line in lines if re.match(r"[\w.]*(Error|Exception): ", line)]
    return (reasons or [" ".join(lines)])[-1][:200]


def _flat(parts: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *map(np.ravel, parts)])


def load_network(path: Path) -> PolicyNetwork:
    """Loads a network from an ONNX (``.onnx``) or TorchScript (``.pt``, ``.jit``) file."""
    if path.suffix not in _KINDS:
        known = f"one of {list(_KINDS)}; got '{path.suffix}'"
        raise ValueError(f"{path}: a policy's network is {known}{_described(path)}")
    if not path.is_file():
        raise ValueError(f"{path}: the policy's network does not exist")
    return _load_onnx(path) if path.suffix == ".onnx" else _load_torchscript(path)


def network_kinds(paths: Iterable[Path]) -> list[str]:
    """Texts on which of some files are networks, and which of these are code."""
    networks = dict.fromkeys(path for path in paths if path.suffix in _KINDS)
    return [f"the policy's network {path} is {_KINDS[path.suffix]}" for path in networks]


def network_files(path: Path) -> list[Path]:
    """Returns a network's file, and the files of weights of an ONNX network (external data)."""
    # Without the key of external data in it, nothing needs to be parsed.
    if path.suffix != ".onnx" or not path.is_file() or b"location" not in path.read_bytes():
        return [path]
    require_extra("walking", f"ONNX network {path} with weights in other files", "onnx")
    import onnx

    with _reading(path, "an ONNX network"):
        model = onnx.load(str(path), load_external_data=False)
        weights = [*onnx.external_data_helper._get_all_tensors(model)]
    entries = (entry for weight in weights for entry in weight.external_data)
    names = sorted({entry.value for entry in entries if entry.key == "location"})
    files = {name: path.parent / name for name in names}
    lost = [n for n, file in files.items() if {"/", ".."} & {*Path(n).parts} or not file.is_file()]
    if lost:
        what = f"its weights are in {names}, as paths from its folder"
        raise ValueError(f"{path}: {what}; there is no {', '.join(lost)}")
    return [path, *files.values()]


@contextmanager
def _reading(path: Path, what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # Those of onnxruntime and protobuf have no common base but this.
        text = _described(path) or f": {_reason(error)}"
        raise ValueError(f"{path}: not {what}{text}") from error


def _described(path: Path) -> str:
    """Text on a file that is a pickle, such as a training checkpoint; nothing of it is run."""
    head = b""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(1)
    with suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        names = {Path(name).name for name in archive.namelist()}
        if "data.pkl" in names and "constants.pkl" not in names:  # With both it is TorchScript.
            head = b"\x80"
    text = ", but a pickle, such as a training checkpoint: export the policy as TorchScript or ONNX"
    return text if head == b"\x80" else ""


def _load_onnx(path: Path) -> PolicyNetwork:
    require_extra("walking", f"ONNX network {path}", "onnxruntime")
    import onnxruntime

    network_files(path)  # Raises for missing files.
    options = onnxruntime.SessionOptions()
    # A thread pool costs more than the network, and would make sums depend on its size.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    with _reading(path, "an ONNX network"):
        providers = ["CPUExecutionProvider"]
        session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shapes = {value.name: _shape(value) for value in outputs}
    # Such as h_out after h_in, or hn after h0.
    names = {value.name: re.sub("0$", "n", value.name.replace("_in", "_out")) for value in inputs}
    after = {v.name: names[v.name] for v in inputs if shapes.get(names[v.name]) == _shape(v)}
    memory = [value for value in inputs if value.name in after]
    observed = [value for value in inputs if value.name not in after]
    acting = [value for value in outputs if value.name not in after.values()]
    if len(observed) != 1 or not acting:
        got = [[f"{value.name} {value.shape}" for value in values] for values in (inputs, outputs)]
        raise ValueError(f"{path}: got inputs {got[0]} and outputs {got[1]}; {_SUPPORTED}")
    dtypes = {"tensor(double)": np.float64, "tensor(float16)": np.float16}
    start = {v.name: np.zeros(_shape(v), dtypes.get(v.type, np.float32)) for v in memory}
    name, sizes, shape = observed[0].name, observed[0].shape, _shape(observed[0])
    free = [i for i, size in enumerate(sizes) if i and not isinstance(size, int)]
    # A size between that varies is a history's; of a network with a memory it is one step of time.
    if free and (not memory or free[-1] == len(shape) - 1):
        shape[free[-1]] = -1
    num_acting = (acting[0].shape or [None])[-1]
    width = None if -1 in shape else math.prod(shape)

    def evaluate(batch: np.ndarray, parts: _Memory) -> tuple[np.ndarray, _Memory]:
        given = {**start, **parts, name: batch}
        action, *new = session.run([acting[0].name, *after.values()], given)
        return action, dict(zip(start, new, strict=True))

    return PolicyNetwork(
        path,
        evaluate,
        (width, num_acting if isinstance(num_acting, int) else None),
        read_metadata(session.get_modelmeta().custom_metadata_map),
        start,
        tuple(shape),
        dtypes.get(observed[0].type, np.float32),
        [f"{value.name} {value.shape}" for value in acting],
    )


def _shape(value: Any) -> list[int]:
    """A shape for one robot: a size that varies is that of the batch."""
    return [size if isinstance(size, int) else 1 for size in value.shape]


def _load_torchscript(path: Path) -> PolicyNetwork:
    require_extra("train", f"TorchScript network {path}", "torch")
    import torch

    with _reading(path, "a TorchScript network"), warnings.catch_warnings():
        # Torch deprecates the format, in which policies are nevertheless published.
        warnings.simplefilter("ignore", DeprecationWarning)
        module = torch.jit.load(str(path), map_location="cpu").eval()
    arguments = [argument.name for argument in module.forward.schema.arguments[1:]]
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
                returned = module(torch.from_numpy(batch))
                tensors = returned if isinstance(returned, (tuple, list)) else [returned]
                outputs[:] = [f"{[*tensor.shape]}" for tensor in tensors]
                action = tensors[0].numpy()
                buffers = dict(module.named_buffers())  # The script may have replaced them.
                return action, {name: buffers[name].numpy().copy() for name in parts}
        finally:
            torch.set_num_threads(threads)

    start = {name: buffer.numpy().copy() for name, buffer in module.named_buffers()}
    outputs: list[str] = []
    kinds = [str(parameter.dtype).removeprefix("torch.") for parameter in module.parameters()]
    return PolicyNetwork(
        path,
        evaluate,
        (None, None),
        start=start,
        dtype=np.dtype(next((kind for kind in kinds if kind.startswith("float")), "float32")),
        outputs=outputs,
    )
