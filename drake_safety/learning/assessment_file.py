"""Reading and writing assessments as safetensors files."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.learning.adaptation import Adaptation
from drake_safety.learning.assessment_parameters import (
    AdaptationParameters,
    AssessmentParameters,
    PaperReading,
)
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.grid import Grid
from drake_safety.learning.innovation import Innovation
from drake_safety.learning.inputs import num_inputs, plan_columns, used_states
from drake_safety.learning.novelty import NUM_DISTANCES, Moments, Novelty
from drake_safety.learning.prediction import BaseLogit, Correction
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.learning.trained_maps import Embedding

SCHEMA = "drake_safety.assessment"
SCHEMA_VERSION = 8

_MAPS, _CORRECTION = "embedding.", "correction."
_INNOVATION = "innovation."
_NOVELTY, _FEEDBACK_NOVELTY = "novelty.", "feedback_novelty."
_TRAINING: dict[str, tuple[type, type]] = {
    "training_points": (np.float32, np.float32),
    "training_score": (np.float32, float),
    "training_cause": (np.int16, np.int64),
    "training_heads": (np.float32, float),
    "training_nearest": (np.int16, np.int64),
    "training_target": (np.float32, np.float32),
}
"""Arrays of the training segments: the type on disk and in memory."""
_OPTIONAL = ("training_heads", "training_nearest", "training_target")


def write(path: Path, parameters: AssessmentParameters, learned: Mapping[str, Any]) -> None:
    """Writes one safetensors file atomically.

    Args:
        path: The file.
        parameters: The assessment's parameters.
        learned: The assessment's learned attributes by name.
    """
    from safetensors.numpy import save

    embedding, correction = learned["embedding_"], learned["correction_"]
    tensors = {f"{_MAPS}{name}": w for name, w in embedding.weights.items()}
    tensors |= {f"{_CORRECTION}{name}": value for name, value in asdict(correction).items()}
    tensors["correction.guard"] = correction.guard.astype(np.uint8)
    tensors["beliefs"] = learned["beliefs_"]
    novelty = learned["novelty_"]
    moments = {_NOVELTY: novelty.training, _FEEDBACK_NOVELTY: novelty.feedback}
    for prefix, one in moments.items():
        if one is not None:
            tensors[f"{prefix}mean"], tensors[f"{prefix}covariance"] = one.mean, one.covariance
    # The network in single precision, all else as it is.
    for name, value in learned["innovation_"].arrays().items():
        is_layer = name.startswith("layer.")
        tensors[f"{_INNOVATION}{name}"] = value.astype(np.float32) if is_layer else value
    for name, (stored, _) in _TRAINING.items():
        if learned[f"{name}_"] is not None:
            tensors[name] = learned[f"{name}_"].astype(stored)
    adaptation, base_logit = learned["adaptation_"], learned["base_logit_"]
    numbers = {
        "num_margins": embedding.num_margins,
        "novelty_limits": novelty.limits.tolist(),
        "novelty_counts": [0 if one is None else one.count for one in moments.values()],
        "base_logit": None if base_logit is None else asdict(base_logit),
        "calibrations": [one.to_json() for one in learned["calibrations_"].values()],
        "used": [asdict(one) for one in learned["used_"]],
    }
    metadata = {
        "schema": SCHEMA,
        "schema_version": str(SCHEMA_VERSION),
        "parameters": json.dumps(asdict(parameters)),
        "info": json.dumps(asdict(learned["info_"])),
        "adaptation": json.dumps(None if adaptation is None else asdict(adaptation)),
        "numbers": json.dumps(numbers),
    }
    content = save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read(path: Path) -> tuple[AssessmentParameters, dict[str, Any]]:
    """Reads a file written by `write`.

    Returns:
        The parameters, and the learned attributes by name.

    Raises:
        ValueError: The file is truncated, not an assessment, of another schema version, or
            incomplete.
    """
    metadata, tensors = _open(path)
    if metadata.get("schema") != SCHEMA:
        raise ValueError(
            f"'{path}' is not a safety assessment: its schema is '{metadata.get('schema')}', "
            f"expected '{SCHEMA}'"
        )
    if metadata.get("schema_version") != str(SCHEMA_VERSION):
        raise ValueError(
            f"'{path}' has the schema version {metadata.get('schema_version')}, this version "
            f"reads {SCHEMA_VERSION}: train the assessment again (episodes are kept: `--resume`)"
        )
    try:
        entries = {
            name: json.loads(metadata[name])
            for name in ("parameters", "info", "adaptation", "numbers")
        }
        adaptation = AdaptationParameters(**entries["parameters"].pop("adaptation"))
        paper = PaperReading(**entries["parameters"].pop("paper"))
        parameters = AssessmentParameters(
            **entries["parameters"], paper=paper, adaptation=adaptation
        )
        return parameters, _learned(parameters, entries, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"'{path}' is a damaged safety assessment: {error}") from error


def _learned(
    parameters: AssessmentParameters, entries: dict[str, Any], tensors: dict[str, np.ndarray]
) -> dict[str, Any]:
    info, numbers = EpisodesInfo(**entries["info"]), entries["numbers"]
    grid = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
    weights = {k.removeprefix(_MAPS): v for k, v in tensors.items() if k.startswith(_MAPS)}
    embedding = Embedding(weights, num_margins=numbers["num_margins"])
    expected_inputs = num_inputs(info, parameters)
    if embedding.num_inputs != expected_inputs:
        raise ValueError(
            f"its maps have {embedding.num_inputs} inputs, expected {expected_inputs} by its names"
        )
    base_logit = numbers["base_logit"]
    if base_logit is not None:
        low, high = base_logit["margin_range"]
        base_logit = BaseLogit(**base_logit | {"margin_range": (low, high)})
    correction = {field.name: tensors[f"{_CORRECTION}{field.name}"] for field in fields(Correction)}
    correction["guard"] = correction["guard"].astype(float)
    calibrations = [Calibration(**one) for one in numbers["calibrations"]]
    adaptation = entries["adaptation"]
    learned: dict[str, Any] = {
        "info_": info,
        "grid_": grid,
        "embedding_": embedding,
        "base_logit_": base_logit,
        "beliefs_": tensors["beliefs"],
        "correction_": Correction(**correction),
        "novelty_": _novelty(numbers, tensors, expected_inputs, plan_columns(info, parameters)),
        "innovation_": Innovation.from_arrays(
            {
                k.removeprefix(_INNOVATION): v.astype(float)
                for k, v in tensors.items()
                if k.startswith(_INNOVATION)
            },
            num_inputs=expected_inputs,
            num_states=int(used_states(info, parameters).sum()),
        ),
        "calibrations_": {one.kind: one for one in calibrations},
        "used_": _used(info, calibrations, numbers.get("used")),
        "adaptation_": None if adaptation is None else Adaptation(**adaptation),
    }
    for name, (_, used) in _TRAINING.items():
        is_absent = name in _OPTIONAL and name not in tensors
        learned[f"{name}_"] = None if is_absent else tensors[name].astype(used)
    if base_logit is not None and learned["training_heads_"] is None:
        raise KeyError("training_heads")
    cells = (embedding.num_members, grid.num_cells)
    expected = {
        "beliefs": (*cells, 3 + len(info.constraint_names)),
        "correction.change": (3,),
        "correction.hidden": (embedding.num_members, embedding.num_activations + 1),
        "correction.hidden_range": (2,),
        "correction.guard": cells,
    }
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise ValueError(f"the shape of its {name} is {tensors[name].shape}, expected {shape}")
    return learned


def _novelty(
    numbers: dict[str, Any], tensors: dict[str, np.ndarray], num_columns: int, plan: slice
) -> Novelty:
    found: list[Moments | None] = []
    for prefix, count in zip((_NOVELTY, _FEEDBACK_NOVELTY), numbers["novelty_counts"], strict=True):
        if not count and prefix == _FEEDBACK_NOVELTY:
            found.append(None)
            continue
        for name, shape in {"mean": (num_columns,), "covariance": (num_columns,) * 2}.items():
            tensor = tensors[prefix + name]
            if tensor.shape != shape or not np.isfinite(tensor).all():
                raise ValueError(
                    f"the shape of its {prefix}{name} is {tensor.shape}, expected {shape} of "
                    "finite numbers"
                )
        found.append(
            Moments(
                count=int(count),
                mean=tensors[f"{prefix}mean"],
                covariance=tensors[f"{prefix}covariance"],
            )
        )
    training, feedback = found
    limits = np.array(numbers["novelty_limits"], dtype=float)
    if training is None or limits.shape != (NUM_DISTANCES,) or not np.all(limits > 0.0):
        raise ValueError(
            f"its limits of novelty are {limits}, expected {NUM_DISTANCES} positive numbers"
        )
    return Novelty(training=training, feedback=feedback, limits=limits, plan=plan)


def _used(
    info: EpisodesInfo, calibrations: list[Calibration], stored: list[dict[str, Any]] | None
) -> list[UsedEpisodes]:
    """The used episodes; inferred from other entries in files that do not store them."""
    if stored is not None:
        return [UsedEpisodes(**one) for one in stored]
    used = [UsedEpisodes.of("training", info, None)]
    for one in calibrations[:1]:
        seen = replace(info, seed=one.seed, scenario_hash=one.scenario_hash)
        used.append(UsedEpisodes.of("calibration", seen, one.num_unsafe + one.num_safe))
    return used


def single(values: np.ndarray) -> np.ndarray:
    """Rounds values to single precision, in which files store one number for every segment."""
    return values.astype(np.float32).astype(float)


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
