"""Inputs and results of the parts of ``evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.evaluation.scorers import Scorer
    from drake_safety.files.progress import StageProgress
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Judged:
    """The evaluated assessments and baselines, and the episodes.

    Attributes:
        scenario: The scenario.
        sharpened: Γ.
        paper: Γ in the paper's form.
        classifiers: Baseline classifiers.
        run_folder: Folder written by `train`.
        calibration_set: Fresh episodes for thresholds.
        test_set: Other fresh episodes.
        folder: Folder of the figures.
        workers: Number of worker processes; None for one a core.
        stages: Progress bars.
    """

    scenario: Scenario
    sharpened: SafetyAssessment
    paper: SafetyAssessment
    classifiers: Sequence[Scorer]
    run_folder: Path
    calibration_set: Episodes
    test_set: Episodes
    folder: Path
    workers: int | None
    stages: StageProgress


@dataclass(kw_only=True)
class Findings:
    """Results of a part.

    Attributes:
        estimates: By dotted key.
        entries: Other entries of the report.
        pictures: Files of the figures.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    entries: dict[str, Any] = field(default_factory=dict)
    pictures: list[Path] = field(default_factory=list)

    def add(self, other: Findings) -> None:
        """Adds the results of another part."""
        self.estimates |= other.estimates
        self.entries |= other.entries
        self.pictures += other.pictures
