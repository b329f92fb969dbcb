"""Assessments on disk: one safetensors file each, whole or absent."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.learning.adaptation import Adaptation
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import num_inputs
from drake_safety.learning.prediction import BaseLogit, Correction
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.learning.trained_maps import Embedding

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment

SCHEMA = "drake_safety.assessment"
SCHEMA_VERSION = 4


def write(
    path: Path,
    *,
    parameters: AssessmentParameters,
    info: EpisodesInfo,
    adaptation: Adaptation | None,
    numbers: Mapping[str, Any],
    tensors: Mapping[str, np.ndarray],
) -> None:
    """Writes one safetensors file, first under a temporary name.

    Args:
        path: The file.
        parameters: What the assessment was learned with.
        info: What its training episodes share.
        adaptation: What it was adapted to.
        numbers: Further values, of JSON types.
        tensors: Arrays by name.
    """
    from safetensors.numpy import save

    metadata = {
        "schema": SCHEMA,
        "schema_version": str(SCHEMA_VERSION),
        "parameters": json.dumps(asdict(parameters)),
        "info": json.dumps(asdict(info)),
        "adaptation": json.dumps(None if adaptation is None else asdict(adaptation)),
        "numbers": json.dumps(dict(numbers)),
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


def read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads what `write` wrote.

    Returns:
        "parameters", "info", "adaptation" and "numbers" by name, and the arrays.

    Raises:
        ValueError: The file is truncated, of another kind, of another schema version, or lacks
            what every one has.
    """
    metadata, tensors = _open(path)
    if metadata.get("schema") != SCHEMA:
        raise ValueError(
            f"'{path}' is no safety assessment: its schema is '{metadata.get('schema')}', "
            f"expected '{SCHEMA}'"
        )
    if metadata.get("schema_version") != str(SCHEMA_VERSION):
        raise ValueError(
            f"'{path}' has the schema version {metadata.get('schema_version')}, this version "
            f"reads {SCHEMA_VERSION}: train the assessment again (episodes are kept: `--resume`)"
        )
    try:
        parameters = json.loads(metadata["parameters"])
        parameters["adaptation"] = AdaptationParameters(**parameters["adaptation"])
        adaptation = json.loads(metadata["adaptation"])
        return {
            "parameters": AssessmentParameters(**parameters),
            "info": EpisodesInfo(**json.loads(metadata["info"])),
            "adaptation": None if adaptation is None else Adaptation(**adaptation),
            "numbers": json.loads(metadata["numbers"]),
        }, tensors
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"'{path}' is a damaged safety assessment: {error}") from error


def save(assessment: SafetyAssessment, path: Path) -> None:
    """Writes a fitted assessment.

    Args:
        assessment: The assessment.
        path: The file.
    """
    base_logit, correction = assessment.base_logit_, assessment.correction_
    tensors: dict[str, np.ndarray] = {
        f"embedding.{name}": w for name, w in assessment.embedding_.weights.items()
    }
    tensors |= {
        "beliefs": assessment.beliefs_,
        "correction.change": correction.change,
        "correction.hidden": correction.hidden,
        "correction.hidden_range": correction.hidden_range,
        "correction.guard": correction.guard.astype(np.uint8),
        "training_points": assessment.training_points_,
        "training_score": assessment.training_score_.astype(np.float32),
        "training_cause": assessment.training_cause_.astype(np.int16),
    }
    if assessment.training_heads_ is not None and assessment.training_nearest_ is not None:
        tensors["training_heads"] = assessment.training_heads_.astype(np.float32)
        tensors["training_nearest"] = assessment.training_nearest_.astype(np.int16)
    write(
        path,
        parameters=assessment.parameters,
        info=assessment.info_,
        adaptation=assessment.adaptation_,
        numbers={
            "num_margins": assessment.embedding_.num_margins,
            "base_logit": None if base_logit is None else asdict(base_logit),
            "calibrations": [one.to_json() for one in assessment.calibrations_.values()],
        },
        tensors=tensors,
    )


def restore(
    assessment: SafetyAssessment,
    tensors: dict[str, np.ndarray],
    *,
    num_margins: int,
    base_logit: dict[str, Any] | None,
    calibrations: list[dict[str, Any]],
) -> None:
    """Gives an assessment, whose parameters and info are known, the rest of what `save` wrote.

    Args:
        assessment: The assessment.
        tensors: Arrays by name.
        num_margins: n_c of the maps; 0 without a margin head.
        base_logit: L; None without heads.
        calibrations: Of each kind.

    Raises:
        KeyError: An array is missing.
        ValueError: Shapes do not fit each other.
    """
    parameters, info = assessment.parameters, assessment.info_
    assessment.grid_ = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
    prefix = "embedding."
    weights = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    assessment.embedding_ = Embedding(weights, num_margins=num_margins)
    if assessment.embedding_.num_inputs != num_inputs(info, parameters):
        raise ValueError(
            f"its maps take {assessment.embedding_.num_inputs} inputs, "
            f"its names amount to {num_inputs(info, parameters)}"
        )
    assessment.training_points_ = tensors["training_points"]
    assessment.training_score_ = single(tensors["training_score"])
    assessment.training_cause_ = tensors["training_cause"].astype(np.int64)
    heads, nearest = tensors.get("training_heads"), tensors.get("training_nearest")
    assessment.training_heads_ = None if heads is None else single(heads)
    assessment.training_nearest_ = None if nearest is None else nearest.astype(np.int64)
    assessment.base_logit_ = None
    if base_logit is not None:
        low, high = base_logit["margin_range"]
        assessment.base_logit_ = BaseLogit(**base_logit | {"margin_range": (low, high)})
    stored = [Calibration(**one) for one in calibrations]
    assessment.calibrations_ = {one.kind: one for one in stored}
    assessment.beliefs_ = tensors["beliefs"]
    assessment.correction_ = Correction(
        change=tensors["correction.change"],
        hidden=tensors["correction.hidden"],
        hidden_range=tensors["correction.hidden_range"],
        guard=tensors["correction.guard"].astype(float),
    )
    num_members, num_cells = assessment.embedding_.num_members, assessment.grid_.num_cells
    for name, shape, expected in (
        ("beliefs", assessment.beliefs_.shape, (num_members, num_cells, 3 + assessment.num_causes)),
        ("correction's change", assessment.correction_.change.shape, (3,)),
        (
            "correction's hidden",
            assessment.correction_.hidden.shape,
            (num_members, assessment.embedding_.num_activations + 1),
        ),
        ("correction's hidden_range", assessment.correction_.hidden_range.shape, (2,)),
        ("correction's guard", assessment.correction_.guard.shape, (num_members, num_cells)),
    ):
        if shape != expected:
            raise ValueError(f"the shape of its {name} is {shape}, expected {expected}")


def single(values: np.ndarray) -> np.ndarray:
    """Values that single precision holds, as doubles: files keep one number for every segment."""
    return values.astype(np.float32).astype(float)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
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
        raise ValueError(f"'{path}' is no safety assessment, or is truncated: {error}") from error
