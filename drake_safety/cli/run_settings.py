"""Settings and recordings of runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pydrake.geometry import Meshcat
from rich.table import Table

from drake_safety.cli.console import (
    LOOPBACK,
    command_line,
    console,
    new_table,
    open_viewer,
    print_path,
    versions,
    warn_of_empty_scene,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.scenario import Scenario

LOG_PERIOD_S = 0.02


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of ``drake-safety run``.

    Attributes:
        scenario: The scenario.
        assessment: Γ.
        variation: Variation of the plant.
        options: Options of the diagram.
        pushes: Values of ``--push``.
        seed: Seed of start, plan and noise.
        duration_s: Duration of the simulation [s]; None for the default.
        folder: Folder of recording and figures.
        is_live: Whether the run is shown in the browser, in real time.
        host: Address that serves the page.
    """

    scenario: Scenario
    assessment: SafetyAssessment
    variation: str
    options: dict[str, Any]
    pushes: list[str]
    seed: int
    duration_s: float | None
    folder: Path
    is_live: bool
    host: str = LOOPBACK

    @property
    def realtime_rate(self) -> float:
        """Target real-time rate; 0 for as fast as possible."""
        return 1.0 if self.is_live else 0.0

    def make_loop(self, meshcat: Meshcat | None = None, **options: Any) -> ClosedLoop:
        """Makes the diagram of the task.

        Args:
            meshcat: Adds a visualizer.
            **options: More options of the diagram.
        """
        return self.scenario.make_loop(
            self.variation, assessment=self.assessment, meshcat=meshcat, **self.options, **options
        )


class Recording:
    """A run in Meshcat, shown live or recorded in one HTML file.

    Args:
        settings: Settings of the run.
    """

    def __init__(self, settings: RunSettings):
        self._settings = settings
        self.viewer = open_viewer(settings.host)
        if settings.is_live:
            console.print(f"live at {self.viewer.web_url()}")

    def start(self) -> None:
        """Starts recording; with a live view, after the user confirms."""
        if self._settings.is_live:
            input("Press Enter when the browser shows the robot. ")
        self.viewer.StartRecording()

    def save(self, figures: Mapping[str, Figure], events: Table, threshold: str) -> None:
        """Writes recording and figures, and prints the events and the paths.

        Args:
            figures: Figures by the name of their files.
            events: Table of the events.
            threshold: The threshold of triggers or alarms in words: value, quantity, origin.
        """
        warn_of_empty_scene(self.viewer, self._settings.scenario.task)
        self.viewer.StopRecording()
        self.viewer.PublishRecording()
        folder = self._settings.folder
        folder.mkdir(parents=True, exist_ok=True)
        recording = folder / "recording.html"
        recording.write_text(self.viewer.StaticHtml(), encoding="utf-8")
        pictures = [path for name in figures for path in save(figures[name], folder / name)]
        (folder / "run.json").write_text(_events_json(events), encoding="utf-8")
        console.print(events)
        console.print("threshold", threshold, highlight=False, soft_wrap=True)
        print_path("recording", recording)
        for path in pictures:
            print_path("picture  ", path)


def logged_ports(loop: ClosedLoop) -> tuple[str, ...]:
    """The ports of Γ and, if the loop has them, of the monitor."""
    of_gamma = ("safety_probability", "belief", "cause_probability", "predicted_margins")
    return (*of_gamma, *filter(loop.HasOutputPort, ("alarm", "alarm_cause")))


def first_below(probability: np.ndarray, threshold: float) -> int | None:
    """First row in which the probability is below a threshold or NaN; None for never."""
    is_below = ~(probability >= threshold)
    return int(np.argmax(is_below)) if is_below.any() else None


def events_table(
    events: Sequence[tuple[float, str]],
    time_s: np.ndarray,
    extra: Mapping[str, np.ndarray],
    assessment: SafetyAssessment,
) -> Table:
    """A table of events, times [s] and words, and the monitor's alarms, with the probability then.

    The log has the `logged_ports` as `extra`, (N, size) each, at instants (N,) [s].
    """
    table = new_table("time [s]", "event", "probability")
    probability = extra["safety_probability"][:, 0]
    is_on = extra.get("alarm", np.zeros((len(time_s), 1)))[:, 0] > 0.5
    withdrawn = ". The promise is withdrawn" if assessment.calibrations_ else ""
    alarms = []
    for k in np.flatnonzero(np.diff(is_on, prepend=False)).tolist():
        told = f"{extra['alarm_cause'][k]}{withdrawn}" if is_on[k] else "the alarm ends"
        alarms.append((float(time_s[k]), f"monitor: {told}"))
    for instant, event in sorted([*events, *alarms], key=lambda one: one[0]):
        row = abs(time_s - instant).argmin()
        table.add_row(f"{instant:.2f}", event, f"{probability[row]:.2f}")
    return table


def _events_json(events: Table) -> str:
    """The events for the report: command, versions, columns and rows."""
    content = {
        "command": command_line(),
        "versions": versions(),
        "columns": [str(column.header) for column in events.columns],
        "rows": [list(row) for row in zip(*(c.cells for c in events.columns), strict=True)],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"
