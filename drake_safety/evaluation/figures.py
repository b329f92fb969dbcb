"""Pictures of an assessment at work: its map, its timeline, its errors.

Every function returns a matplotlib figure that belongs to no window; `save` writes it. The colours
stay apart for colour-blind eyes: blue is safe, vermilion unsafe, grey unknown.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.grid import OUTSIDE, Grid
from drake_safety.learning.segments import Episodes, split

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpecBase

    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.simulation.balls import Throw

SAFE_COLOUR = "#2b6cb0"
UNSAFE_COLOUR = "#d1541b"
UNKNOWN_COLOUR = "#c9ccd1"
RECOVERY_COLOUR = "#1b9e77"
INK = "#22262b"
_FAINT = "#8a9099"
_SERIES = ("#2b6cb0", "#d1541b", "#1b9e77", "#8e5ea2", "#c99700", "#4d4d4d")
_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))

OUTCOMES: dict[str, tuple[str, str]] = {
    "survived": (SAFE_COLOUR, "o"),
    "recovered": (RECOVERY_COLOUR, "^"),
    "false trigger": ("#c99700", "s"),
    "fell": (UNSAFE_COLOUR, "X"),
}
"""What can come of a throw, with colour and marker."""

_STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": _FAINT,
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
    "savefig.facecolor": "white",
    "svg.hashsalt": "drake_safety",
}
_DPI = 200
_MAX_POINTS = 12000


@contextmanager
def _style() -> Iterator[None]:
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield


def _new_figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    fig = Figure(figsize=(width, height), layout="constrained")
    fig.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # type: ignore[union-attr, call-arg]
    return fig


def save(fig: Figure, path: str | os.PathLike[str]) -> list[Path]:
    """Writes a figure as PNG, at twice the usual resolution, and as SVG.

    Args:
        fig: The figure.
        path: Where to; its suffix is replaced.

    Returns:
        The two paths, PNG first.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _style():
        paths = [path.with_suffix(".png"), path.with_suffix(".svg")]
        fig.savefig(paths[0], dpi=_DPI)
        fig.savefig(paths[1], dpi=_DPI, metadata={"Date": None})
    return paths


