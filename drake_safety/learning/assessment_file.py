"""Assessments on disk: one safetensors file each, whole or absent."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.learning.adaptation import Adaptation
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.segments import EpisodesInfo

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
