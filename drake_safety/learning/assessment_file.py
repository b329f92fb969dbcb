"""Reading and writing assessments as safetensors files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from drake_safety.files.atomic import replacing
from drake_safety.learning.adaptation import Adaptation, TrainingScores
from drake_safety.learning.assessment_parameters import (
    AdaptationParameters,
    AssessmentParameters,
    PaperReading,
)
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import plan_columns
from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.prediction import BaseLogit, Correction
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.learning.trained_maps import Embedding

SCHEMA = "drake_safety.assessment"
SCHEMA_VERSION = 10

_MAPS, _CORRECTION = "embedding.", "correction."
_INPUT_RANGE = "input_range"
_DETECTOR = "detector."
_NOVELTY, _FEEDBACK_NOVELTY = "novelty.", "feedback_novelty."
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
_OPTIONAL = ("heads", "nearest", "multiplicity", "count")
_T = TypeVar("_T")


def write(path: Path, parameters: AssessmentParameters, learned: Mapping[str, Any]) -> None:
    """Writes one safetensors file atomically.

    Its metadata is one JSON text with the SHA-256 of all else. The same assessment gives the same
    bytes.
    """
    from safetensors.numpy import save

    embedding, correction = learned["embedding_"], learned["correction_"]
    tensors = {f"{_MAPS}{name}": w for name, w in embedding.weights.items()}
    tensors |= {f"{_CORRECTION}{name}": value for name, value in asdict(correction).items()}
    if np.isfinite(embedding.input_range).all():
        tensors[_INPUT_RANGE] = embedding.input_range
    tensors["correction.guard"] = correction.guard.astype(np.uint8)
    tensors["beliefs"] = learned["beliefs_"]
    novelty = learned["novelty_"]
    moments = {_NOVELTY: novelty.training, _FEEDBACK_NOVELTY: novelty.feedback}
    for prefix, one in moments.items():
        if one is not None:
            tensors[f"{prefix}mean"], tensors[f"{prefix}covariance"] = one.mean, one.covariance
    tensors |= {f"{_DETECTOR}{k}": v for k, v in learned["detector_"].arrays().items()}
    for name, (stored, _) in _TRAINING.items():
        if (values := getattr(learned["training_"], name)) is not None:
            tensors[f"training_{name}"] = values.astype(stored)
    adaptation, base_logit = learned["adaptation_"], learned["base_logit_"]
    numbers = {
        "num_margins": embedding.num_margins,
        "novelty_limits": novelty.limits.tolist(),
        "novelty_counts": [0 if one is None else one.count for one in moments.values()],
        "base_logit": None if base_logit is None else asdict(base_logit),
        "calibrations": [one.to_json() for one in learned["calibrations_"].values()],
        "used": [asdict(one) for one in learned["used_"]],
    }
    entries = {
        "schema_version": SCHEMA_VERSION,
        "parameters": asdict(parameters),
        "info": asdict(learned["info_"]),
        "adaptation": None if adaptation is None else asdict(adaptation),
        "numbers": numbers,
    }
    arrays = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    # safetensors stores several entries of metadata in any order.
    text = _to_json(entries | {"sha256": _digest(entries, arrays)})
    content = save(arrays, {SCHEMA: text})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read(path: Path) -> tuple[AssessmentParameters, dict[str, Any]]:
    """Reads parameters and learned attributes; ValueError if the file is damaged or foreign."""
    metadata, tensors = _open(path)
    # Before version 9 schema and version were entries of their own.
    version = metadata.get("schema_version", "none")
    if SCHEMA not in metadata and metadata.get("schema") != SCHEMA:
        raise ValueError(
            f"'{path}' is not a safety assessment: its metadata has the entries "
            f"{sorted(metadata)}, expected '{SCHEMA}'"
        )
    try:
        if SCHEMA in metadata:
            entries = json.loads(metadata[SCHEMA])
            version = str(entries["schema_version"])
        if version == str(SCHEMA_VERSION):
            return _checked(entries, tensors)
    except KeyError as error:
        raise ValueError(f"'{path}' is a damaged safety assessment: it has no {error}") from error
    except (AttributeError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"'{path}' is a damaged safety assessment: {error}") from error
    raise ValueError(
        f"'{path}' has the schema version {version}, this version reads {SCHEMA_VERSION}: train "
        "the assessment again (episodes are kept: `--resume`)"
    )


def _checked(
    entries: dict[str, Any], tensors: dict[str, np.ndarray]
) -> tuple[AssessmentParameters, dict[str, Any]]:
    stored = entries.pop("sha256")
    if stored != _digest(entries, tensors):
        raise ValueError("its contents do not have the SHA-256 that it was written with")
    nested = {"paper": PaperReading, "adaptation": AdaptationParameters}
    # Files from before this parameter are of exact neighbours.
    own = {"candidates_per_neighbour": 0} | entries["parameters"]
    own |= {name: _made(made, own[name]) for name, made in nested.items()}
    parameters = _made(AssessmentParameters, own)
    return parameters, _learned(parameters, entries, tensors)


def _to_json(entries: Mapping[str, Any]) -> str:
    return json.dumps(entries, sort_keys=True)


def _digest(entries: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the entries and of the names, types, shapes and bytes of the tensors."""
    digest = hashlib.sha256(_to_json(entries).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype.str} {tensor.shape}".encode())
        digest.update(np.ascontiguousarray(tensor).tobytes())
    return digest.hexdigest()