def _safety_colours() -> Colormap:
    """From unsafe (0) over a pale middle to safe (1)."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = ["#9c3209", UNSAFE_COLOUR, "#f0b48f", "#f2efe9", "#a3c4e2", SAFE_COLOUR, "#1b4a80"]
    return LinearSegmentedColormap.from_list("safety", stops)


def embedding_figure(
    assessment: SafetyAssessment,
    episodes: Episodes,
    *,
    beliefs: np.ndarray | None = None,
    right: str = "causes",
) -> Figure:
    """The map: segments in the embedding, the beliefs of its cells, and their causes.

    Of an ensemble it is the first map.

    Args:
        assessment: A fitted assessment.
        episodes: Episodes whose segments are drawn, best ones it has not learned from.
        beliefs: Beliefs instead of the assessment's own, (K, R*R, 3 + n_c).
        right: What the right panel shows: "causes", the constraint most likely to be violated, or
            "uncertainty", mu.

    Raises:
        ValueError: Unknown `right`.
    """
    if right not in ("causes", "uncertainty"):
        raise ValueError(
            f"embedding_figure: right is '{right}', expected 'causes' or 'uncertainty'"
        )
    beliefs = assessment.beliefs_ if beliefs is None else beliefs
    cells = beliefs[0]
    grid = assessment.grid_
    inside = grid.locate(assessment.training_points_[0])
    count = np.bincount(inside[inside != OUTSIDE], minlength=grid.num_cells)

    with _style():
        fig = _new_figure(14.0, 4.6)
        left, middle, last = fig.subplots(1, 3)
        _draw_segments(fig, left, assessment, episodes)
        _draw_safety(
            fig, middle, grid, cells, count, 1.0 - assessment.parameters.initial_uncertainty
        )
        if right == "causes":
            _draw_causes(fig, last, grid, cells, assessment.info_.constraint_names)
        else:
            _draw_uncertainty(fig, last, grid, cells)
        for axes in (left, middle, last):
            half = grid.half_width
            axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")
    return fig


def _draw_segments(
    fig: Figure, axes: Axes, assessment: SafetyAssessment, episodes: Episodes
) -> None:
    parameters = assessment.parameters
    segments = split(episodes, stride=max(parameters.horizon // 2, 1), discount=parameters.discount)
    # Drawn in random order, so that neither class hides the other.
    order = np.random.default_rng(0).permutation(len(segments))[:_MAX_POINTS]
    segments = segments.take(order)
    points = assessment.predict(
        segments.state, segments.desired_preview, segments.features
    ).embedding
    _draw_grid(axes, assessment.grid_)
    dots = axes.scatter(
        points[:, 0],
        points[:, 1],
        c=segments.score,
        cmap=_safety_colours().reversed(),
        vmin=0.0,
        vmax=1.0,
        s=5.0,
        linewidths=0.0,
        alpha=0.85,
        rasterized=True,
    )
    axes.set_title("Segments in the embedding")
    axes.set_xlabel(f"{len(segments)} segments of {len(episodes)} episodes")
    bar = fig.colorbar(dots, ax=axes, shrink=0.8, pad=0.02, label="unsafety score λ")
    bar.outline.set_visible(False)
    if bar.solids is not None:
        bar.solids.set_alpha(1.0)


def _draw_grid(axes: Axes, grid: Grid) -> None:
    edges = np.linspace(-grid.half_width, grid.half_width, grid.resolution + 1)
    axes.vlines(edges, edges[0], edges[-1], color="#e3e5e8", linewidth=0.6, zorder=0)
    axes.hlines(edges, edges[0], edges[-1], color="#e3e5e8", linewidth=0.6, zorder=0)


def _draw_cells(axes: Axes, grid: Grid, colours: np.ndarray, is_empty: np.ndarray) -> None:
    """Squares of given colours, (R*R, 4); empty ones are hatched."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    corners = grid.centres - 0.5 * grid.cell_length
    squares = [Rectangle((x, y), grid.cell_length, grid.cell_length) for x, y in corners]
    filled = [square for square, empty in zip(squares, is_empty, strict=True) if not empty]
    hollow = [square for square, empty in zip(squares, is_empty, strict=True) if empty]
    axes.add_collection(
        PatchCollection(
            hollow, facecolor="#f1f2f4", edgecolor="#dadde1", linewidth=0.5, hatch="////"
        )
    )
    axes.add_collection(
        PatchCollection(filled, facecolor=colours[~is_empty], edgecolor="white", linewidth=0.8)
    )
    axes.set_xlabel(f"{len(filled)} of {grid.num_cells} cells hold a belief")


def _short(count: int) -> str:
    if count < 1000:
        return str(count)
    return f"{count / 1000:.1f}k" if count < 9950 else f"{count / 1000:.0f}k"


