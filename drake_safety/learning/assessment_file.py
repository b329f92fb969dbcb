"""Reading and writing assessments as safetensors files."""

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from drake_safety.files.atomic import write_file
from drake_safety.files.schema import load_typed
from drake_safety.learning.adaptation import Adaptation
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.prediction import LEARNED, BaseLogit, Correction, Model
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.learning.trained_maps import Embedding
from drake_safety.learning.training_scores import TrainingScores
from drake_safety.learning.trees import Trees

SCHEMA = "drake_safety.assessment"
SCHEMA_VERSION = 12

_TRAINING: dict[str, tuple[type, type]] = {
    "points": (np.float32, np.float32),
    "score": (np.float32, float),
    "cause": (np.int16, np.int64),
    "heads": (np.float32, float),
    "nearest": (np.int16, np.int64),
    "multiplicity": (np.float32, float),
    "count": (np.int32, np.int64),
}
"""Arrays of `TrainingScores`: the type on disk and in memory."""
_MADE_OF_JSON: dict[str, type] = {
    "base_logit": BaseLogit,
    "fall_logit": FallLogit,
    "adaptation": Adaptation,
    "calibrations": Calibration,
    "used": UsedEpisodes,
}
_T = TypeVar("_T")
_ROUNDING = 1e-6  # Rounding of a sum of masses.
_SIZES = dict(
    entry.split(":")
    for entry in """beliefs:krb input_range:2x correction.change:g correction.guard:kr
    correction.hidden_range:2 embedding.trunk.0.weight:kxA embedding.trunk.1.weight:kAB
    embedding.trunk.2.weight:kBC embedding.trunk.3.weight:kCD embedding.output.weight:k*m
    embedding.safety.0.weight:k2S embedding.safety.1.weight:kS1
    training_points:kn2 training_score:n training_cause:n training_nearest:n training_heads:nh
    training_multiplicity:n training_count:kr novelty.mean:x novelty.least:x novelty.largest:x
    novelty.covariance:xx feedback_novelty.mean:x feedback_novelty.least:x
    feedback_novelty.largest:x feedback_novelty.covariance:xx trees.feature:ot trees.threshold:ot
    trees.left:ot trees.value:tl detector.columns:u detector.watched:w detector.limits:6w
    detector.deviation:w detector.predictor.mean:u detector.predictor.low:u
    detector.predictor.high:u detector.predictor.scale:u detector.predictor.unit:w
    detector.predictor.hidden.0.weight:vE detector.predictor.hidden.1.weight:EF
    detector.predictor.output.weight:Fw detector.predictor.linear.weight:vw""".split()
)
"""Sizes of arrays by letter; an asterisk stands for any."""
_INDICES = {"training_cause": "c", "training_nearest": "c", "trees.feature": "x"}
_INDICES |= {"detector.columns": "y", "detector.watched": "s"}
"""Arrays of indices, and the sizes below which they are."""
_SHARES = ("beliefs", "training_score", "correction.guard")
_POSITIVE = re.compile("limits|deviation|scale|unit|multiplicity")
_MAYBE_INFINITE = ("trees.threshold", "detector.settings")
_FORGED = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError


def write(path: Path, parameters: AssessmentParameters, learned: Mapping[str, Any]) -> None:
    """Writes one safetensors file atomically.

    Its metadata is one JSON text with the SHA-256 of all else. The same assessment gives the same
    bytes.
    """
    from safetensors.numpy import save

    embedding, correction = learned["embedding_"], learned["correction_"]
    novelty, training = learned["novelty_"], learned["training_"]
    groups = {
        "": {"beliefs": learned["beliefs_"]},
        "embedding.": embedding.weights,
        "correction.": asdict(correction) | {"guard": correction.guard.astype(np.uint8)},
        "detector.": learned["detector_"].arrays(),
        "training_": {
            name: values.astype(stored)
            for name, (stored, _) in _TRAINING.items()
            if (values := getattr(training, name)) is not None
        },
        "trees.": learned["trees_"].arrays if learned["trees_"] else {},
    }
    if np.isfinite(embedding.input_range).all():
        groups[""]["input_range"] = embedding.input_range
    counts = []
    for prefix, moments in ("", novelty.training), ("feedback_", novelty.feedback):
        known = {"count": 0} if moments is None else dict(vars(moments))
        counts.append(known.pop("count"))
        groups[f"{prefix}novelty."] = known
    json_values = {name: _to_json(learned[f"{name}_"]) for name in _MADE_OF_JSON}
    entries = {
        "schema_version": SCHEMA_VERSION,
        "parameters": asdict(parameters),
        "info": asdict(learned["info_"]),
        "adaptation": json_values.pop("adaptation"),
        "numbers": {
            "novelty_limits": novelty.limits.tolist(),
            "novelty_counts": counts,
            **json_values,
        },
    }
    arrays = {
        f"{prefix}{name}": np.ascontiguousarray(value)
        for prefix, group in groups.items()
        for name, value in group.items()
    }
    # safetensors stores several entries of metadata in any order.
    text = json.dumps(entries | {"sha256": digest(entries, arrays)}, sort_keys=True)
    write_file(path, save(arrays, {SCHEMA: text}))


