"""The reachable region of a plane: simulated outcomes, and the boundaries of Γ and kinematics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
    spoken,
)
from drake_safety.evaluation.plan_study import SAFE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from drake_safety.evaluation.reachable_region import ReachableRegion

_SAFE_TINT = "#bcd3ec"
_UNSAFE_TINTS = ("#f6d3c2", "#f3e2b3", "#e3d2ec", "#d9d9d9", "#f2c4d6", "#cfe3d4")
_KINEMATICS = {
    "reachability": ((0, (4, 2)), "inverse kinematics, fixed base"),
    "reachability_free": ((0, (1, 1.5)), "inverse kinematics, free base"),
}


def region_figure(region: ReachableRegion, constraint_names: list[str]) -> Figure:
    """Plots simulated outcomes as areas, the boundaries of Γ and of inverse kinematics as lines.

    Targets inside an obstacle are grey, those that Γ answers with "don't know" are hatched.
    The view is that of the robot: its left is on the left.

    Args:
        region: The reachable region.
        constraint_names: Constraints of the safe set, which decide the colours of causes.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    y, z = region.simulated_y_m, region.simulated_z_m
    with drawing_style():
        fig = new_figure(8.6, 5.0)
        fig.set_layout_engine("compressed")  # Axes of equal scales, and room for their labels.
        axes = fig.subplots()
        handles = _draw_outcomes(axes, region, constraint_names)
        if region.obstacle_distance_m is not None and (region.obstacle_distance_m < 0).any():
            axes.contourf(
                region.obstacle_y_m,
                region.obstacle_z_m,
                region.obstacle_distance_m,
                levels=[-10.0, 0.0],
                colors=[INK],
                alpha=0.28,
            )
            handles.append(Patch(color=INK, alpha=0.28, label="inside an obstacle"))
        is_unknown = np.isnan(region.probability)
        if is_unknown.any():
            axes.contourf(
                region.y_m,
                region.z_m,
                is_unknown.astype(float),
                levels=[0.5, 1.5],
                colors="none",
                hatches=["////"],
            )
            label = f"Γ: don't know, {100 * is_unknown.mean():.0f} %"
            handles.append(
                Patch(facecolor="white", edgecolor=INK, linewidth=0.4, hatch="////", label=label)
            )
        # A white edge separates the line from the areas below.
        for colour, width in (("white", 5.0), (UNSAFE_COLOUR, 2.4)):
            axes.contour(
                *_closed(region.y_m, region.z_m, np.nan_to_num(region.probability)),
                levels=[region.threshold],
                colors=[colour],
                linewidths=width,
            )
        handles.append(
            Line2D([], [], color=UNSAFE_COLOUR, lw=2.4, label=f"probability {region.threshold:.2f}")
        )
        for name, is_reachable in region.is_reachable.items():
            dashes, label = _KINEMATICS[name]
            axes.contour(
                *_closed(region.y_m, region.z_m, is_reachable.astype(float)),
                levels=[0.5],
                colors=[SAFE_COLOUR],
                linewidths=2.0,
                linestyles=[dashes],
            )
            handles.append(Line2D([], [], color=SAFE_COLOUR, lw=2.0, ls=dashes, label=label))
        axes.set_aspect("equal")
        half_y, half_z = 0.5 * (y[1] - y[0]), 0.5 * (z[1] - z[0])
        axes.set_xlim(y[-1] + half_y, y[0] - half_y)
        axes.set_ylim(z[0] - half_z, z[-1] + half_z)
        axes.set_xlabel("y [m], to the robot's left")
        axes.set_ylabel("z [m]")
        axes.set_title(f"Targets at x = {region.x_m:.2f} m from the standing posture")
        fig.legend(handles=handles, loc="outside right center", title="simulated", alignment="left")
    return fig


def _closed(
    y: np.ndarray, z: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grid with a rim of zeros, so that contours close at the edge of the targets."""
    rim = 1e-6
    return (
        np.concatenate([[y[0] - rim], y, [y[-1] + rim]]),
        np.concatenate([[z[0] - rim], z, [z[-1] + rim]]),
        np.pad(values, 1),
    )


def _draw_outcomes(axes: Axes, region: ReachableRegion, constraint_names: list[str]) -> list:
    """Draws areas of the simulated outcomes; returns their legend entries."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    names = [SAFE, *constraint_names, *sorted(set(region.outcomes.ravel()))]
    names = list(dict.fromkeys(names))
    tints = [_SAFE_TINT, *(_UNSAFE_TINTS[i % len(_UNSAFE_TINTS)] for i in range(len(names) - 1))]
    codes = np.vectorize(names.index)(region.outcomes)
    axes.pcolormesh(
        region.simulated_y_m,
        region.simulated_z_m,
        codes,
        cmap=ListedColormap(tints),
        vmin=-0.5,
        vmax=len(names) - 0.5,
        shading="nearest",
        edgecolors="white",
        linewidth=0.4,
        rasterized=True,
    )
    share = {name: float(np.mean(region.outcomes == name)) for name in names}
    return [
        Patch(
            facecolor=tint,
            edgecolor=FAINT_INK,
            linewidth=0.4,
            label=f"{spoken(name)} {100 * share[name]:.0f} %",
        )
        for name, tint in zip(names, tints, strict=True)
        if share[name]
    ]