def _draw_safety(
    fig: Figure, axes: Axes, grid: Grid, cells: np.ndarray, count: np.ndarray, most: float
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shade = ScalarMappable(Normalize(0.0, max(most, cells[:, SAFE].max())), _safety_colours())
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    colours = shade.to_rgba(cells[:, SAFE])
    _draw_cells(axes, grid, colours, is_empty)
    brightness = colours[:, :3] @ [0.299, 0.587, 0.114]
    for (x, y), number, light, empty in zip(
        grid.centres, count, brightness > 0.6, is_empty, strict=True
    ):
        if number:
            ink = _FAINT if empty else INK if light else "white"
            axes.text(
                x, y, _short(number), ha="center", va="center_baseline", fontsize=6.5, color=ink
            )
    axes.set_title("Belief of each cell: safe")
    axes.set_xlabel("numbers: segments learned from; hatched: EMPTY")
    bar = fig.colorbar(shade, ax=axes, shrink=0.8, pad=0.02, label="belief mass of safe")
    bar.outline.set_visible(False)


def _draw_causes(
    fig: Figure, axes: Axes, grid: Grid, cells: np.ndarray, names: Sequence[str]
) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    palette = np.array([to_rgb(_SERIES[(1 + i) % len(_SERIES)]) for i in range(len(names))])
    cause = cells[:, 3:].argmax(axis=1)
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    # White where nothing is unsafe, the cause's own colour where all that is known is.
    depth = (cells[:, UNSAFE] / np.where(is_empty, 1.0, 1.0 - cells[:, UNCERTAINTY]))[:, None]
    colours = np.column_stack([1.0 - depth * (1.0 - palette[cause]), np.ones(len(cells))])
    colours[:, :3] *= 0.97
    _draw_cells(axes, grid, colours, is_empty)
    axes.set_title("Most likely cause")
    axes.legend(
        handles=[Patch(color=c, label=_words(n)) for c, n in zip(palette, names, strict=True)],
        title="pale: unlikely",
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        handlelength=1.0,
        handleheight=1.0,
    )


def _draw_uncertainty(fig: Figure, axes: Axes, grid: Grid, cells: np.ndarray) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    ramp = LinearSegmentedColormap.from_list("unknown", ["#fbfbfc", "#b3a5c9", "#3f2a63"])
    shade = ScalarMappable(Normalize(0.0, 1.0), ramp)
    _draw_cells(axes, grid, shade.to_rgba(cells[:, UNCERTAINTY]), cells[:, UNCERTAINTY] >= 1.0)
    axes.set_title("Belief of each cell: unknown")
    bar = fig.colorbar(shade, ax=axes, shrink=0.8, pad=0.02, label="uncertainty μ")
    bar.outline.set_visible(False)


def _words(name: str) -> str:
    return name.replace("_", " ")


def timeline_figure(
    time_s: np.ndarray,
    gamma: np.ndarray,
    threshold: float,
    *,
    throws: Sequence[Throw] = (),
    trigger_times_s: Sequence[float] = (),
    recovery_intervals_s: Sequence[tuple[float, float]] = (),
    stills: Sequence[tuple[float, np.ndarray]] = (),
    belief: np.ndarray | None = None,
    margins: np.ndarray | None = None,
    constraint_names: Sequence[str] = (),
    gamma_label: str = "safety probability Γ",
) -> Figure:
    """Gamma over time, with pictures of the robot at the moments that matter.

    Args:
        time_s: Instants [s], (N,).
        gamma: Safety probability, held until the next instant, (N,).
        threshold: Below it a recovery is triggered.
        throws: Balls, each marked at the instant it touches.
        trigger_times_s: When a recovery was triggered [s].
        recovery_intervals_s: (start, end) of each recovery [s].
        stills: (time [s], RGB image (height, width, 3)), each joined to its instant on the curve.
        belief: Masses (safe, unsafe, unknown), (N, 3); drawn stacked below.
        margins: Signed margins [m], (N, n_c); drawn at the bottom.
        constraint_names: Names of the columns of `margins`.
        gamma_label: What `gamma` is.

    Raises:
        ValueError: Arrays of different lengths, margins without as many names, or a still outside
            the time shown.
    """
    time_s, gamma = np.asarray(time_s, dtype=float), np.asarray(gamma, dtype=float)
    for name, values in (("gamma", gamma), ("belief", belief), ("margins", margins)):
        if values is not None and len(values) != len(time_s):
            raise ValueError(
                f"timeline_figure: {name} has {len(values)} rows, expected {len(time_s)}"
            )
    if margins is not None and margins.shape[1] != len(constraint_names):
        raise ValueError(
            f"timeline_figure: margins have {margins.shape[1]} columns, but the constraints are "
            f"{list(constraint_names)}"
        )
    for instant, _ in stills:
        if not time_s[0] - 1e-9 <= instant <= time_s[-1] + 1e-9:
            raise ValueError(
                f"timeline_figure: a still at {instant} s is outside {time_s[0]}..{time_s[-1]} s"
            )
    with _style():
        width = 12.0
        heights = [2.4] + [1.0] * (belief is not None) + [1.3] * (margins is not None)
        picture_height = 0.0
        if stills:
            aspect = max(image.shape[0] / image.shape[1] for _, image in stills)
            picture_height = min(aspect * width / len(stills), 2.6) + 0.35
        fig = _new_figure(width, sum(heights) + picture_height + 0.6)
        if stills:
            halves = fig.add_gridspec(
                2, 1, height_ratios=[picture_height, sum(heights)], hspace=0.08
            )
            strip = halves[0, 0].subgridspec(1, len(stills), wspace=0.03)
            pictures = [fig.add_subplot(strip[0, i]) for i in range(len(stills))]
            rows: GridSpecBase = halves[1, 0].subgridspec(len(heights), 1, height_ratios=heights)
        else:
            rows = fig.add_gridspec(len(heights), 1, height_ratios=heights)
        panels: list[Axes] = []
        for i in range(len(heights)):
            panels.append(fig.add_subplot(rows[i, 0], sharex=panels[0] if panels else None))

        _draw_gamma(panels[0], time_s, gamma, threshold, gamma_label)
        remaining = iter(panels[1:])
        if belief is not None:
            _draw_belief(next(remaining), time_s, belief)
        if margins is not None:
            _draw_margins(next(remaining), time_s, margins, constraint_names)
        _mark_events(panels, time_s, threshold, throws, trigger_times_s, recovery_intervals_s)
        if stills:
            _draw_stills(fig, pictures, panels[0], time_s, gamma, stills)
        for panel in panels[:-1]:
            panel.tick_params(labelbottom=False)
        panels[-1].set_xlabel("time [s]")
        panels[0].set_xlim(time_s[0], time_s[-1])
        fig.align_ylabels(panels)
    return fig


def _draw_gamma(
    axes: Axes, time_s: np.ndarray, gamma: np.ndarray, threshold: float, label: str
) -> None:
    axes.axhline(threshold, color=UNSAFE_COLOUR, linestyle=(0, (4, 3)), linewidth=1.2)
    axes.annotate(
        f"threshold {threshold:g}",
        (1.0, threshold),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        ha="right",
        color=UNSAFE_COLOUR,
        fontsize=9,
    )
    axes.step(time_s, gamma, where="post", color=SAFE_COLOUR, linewidth=2.0)
    axes.set_ylim(-0.02, 1.05)
    axes.set_yticks([0.0, 0.5, 1.0])
    axes.set_ylabel(label)


def _draw_belief(axes: Axes, time_s: np.ndarray, belief: np.ndarray) -> None:
    safe = belief[:, SAFE]
    known_or_not = safe + belief[:, UNCERTAINTY]
    layers = (
        ("safe", np.zeros_like(safe), safe, SAFE_COLOUR),
        ("unknown", safe, known_or_not, UNKNOWN_COLOUR),
        ("unsafe", known_or_not, np.ones_like(safe), UNSAFE_COLOUR),
    )
    for name, lower, upper, colour in layers:
        axes.fill_between(time_s, lower, upper, step="post", color=colour, linewidth=0, label=name)
    axes.set(ylim=(0.0, 1.0), yticks=[0.0, 1.0], ylabel="belief")
    handles, labels = axes.get_legend_handles_labels()
    _legend_right(axes, handles[::-1], labels[::-1])


def _draw_margins(
    axes: Axes, time_s: np.ndarray, margins: np.ndarray, names: Sequence[str]
) -> None:
    axes.axhline(0.0, color=_FAINT, linewidth=0.8)
    for i, name in enumerate(names):
        axes.plot(
            time_s,
            100.0 * margins[:, i],
            color=_SERIES[(2 + i) % len(_SERIES)],
            linestyle=_DASHES[i % len(_DASHES)],
            linewidth=1.5,
            label=_words(name),
        )
    low, high = axes.get_ylim()
    low = min(low, -0.12 * high)
    axes.axhspan(low, 0.0, color=UNSAFE_COLOUR, alpha=0.08, linewidth=0)
    axes.set(ylim=(low, high), ylabel="margin [cm]")
    _legend_right(axes, *axes.get_legend_handles_labels())


def _legend_right(axes: Axes, handles: Sequence[Any], labels: Sequence[str]) -> None:
    axes.legend(
        handles,
        labels,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        handlelength=1.4,
        borderaxespad=0.3,
    )


def _mark_events(
    panels: Sequence[Axes],
    time_s: np.ndarray,
    threshold: float,
    throws: Sequence[Throw],
    trigger_times_s: Sequence[float],
    recovery_intervals_s: Sequence[tuple[float, float]],
) -> None:
    span = time_s[-1] - time_s[0]
    for panel in panels:
        for throw in throws:
            panel.axvline(throw.time_s, color=INK, linewidth=1.0, linestyle=(0, (1, 2)))
        for instant in trigger_times_s:
            panel.axvline(instant, color=UNSAFE_COLOUR, linewidth=1.2)
    gamma = panels[0]
    for start, end in recovery_intervals_s:
        gamma.axvspan(start, end, color=RECOVERY_COLOUR, alpha=0.14, linewidth=0, zorder=0)
        gamma.annotate(
            "recovery steps",
            (0.5 * (start + end), 0.0),
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
            color=RECOVERY_COLOUR,
            fontsize=9,
        )
    for throw in throws:
        is_early = throw.time_s - time_s[0] < 0.15 * span
        gamma.plot(throw.time_s, 0.3, "o", color="#e8730c", markersize=9, clip_on=False, zorder=5)
        gamma.annotate(
            f"{throw.mass_kg:.1f} kg, {throw.speed_m_s:.1f} m/s",
            (throw.time_s, 0.3),
            xytext=(8 if is_early else -8, 0),
            textcoords="offset points",
            ha="left" if is_early else "right",
            va="center",
            fontsize=9,
        )
    for instant in trigger_times_s:
        is_late = time_s[-1] - instant < 0.15 * span
        gamma.plot(instant, threshold, "v", color=UNSAFE_COLOUR, markersize=8, zorder=5)
        gamma.annotate(
            "trigger",
            (instant, threshold),
            xytext=(-7 if is_late else 7, -3),
            textcoords="offset points",
            ha="right" if is_late else "left",
            va="top",
            color=UNSAFE_COLOUR,
            fontsize=9,
        )


def _draw_stills(
    fig: Figure,
    pictures: Sequence[Axes],
    gamma_axes: Axes,
    time_s: np.ndarray,
    gamma: np.ndarray,
    stills: Sequence[tuple[float, np.ndarray]],
) -> None:
    from matplotlib.patches import ConnectionPatch

    for letter, axes, (instant, image) in zip(
        "abcdefghijklmnopqrstuvwxyz", pictures, stills, strict=False
    ):
        axes.imshow(image, interpolation="antialiased")
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        axes.set_title(f"({letter})  {instant:.2f} s", fontsize=10, pad=4)
        row = max(int(np.searchsorted(time_s, instant + 1e-9, side="right")) - 1, 0)
        height = gamma[row] if np.isfinite(gamma[row]) else 0.0
        line = ConnectionPatch(
            xyA=(0.5, 0.0),
            coordsA=axes.transAxes,
            xyB=(instant, height),
            coordsB=gamma_axes.transData,
            color=_FAINT,
            linewidth=0.9,
        )
        line.set_in_layout(False)
        fig.add_artist(line)
        gamma_axes.plot(
            instant, height, "o", color="white", markeredgecolor=INK, markersize=6, zorder=6
        )


def roc_figure(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    *,
    thresholds: Mapping[str, float] | None = None,
    title: str = "",
    corner: float = 0.3,
) -> Figure:
    """How many unsafe ends each scorer sees, against how many safe ones it takes for unsafe.

    Args:
        curves: Per scorer its unsafe scores (N,) and the labels (N,); NaN is the most unsafe.
        thresholds: Per scorer, the threshold whose point on the curve is marked.
        title: Of the figure.
        corner: Share of either axis that the right panel magnifies.
    """
    thresholds = thresholds or {}
    with _style():
        fig = _new_figure(10.0, 5.0)
        whole, magnified = fig.subplots(1, 2)
        for i, (name, (score, label)) in enumerate(curves.items()):
            score = np.where(np.isnan(score), np.inf, np.asarray(score, dtype=float))
            area = area_under_curve(score, label)
            false_alarm, unsafe_recall = _operating_points(score, label)
            colour, dashes = _SERIES[i % len(_SERIES)], _DASHES[i % len(_DASHES)]
            for axes in (whole, magnified):
                axes.plot(
                    false_alarm,
                    unsafe_recall,
                    color=colour,
                    linestyle=dashes,
                    linewidth=1.8,
                    label=f"{name}   {area:.3f}",
                )
                if name in thresholds:
                    is_alarm = score > thresholds[name]
                    axes.plot(
                        is_alarm[~label].mean(),
                        is_alarm[label].mean(),
                        "o",
                        color=colour,
                        markeredgecolor="white",
                        markersize=8,
                        clip_on=False,
                        zorder=5,
                    )
        whole.set(xlim=(0, 1), ylim=(0, 1))
        magnified.set(xlim=(0, corner), ylim=(1.0 - corner, 1.0))
        frame = [[0, corner, corner, 0, 0], [1 - corner, 1 - corner, 1, 1, 1 - corner]]
        whole.plot(*frame, color=_FAINT, linewidth=0.8)
        for axes in (whole, magnified):
            axes.set_aspect("equal")
            axes.set_xlabel("safe, judged unsafe")
            axes.grid(color="#eceef0", linewidth=0.7)
        whole.set_ylabel("unsafe, judged unsafe")
        whole.set_title(title or "Receiver operating characteristic")
        magnified.set_title("The corner, magnified")
        whole.legend(loc="lower right", title="area under the curve", alignment="left")
    return fig


def _operating_points(score: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """False-alarm share and unsafe recall of every threshold, from (0, 0) to (1, 1)."""
    rank = np.unique(-score, return_inverse=True)[1]
    shares = []
    for members in (~label, label):
        hits = np.cumsum(np.bincount(rank, weights=members))
        shares.append(np.concatenate([[0.0], hits / max(hits[-1], 1.0)]))
    return shares[0], shares[1]


def throws_figure(
    speed_m_s: np.ndarray,
    direction_rad: np.ndarray,
    outcomes: Mapping[str, Sequence[str]],
    *,
    mass_kg: np.ndarray | None = None,
) -> Figure:
    """What came of every throw, seen from above the robot: speed outwards, where the ball flies to.

    Args:
        speed_m_s: Speeds [m/s], (N,).
        direction_rad: Where each ball flies to, from the robot's forward axis to its left [rad],
            (N,).
        outcomes: One panel each: its title and the outcome of every throw, a key of `OUTCOMES`.
        mass_kg: Masses [kg], (N,); heavier ones are drawn larger.

    Raises:
        ValueError: An unknown outcome, or not one for every throw.
    """
    speed, direction = np.asarray(speed_m_s), np.asarray(direction_rad)
    for title, found in outcomes.items():
        if len(found) != len(speed):
            raise ValueError(
                f"throws_figure: '{title}' has {len(found)} outcomes for {len(speed)} throws"
            )
        unknown = sorted(set(found) - set(OUTCOMES))
        if unknown:
            raise ValueError(
                f"throws_figure: unknown outcomes {unknown}; the outcomes are {list(OUTCOMES)}"
            )
    size = np.full(len(speed), 22.0) if mass_kg is None else 8.0 * np.asarray(mass_kg)
    with _style():
        fig = _new_figure(4.9 * len(outcomes), 6.3)
        panels = fig.subplots(1, len(outcomes), subplot_kw={"projection": "polar"}, squeeze=False)
        for axes, (title, found) in zip(panels[0], outcomes.items(), strict=True):
            result = np.asarray(found)
            for outcome, (colour, marker) in OUTCOMES.items():
                rows = result == outcome
                if rows.any():
                    is_failure = outcome in ("fell", "false trigger")
                    axes.scatter(
                        direction[rows],
                        speed[rows],
                        s=1.6 * size[rows] if is_failure else size[rows],
                        color=colour,
                        marker=marker,
                        linewidths=0.4,
                        edgecolors="white",
                        label=f"{outcome} {rows.sum()}",
                        zorder=4 if is_failure else 3,
                        rasterized=True,
                    )
            _dress_polar(axes, float(speed.max(initial=1.0)))
            axes.set_title(f"{title}, {len(result)} throws", pad=14)
            axes.legend(
                loc="upper center",
                bbox_to_anchor=(0.5, -0.07),
                ncols=2,
                handletextpad=0.2,
                columnspacing=1.2,
            )
        fig.supxlabel(
            "direction: where the ball flies to, from above the robot; outwards: its speed",
            fontsize=9,
            color=_FAINT,
        )
    return fig


def _dress_polar(axes: Any, fastest: float) -> None:
    axes.set_theta_zero_location("N")
    axes.set_xticks(np.arange(4) * np.pi / 2, ["forward", "left", "backward", "right"])
    axes.set_ylim(0.0, 1.05 * fastest)
    axes.set_yticks([tick for tick in (3, 6, 9, 12) if tick < 1.05 * fastest])
    axes.tick_params(axis="y", labelleft=False)
    for tick in axes.get_yticks():
        # Tick labels would lie below the marks.
        axes.text(
            np.pi / 4,
            tick,
            f"{tick:g} m/s",
            ha="center",
            va="center",
            fontsize=8,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "color": "white", "alpha": 0.8, "linewidth": 0},
        )
    axes.grid(color="#dfe2e5", linewidth=0.7)
    axes.spines["polar"].set_color("#dfe2e5")
    axes.set_axisbelow(True)