def _to_json(value: Any) -> Any:
    if isinstance(value, list | dict):
        return [asdict(item) for item in (value.values() if isinstance(value, dict) else value)]
    return None if value is None else asdict(value)


def read(path: Path) -> tuple[AssessmentParameters, dict[str, Any]]:
    """Reads parameters and learned attributes; ValueError if the file is damaged or foreign."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(f"no safety assessment at '{path}'")
    try:
        with safe_open(path, framework="numpy") as file:
            opened: Any = file
            metadata = dict(opened.metadata() or {})
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}
    except SafetensorError as error:
        raise ValueError(f"'{path}' is not a safety assessment or truncated: {error}") from error
    if SCHEMA not in metadata:
        raise ValueError(
            f"'{path}' is not a safety assessment of this version: its metadata has the entries "
            f"{sorted(metadata)}, expected '{SCHEMA}'"
        )
    try:
        entries = json.loads(metadata[SCHEMA])
        version = entries["schema_version"]
        if version == SCHEMA_VERSION:
            return _learned(entries, tensors)
    except _FORGED as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"'{path}' is a damaged safety assessment: {what}") from error
    raise ValueError(
        f"'{path}' has the schema version {version}, this version reads {SCHEMA_VERSION}: train "
        "the assessment again (episodes are kept: `--resume`)"
    )


def digest(entries: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the entries and of the names, types, shapes and bytes of the tensors."""
    sha256 = hashlib.sha256(json.dumps(entries, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        sha256.update(f"{name} {tensor.dtype.str} {tensor.shape}".encode())
        sha256.update(np.ascontiguousarray(tensor).tobytes())
    return sha256.hexdigest()


def _made(made: type[_T], entries: Mapping[str, Any]) -> _T:
    """Makes a dataclass of JSON values."""
    return load_typed(made, _known(made, entries), made.__name__)


def _known(made: Any, value: Any) -> Any:
    """The value without entries of fields that a dataclass does not have any more."""
    if not is_dataclass(made):
        return value
    hints = get_type_hints(made)
    return {name: _known(hints[name], value[name]) for name in value if name in hints}


def _check_arrays(arrays: Mapping[str, np.ndarray], sizes: dict[str, int]) -> None:
    """Raises ValueError if an array does not fit the sizes by letter, or has impossible values."""
    for name, values in sorted(arrays.items()):
        kind = name.replace(".nominal.", ".")  # An adapted detector's.
        letters = _SIZES.get(kind, "*" * values.ndim)
        fits = len(letters) == values.ndim and all(
            letter == "*" or sizes.setdefault(letter, size) == size
            for letter, size in zip(letters, values.shape, strict=True)
        )
        if name.endswith(".bias"):  # Else it may be broadcast.
            of_weight = arrays[f"{name.removesuffix('bias')}weight"].shape
            fits &= values.shape == of_weight[:-2] + of_weight[-1:]
        most = math.inf if kind in _MAYBE_INFINITE else float(np.finfo(float).max)
        least = float(np.finfo(float).tiny) if _POSITIVE.search(name) else -most
        if name in _SHARES:
            least, most = 0.0, 1.0 + _ROUNDING
        elif name in _INDICES:
            least, most = -1.0 * (name == "training_cause"), sizes[_INDICES[name]] - 1.0
        numbers = values.astype(float)
        if not fits or not ((numbers >= least) & (numbers <= most)).all():
            raise ValueError(
                f"'{name}' has the shape {values.shape}, or values outside [{least:g}, {most:g}], "
                "that do not fit the rest"
            )
    masses, variances = arrays["beliefs"], np.diag(arrays["novelty.covariance"])
    sums = masses[..., :3].sum(axis=-1) - 1.0, masses[..., 3:].sum(axis=-1) - masses[..., 1]
    if np.abs(sums).max() > _ROUNDING or variances.min() < 0.0:
        raise ValueError("'beliefs' do not sum to 1, or variances of 'novelty' are negative")
    alarm_level, _, step_s, *_ = arrays["detector.settings"]
    if not (alarm_level > 0.0 < step_s < math.inf):
        raise ValueError(f"'detector.settings' have the alarm level {alarm_level}, step {step_s} s")


def _learned(
    entries: dict[str, Any], tensors: dict[str, np.ndarray]
) -> tuple[AssessmentParameters, dict[str, Any]]:
    stored = entries.pop("sha256")
    if stored != digest(entries, tensors):
        raise ValueError("its contents do not have the SHA-256 that it was written with")
    parameters = _made(AssessmentParameters, entries["parameters"])
    info = _made(EpisodesInfo, entries["info"])
    numbers, columns = entries["numbers"], InputColumns(info, parameters)

    def group(prefix: str) -> dict[str, Any]:
        return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}

    trees, widths, num_causes = group("trees."), info.widths, len(info.constraint_names)
    has_heads = "embedding.safety.0.weight" in tensors
    sizes = {
        **{"1": 1, "2": 2, "6": 6, "r": parameters.resolution**2, "b": 3 + num_causes},
        **{"c": num_causes, "s": widths["state"], "x": len(columns.names)},
        **{"g": 4 if trees else 3, "h": 3 if trees else 2, "m": 2 + num_causes * has_heads},
        **{"l": 1 + len(trees.get("left", ())), "v": 2 * len(tensors["detector.columns"])},
        "y": sum(widths[name] for name in ("state", "desired_preview", "features")),
    }
    _check_arrays(tensors, sizes)
    correction = Correction(**group("correction."))
    correction.guard = correction.guard.astype(float)
    counts, limits = numbers["novelty_counts"], np.array(numbers["novelty_limits"], dtype=float)
    if not (min(counts) >= 0 < counts[0] and (limits > 0.0).all() and len(limits) == 4):
        raise ValueError(f"its novelty has the counts {counts} and limits {limits.tolist()}")
    feedback = Moments(count=counts[1], **group("feedback_novelty.")) if counts[1] else None
    training = {k: v.astype(_TRAINING[k][1]) for k, v in group("training_").items()}
    nominal = Moments(count=counts[0], **group("novelty."))
    learned: dict[str, Any] = {
        "info_": info,
        "grid_": Grid.of(parameters),
        "columns_": columns,
        "embedding_": Embedding(group("embedding."), tensors.get("input_range")),
        "trees_": Trees(**trees) if trees else None,
        "beliefs_": tensors["beliefs"],
        "correction_": correction,
        "training_": TrainingScores(**training),
        "novelty_": Novelty(training=nominal, feedback=feedback, limits=limits, plan=columns.plan),
        "detector_": ChangeDetector.from_arrays(group("detector.")),
    }
    for name, made in _MADE_OF_JSON.items():
        # Files from before the probability of a fall have none.
        value = (numbers | entries).get(name)
        items = value if isinstance(value, list) else [] if value is None else [value]
        objects: list[Any] = [_made(made, item) for item in items]
        learned[f"{name}_"] = objects if isinstance(value, list) else next(iter(objects), None)
    learned["calibrations_"] = {c.key: c for c in learned["calibrations_"]}
    # Layers that do not fit together raise an error.
    of_model = {name: learned[f"{name}_"] for name in LEARNED}
    model = Model(**of_model, initial_uncertainty=parameters.initial_uncertainty)
    with np.errstate(all="ignore"):
        model.predict(model.novelty.training.mean[None])
        learned["detector_"].predictor.errors(*(np.zeros((3, sizes[size])) for size in "uw"))
    return parameters, learned


def file_hash(path: Path) -> str:
    """Returns the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
