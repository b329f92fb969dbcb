"""What every kind of run is given, and the recording that it leaves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_safety.cli.console import command_line, console, new_table, print_path, versions

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from pydrake.geometry import Meshcat
    from rich.table import Table

    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.scenario import Scenario

LOG_PERIOD_S = 0.02


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What ``drake-safety run`` was asked for.

    Attributes:
        scenario: The scenario.
        assessment: Γ.
        variation: Which plant.
        options: Of the task's diagram.
        pushes: As they were typed.
        seed: Of start, plan and noise.
        duration_s: How long to simulate [s]; None for as long as this kind of run takes.
        folder: Where recording and pictures go.
        is_live: Whether somebody watches in the browser, in real time.
        is_animated: Whether a moving picture is wanted, too.
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
    is_animated: bool = False

    @property
    def realtime_rate(self) -> float:
        """How fast to run at most; 0 for as fast as it goes."""
        return 1.0 if self.is_live else 0.0

    def make_loop(self, meshcat: Meshcat | None = None, **options: Any) -> ClosedLoop:
        """The task's diagram.

        Args:
            meshcat: Adds a visualiser.
            **options: More of the task's options.
        """
        return self.scenario.make_loop(
            self.variation,
            assessment=self.assessment,
            meshcat=meshcat,
            **self.options,
            **options,
        )


class Recording:
    """A run in Meshcat: watched live, and kept as one HTML file.

    Args:
        settings: Of the run.
    """

    def __init__(self, settings: RunSettings):
        from pydrake.geometry import Meshcat

        self._settings = settings
        self.viewer = Meshcat()
        if settings.is_live:
            console.print(f"live at {self.viewer.web_url()}")

    def start(self) -> None:
        """Records from here on; waits for whoever watches live."""
        if self._settings.is_live:
            input("Press Enter when the browser shows the robot. ")
        self.viewer.StartRecording()

    def save(self, timeline: Figure, events: Table) -> None:
        """Writes recording and timeline, and prints the events and where both are.

        Args:
            timeline: Γ over the time of the run.
            events: What happened when.
        """
        from drake_safety.evaluation.figure_style import save

        self.viewer.StopRecording()
        self.viewer.PublishRecording()
        folder = self._settings.folder
        folder.mkdir(parents=True, exist_ok=True)
        recording = folder / "recording.html"
        recording.write_text(self.viewer.StaticHtml(), encoding="utf-8")
        pictures = save(timeline, folder / "timeline")
        (folder / "run.json").write_text(_events_json(events), encoding="utf-8")
        console.print(events)
        print_path("recording", recording)
        for path in pictures:
            print_path("picture  ", path)


def events_table(
    events: Sequence[tuple[float, str]], time_s: np.ndarray, gamma: np.ndarray
) -> Table:
    """What happened when, and what Γ was then.

    Args:
        events: When [s], and what.
        time_s: Instants of the log [s], (N,).
        gamma: Safety probability, (N,).
    """
    table = new_table("time [s]", "event", "Γ")
    for instant, event in sorted(events, key=lambda one: one[0]):
        row = abs(time_s - instant).argmin()
        table.add_row(f"{instant:.2f}", event, f"{gamma[row]:.2f}")
    return table


def save_moving_picture(
    settings: RunSettings,
    loop: ClosedLoop,
    time_s: np.ndarray,
    states: Mapping[str, np.ndarray],
    gamma: np.ndarray,
    threshold: float,
    event_times_s: Sequence[float],
) -> None:
    """Writes animation.gif beside the recording, if it was asked for.

    Args:
        settings: Of the run.
        loop: The closed loop that was simulated.
        time_s: Instants of its log [s], (N,).
        states: Per model instance by name its positions and velocities, (N, n).
        gamma: Safety probability, (N,).
        threshold: Below it something is done.
        event_times_s: When it was [s].
    """
    if not settings.is_animated:
        return
    from drake_safety.evaluation.animation import save_animation
    from drake_safety.evaluation.stills import stack_positions

    path = save_animation(
        loop,
        time_s,
        stack_positions(loop, states),
        gamma,
        threshold,
        settings.folder / "animation.gif",
        event_times_s=event_times_s,
    )
    print_path("animation", path)


def _events_json(events: Table) -> str:
    """What happened when, for the report: where it comes from, and the table's columns and rows."""
    content = {
        "command": command_line(),
        "versions": versions(),
        "columns": [str(column.header) for column in events.columns],
        "rows": [list(row) for row in zip(*(c.cells for c in events.columns), strict=True)],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"
