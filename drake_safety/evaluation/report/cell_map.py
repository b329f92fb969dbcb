"""The map of an assessment by cell: belief, count, causes and a typical episode."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.embedding_figure import (
    FIRST_CAUSE,
    SAFETY_STOPS,
    cause_colours,
    draw_safety,
)
from drake_safety.evaluation.figure_style import drawing_style, new_figure, spoken
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.grid import OUTSIDE
from drake_safety.learning.segments import Episodes, Segments, split

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

_UNKNOWN_STOPS = ("#f3f1f6", "#b3a5c9", "#3f2a63")
_COUNT_STOPS = ("#eaf3ef", "#7fbfa7", "#0f5c45")


def map_cells(
    assessment: SafetyAssessment,
    episodes: Episodes | None = None,
    *,
    angular_constraints: Collection[str] = (),
) -> list[dict[str, Any]]:
    """Describes each cell of the first map of an assessment, as JSON types.

    Args:
        assessment: A fitted assessment.
        episodes: Its training episodes; without them cells have no typical episode.
        angular_constraints: Constraints whose margins are angles.

    Returns:
        One a cell, in the grid's order: ``column`` and ``row`` from the lower left, ``belief``
        (safe, unsafe, don't know), ``count``, ``causes`` (mass of each constraint) and
        ``typical``: an episode, the time at which its segment starts, how it ended, and its
        margins [cm, degrees]; or None.
    """
    grid, beliefs = assessment.grid_, assessment.beliefs_[0]
    count = assessment.training_.counts(grid)[0]
    typical: dict[int, dict[str, Any]] = {}
    if episodes is not None:
        typical = _typical_episodes(assessment, episodes, set(angular_constraints))
    return [
        {
            "column": cell // grid.resolution,
            "row": cell % grid.resolution,
            "belief": [round(float(mass), 4) for mass in masses[:3]],
            "count": int(count[cell]),
            "causes": [round(float(mass), 4) for mass in masses[FIRST_CAUSE:]],
            "typical": typical.get(cell),
        }
        for cell, masses in enumerate(beliefs)
    ]


def _typical_episodes(
    assessment: SafetyAssessment, episodes: Episodes, angular: set[str]
) -> dict[int, dict[str, Any]]:
    parameters = assessment.parameters
    is_sharpened = parameters.is_sharpened
    segments = split(
        episodes,
        stride=parameters.stride,
        discount=parameters.discount,
        shortest=parameters.shortest,
    )
    points = assessment.predict(
        segments.state if is_sharpened else segments.true_state,
        segments.desired_preview,
        segments.features,
    ).embedding
    cells = assessment.grid_.locate(points)
    scale = [
        np.degrees(1.0) if name in angular else 100.0 for name in episodes.info.constraint_names
    ]
    found = {}
    for cell in np.unique(cells[cells != OUTSIDE]):
        row = most_typical(segments, points, np.flatnonzero(cells == cell))
        episode = episodes[int(segments.episode[row])]
        found[int(cell)] = {
            "episode": episode.index,
            "start_s": round(float(episode.time_s[segments.start_row[row]]), 3),
            "cause": episode.cause,
            "time_s": np.round(episode.time_s, 3).tolist(),
            "margins": np.round(episode.margins * scale, 2).T.tolist(),
        }
    return found


def most_typical(segments: Segments, points: np.ndarray, rows: np.ndarray) -> int:
    """Index of the most typical segment of a cell.

    Among the segments with the most frequent end and cause it is the nearest to their mean.

    Args:
        segments: All segments.
        points: Their positions in the embedding, (N, 2).
        rows: Indices of those in the cell, at least one.
    """
    is_unsafe = segments.is_unsafe[rows]
    rows = rows[is_unsafe == (is_unsafe.mean() >= 0.5)]
    causes = segments.cause[rows]
    names, counts = np.unique(causes, return_counts=True)
    rows = rows[causes == names[counts.argmax()]]
    distance = np.linalg.norm(points[rows] - points[rows].mean(axis=0), axis=1)
    return int(rows[distance.argmin()])


def map_views(
    assessment: SafetyAssessment, cells: list[dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """The colourings of the map: fills of the cells and a legend.

    Args:
        assessment: The assessment.
        cells: The result of `map_cells`.

    Returns:
        By name: ``title``, ``meaning``, ``fills`` (None for an empty cell), and either ``stops``
        with ``ends`` (labels of the first and the last) or ``swatches``.
    """
    from matplotlib.colors import to_hex, to_rgb

    names = assessment.info_.constraint_names
    palette = cause_colours(len(names))
    most = max((cell["count"] for cell in cells), default=1)

    def fills(values: list[float], stops: tuple[str, ...]) -> list[Any]:
        shades = _ramp(stops)
        return [
            to_hex(shades(value)) if not _is_empty(cell) else None
            for value, cell in zip(values, cells, strict=True)
        ]

    def cause_fill(cell: dict[str, Any]) -> str | None:
        if _is_empty(cell):
            return None
        colour = np.array(to_rgb(palette[int(np.argmax(cell["causes"]))]))
        # From white, nothing unsafe, to the colour of the cause, all that is known unsafe.
        red, green, blue = 0.97 * (1.0 - (1.0 - safe_share(cell)) * (1.0 - colour))
        return to_hex((red, green, blue))

    return {
        "safe": {
            "title": "safe share",
            "meaning": "Safe share of the belief, b_safe / (1 − μ). Hatched cells are "
            "empty: the answer there is “don't know”.",
            "fills": fills([safe_share(c) for c in cells], SAFETY_STOPS),
            "stops": SAFETY_STOPS,
            "ends": ["0: all unsafe", "1: all safe"],
        },
        "unknown": {
            "title": "don't know",
            "meaning": "The uncertainty of each cell's belief, μ.",
            "fills": fills([c["belief"][2] for c in cells], _UNKNOWN_STOPS),
            "stops": _UNKNOWN_STOPS,
            "ends": ["0: certain", "1: nothing known"],
        },
        "cause": {
            "title": "likely cause",
            "meaning": "The constraint that is most likely to be violated; pale: unlikely.",
            "fills": [cause_fill(cell) for cell in cells],
            "swatches": [[spoken(n), c] for n, c in zip(names, palette, strict=True)],
        },
        "count": {
            "title": "number of segments",
            "meaning": "Number of training segments in each cell.",
            "fills": fills(
                [float(np.log1p(c["count"]) / np.log1p(max(most, 1))) for c in cells],
                _COUNT_STOPS,
            ),
            "stops": _COUNT_STOPS,
            "ends": ["few", f"{most}"],
        },
    }


def map_figure(assessment: SafetyAssessment, cells: list[dict[str, Any]]) -> Figure:
    """Plots the safe share and the number of segments of each cell.

    Args:
        assessment: The assessment.
        cells: The result of `map_cells`.
    """
    with drawing_style():
        fig = new_figure(7.0, 6.0)
        axes = fig.subplots()
        half = assessment.grid_.half_width
        draw_safety(
            fig,
            axes,
            assessment.grid_,
            np.array([safe_share(cell) for cell in cells]),
            np.array([_is_empty(cell) for cell in cells]),
            np.array([cell["count"] for cell in cells]),
            label="safe share, b_safe / (1 − μ)",
        )
        axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")
        axes.set_title(f"Safe share of each cell, mode {assessment.parameters.mode}")
    return fig


def safe_share(cell: dict[str, Any]) -> float:
    """Safe share of a cell's belief, b_safe / (1 - μ); 0 for an empty cell."""
    safe, unsafe = cell["belief"][SAFE], cell["belief"][UNSAFE]
    return float(safe / (safe + unsafe)) if safe + unsafe else 0.0


def _is_empty(cell: dict[str, Any]) -> bool:
    return bool(cell["belief"][UNCERTAINTY] >= 1.0)


def _ramp(stops: tuple[str, ...]) -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("ramp", list(stops))