def _made(made: type[_T], entries: Mapping[str, Any]) -> _T:
    """Makes a dataclass of JSON values, without those of fields that it does not have any more."""
    hints = get_type_hints(made)
    return made(**{name: value for name, value in entries.items() if name in hints})


def _learned(
    parameters: AssessmentParameters, entries: dict[str, Any], tensors: dict[str, np.ndarray]
) -> dict[str, Any]:
    info, numbers = _made(EpisodesInfo, entries["info"]), entries["numbers"]
    grid = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
    weights = {k.removeprefix(_MAPS): v for k, v in tensors.items() if k.startswith(_MAPS)}
    # Files from before the range was stored have none: their maps extrapolate.
    embedding = Embedding(
        weights, num_margins=numbers["num_margins"], input_range=tensors.get(_INPUT_RANGE)
    )
    base_logit = numbers["base_logit"]
    if base_logit is not None:
        low, high = base_logit["margin_range"]
        base_logit = base_logit | {"margin_range": (low, high)}
        base_logit = _made(BaseLogit, base_logit)
    correction = {field.name: tensors[f"{_CORRECTION}{field.name}"] for field in fields(Correction)}
    correction["guard"] = correction["guard"].astype(float)
    calibrations = [_made(Calibration, one) for one in numbers["calibrations"]]
    adaptation = entries["adaptation"]
    learned: dict[str, Any] = {
        "info_": info,
        "grid_": grid,
        "embedding_": embedding,
        "base_logit_": base_logit,
        "beliefs_": tensors["beliefs"],
        "correction_": Correction(**correction),
        "novelty_": _novelty(numbers, tensors, plan_columns(info, parameters)),
        "detector_": ChangeDetector.from_arrays(
            {k.removeprefix(_DETECTOR): v for k, v in tensors.items() if k.startswith(_DETECTOR)}
        ),
        "calibrations_": {one.kind: one for one in calibrations},
        "used_": [_made(UsedEpisodes, one) for one in numbers["used"]],
        "adaptation_": None if adaptation is None else _made(Adaptation, adaptation),
    }
    stored: dict[str, Any] = {
        name: tensors[f"training_{name}"].astype(used)
        for name, (_, used) in _TRAINING.items()
        if name not in _OPTIONAL or f"training_{name}" in tensors
    }
    learned["training_"] = TrainingScores(**stored)
    return learned


def _novelty(numbers: dict[str, Any], tensors: dict[str, np.ndarray], plan: slice) -> Novelty:
    training, feedback = (
        Moments(
            count=int(count),
            mean=tensors[f"{prefix}mean"],
            covariance=tensors[f"{prefix}covariance"],
        )
        if count
        else None
        for prefix, count in zip(
            (_NOVELTY, _FEEDBACK_NOVELTY), numbers["novelty_counts"], strict=True
        )
    )
    if training is None:
        raise ValueError("it has no moments of the training inputs")
    limits = np.array(numbers["novelty_limits"], dtype=float)
    return Novelty(training=training, feedback=feedback, limits=limits, plan=plan)


def file_hash(path: Path) -> str:
    """Returns the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _open(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(f"there is no safety assessment at '{path}'")
    try:
        with safe_open(path, framework="numpy") as file:
            opened: Any = file
            metadata = dict(opened.metadata() or {})
            return metadata, {name: opened.get_tensor(name) for name in opened.keys()}
    except SafetensorError as error:
        raise ValueError(f"'{path}' is not a safety assessment or truncated: {error}") from error
