"""Common style of all figures: colours distinct for colour-blind readers, fonts, and saving."""

import io
import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_safety.files.atomic import write_file

SAFE_COLOUR = "#2b6cb0"
UNSAFE_COLOUR = "#d1541b"
UNKNOWN_COLOUR = "#c9ccd1"
RECOVERY_COLOUR = "#1b9e77"
BALL_COLOUR = "#e8730c"
INK = "#22262b"
FAINT_INK = "#8a9099"
SERIES_COLOURS = (SAFE_COLOUR, UNSAFE_COLOUR, RECOVERY_COLOUR, "#8e5ea2", "#c99700", "#4d4d4d")
"""Colours of the curves in a panel, in this order."""
SERIES_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
"""Dashes of these curves, which distinguish them in print."""

PAGE_WIDTH = 8.0
"""Width [inches] at which fonts are readable on a page of 680 pixels."""

_STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT_INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "figure.facecolor": "white",
    "figure.constrained_layout.h_pad": 0.08,
    "figure.constrained_layout.w_pad": 0.08,
    "savefig.facecolor": "white",
    "svg.hashsalt": "drake_safety",
    "text.parse_math": False,  # Names may have a dollar.
}

_LABELS = {
    "auc": "AUC",
    "mlp": "MLP",
    "paper_at_06": "paper, unsafe if b_safe < 0.6",
    "reachability": "inverse kinematics",
    "reachability_free": "inverse kinematics, free base",
    "support_margin": "support-polygon margin",
    "capture_point_margin": "capture-point margin",
    "smallest_margin": "smallest margin (true state)",
    "confident_error": "sure and wrong",
    "unknown": "don't know",
    "delay_s": "alarm after [s]",
}


def drawing_style() -> AbstractContextManager[None]:
    """Applies the style to figures drawn or saved inside the block."""
    return mpl.rc_context(_STYLE)


def new_figure(width: float, height: float) -> Figure:
    """Creates an empty figure without a window; sizes in inches."""
    return Figure(figsize=(width, height), layout="constrained")


def draw_threshold(axes: Axes, threshold: float, colour: str) -> None:
    """Draws the line of a threshold, with its value beside it, outside the axes."""
    axes.axhline(threshold, color=colour, linestyle="--", linewidth=1.2)
    place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    place |= {"xytext": (6, 0), "va": "center", "color": colour, "fontsize": 9}
    axes.annotate(f"threshold {threshold:.3g}", (1.0, threshold), **place)


def save(fig: Figure, path: str | os.PathLike[str]) -> list[Path]:
    """Writes a figure as PNG and as SVG, whatever the path's suffix; returns both paths."""
    paths = [Path(path).with_suffix(suffix) for suffix in (".png", ".svg")]
    for one in paths:
        # Without the date, equal figures are equal files.
        metadata: dict[str, Any] | None = {"Date": None} if one.suffix == ".svg" else None
        with drawing_style(), io.BytesIO() as content:
            fig.savefig(content, format=one.suffix[1:], dpi=200, metadata=metadata)
            write_file(one, content.getvalue())
    return paths


def spoken(name: str) -> str:
    """A name as readable text: `support_polygon` → support polygon."""
    return name.replace("_", " ")


def label_of(key: str) -> str:
    """Label of a method in tables and figures."""
    return _LABELS.get(key, spoken(key))
