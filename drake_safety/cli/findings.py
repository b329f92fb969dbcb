"""What the parts of ``evaluate`` are given, and what they hand back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_safety.cli.console import Stages
    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.evaluation.scorers import Scorer
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What is judged, and by what.

    Attributes:
        scenario: The scenario.
        sharpened: Γ.
        paper: Γ in the paper's form.
        classifiers: Direct classifiers.
        run_folder: Folder that `train` wrote.
        train_set: The episodes that all of them have learned from.
        calibration_set: Fresh episodes, for thresholds and other choices.
        test_set: Fresh episodes.
        folder: Where pictures go.
        workers: Processes; None for as many as there are cores.
        stages: Shows how far it is.
    """

    scenario: Scenario
    sharpened: SafetyAssessment
    paper: SafetyAssessment
    classifiers: Sequence[Scorer]
    run_folder: Path
    train_set: Episodes
    calibration_set: Episodes
    test_set: Episodes
    folder: Path
    workers: int | None
    stages: Stages


@dataclass(kw_only=True)
class Findings:
    """What was found.

    Attributes:
        estimates: By dotted key.
        entries: What else belongs in the report.
        pictures: Files that were written.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    entries: dict[str, Any] = field(default_factory=dict)
    pictures: list[Path] = field(default_factory=list)

    def add(self, other: Findings) -> None:
        """Takes over what another part has found."""
        self.estimates |= other.estimates
        self.entries |= other.entries
        self.pictures += other.pictures
