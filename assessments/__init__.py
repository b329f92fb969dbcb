"""Trained assessments shipped with the package, one folder per scenario, and their loader.

A folder contains `MODE.safetensors`; `evaluation.json`: results on fresh episodes, the files'
hashes, and the verdicts on the first of these episodes; and its card `README.md`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment

__all__ = ["assessed_scenarios", "load_assessment", "shipped_folder"]

_FOLDER = Path(__file__).parent


def assessed_scenarios() -> list[str]:
    """Returns the names of scenarios with shipped assessments."""
    return sorted({path.parent.name for path in _FOLDER.glob("*/*.safetensors")})


def shipped_folder(scenario: str) -> Path:
    """Returns the folder of a scenario's shipped assessments, by its name."""
    if scenario not in assessed_scenarios():
        raise ValueError(
            f"no trained assessment of scenario '{scenario}' comes with the package, which has "
            f"some of {assessed_scenarios()}: `drake-safety train` makes one"
        )
    return _FOLDER / scenario


def load_assessment(scenario: str | os.PathLike[str], mode: str = "sharpened") -> SafetyAssessment:
    """Loads an assessment in a mode, "sharpened" or "paper".

    Args:
        scenario: Name of a scenario with shipped assessments, or a folder that ``train`` wrote.

    Example: ``plain = load_assessment(legged_scenario.name, mode="paper")``
    """
    from drake_safety.learning.assessment import SafetyAssessment

    folder = Path(scenario)
    if scenario in assessed_scenarios() or not folder.is_dir():
        folder = shipped_folder(str(scenario))
    modes = sorted(path.stem for path in folder.glob("*.safetensors"))
    if mode not in modes:
        raise ValueError(
            f"the trained assessments of scenario or folder '{scenario}' are {modes}; got '{mode}'"
        )
    return SafetyAssessment.load(folder / f"{mode}.safetensors")
