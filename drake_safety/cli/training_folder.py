"""The folder that ``train`` writes and the other commands read: episodes, an assessment a mode."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment

MODES = ("sharpened", "paper")
"""Modes that are trained and compared, the default first."""


def episodes_folder(folder: Path) -> Path:
    """Where ``train`` keeps the nominal episodes."""
    return folder / "episodes"


def fresh_episodes_folder(
    folder: Path, scenario_hash: str, seed: int, loop_options: dict[str, str]
) -> Path:
    """Where ``evaluate`` keeps the nominal episodes it judges by, so that it can go on with them.

    Args:
        folder: The folder of the training.
        scenario_hash: Of what was simulated: another simulation is another set.
        seed: Of the set.
        loop_options: Options of the task's diagram.
    """
    options = [f"{name}-{value}" for name, value in sorted(loop_options.items())]
    return folder / "fresh" / "-".join([scenario_hash[:12], f"{seed}", *options])


def assessment_file(folder: Path, mode: str) -> Path:
    """Where ``train`` keeps the assessment of a mode."""
    return folder / f"{mode}.safetensors"


def load_assessment(folder: Path, mode: str) -> SafetyAssessment:
    """Loads what ``train`` wrote.

    Raises:
        ValueError: The folder does not hold it.
    """
    from drake_safety.learning.assessment import SafetyAssessment

    path = assessment_file(folder, mode)
    if not path.is_file():
        there = sorted(file.stem for file in folder.glob("*.safetensors"))
        raise ValueError(
            f"{folder} holds no '{mode}' assessment; it holds {there}: "
            "run `drake-safety train` first"
        )
    return SafetyAssessment.load(path)
