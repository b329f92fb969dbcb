"""The reachable region on a vertical plane by Γ, by inverse kinematics and by simulation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

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
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.planning.goal_verdict import goal_inputs
from drake_safety.simulation.capabilities import HasGoals, fair_box, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario
from studies.reachability import BASELINES, Reachability

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SAFE = "safe"
_REFINEMENT = 4  # Γ and kinematics have so many points per simulated one along each axis.
_EDGE_STEP_M = 0.01  # Spacing of the grid of obstacle distances.
_MAX_DISTANCE_M = 0.05  # Obstacle distances saturate here.
_REPORT_EVERY = 50
_SAFE_TINT = "#bcd3ec"
_UNSAFE_TINTS = ("#f6d3c2", "#f3e2b3", "#e3d2ec", "#d9d9d9", "#f2c4d6", "#cfe3d4")
_KINEMATICS = {
    "reachability": ((0, (4, 2)), "inverse kinematics, fixed base"),
    "reachability_free": ((0, (1, 1.5)), "inverse kinematics, free base"),
}


@dataclass(frozen=True, kw_only=True)
class ReachableRegion:
    """The targets on a plane x = const of a robot in its standing posture.

    Attributes:
        x_m: Position of the plane in the world [m].
        y_m, z_m: The fine grid, (n_y,), (n_z,) [m].
        probability: Probability there, (n_z, n_y); NaN for "don't know".
        threshold: Lowest probability of an accepted target.
        is_reachable: Whether inverse kinematics reaches each point, by the names of `BASELINES`,
            (n_z, n_y); empty for a task without a hand.
        obstacle_y_m, obstacle_z_m: The grid of obstacle distances, (o_y,), (o_z,) [m].
        obstacle_distance_m: Signed distance to the nearest obstacle, at most 5 cm, (o_z, o_y) [m].
        simulated_y_m, simulated_z_m: The grid of simulated targets, (m_y,), (m_z,) [m].
        outcomes: `SAFE` or the cause, (m_z, m_y).
    """

    x_m: float
    y_m: np.ndarray
    z_m: np.ndarray
    probability: np.ndarray
    threshold: float
    is_reachable: dict[str, np.ndarray]
    obstacle_y_m: np.ndarray
    obstacle_z_m: np.ndarray
    obstacle_distance_m: np.ndarray
    simulated_y_m: np.ndarray
    simulated_z_m: np.ndarray
    outcomes: np.ndarray


def reachable_region(
    scenario: Scenario,
    assessment: SafetyAssessment,
    progress: StageProgress,
    *,
    threshold: float,
    x_m: float | None = None,
    step_m: float = 0.1,
    num_workers: int | None = None,
) -> ReachableRegion:
    """Evaluates Γ and inverse kinematics on a plane of the target box, and simulates it.

    Args:
        scenario: A scenario of a task whose goals are points.
        assessment: Γ.
        progress: Called with a stage, the number done and the number wanted.
        threshold: Lowest probability of an accepted target.
        x_m: Position of the plane [m]; the middle of the fair box by default.
        step_m: Spacing of the simulated targets [m].
        num_workers: Number of worker processes.
    """
    loop = scenario.make_loop()
    with_goals = require(loop, HasGoals)
    x_m = float(fair_box(with_goals)[:, 0].mean()) if x_m is None else x_m
    box = with_goals.target_box[:, 1:]
    coarse = [np.linspace(low, high, round((high - low) / step_m) + 1) for low, high in box.T]
    fine = [
        np.linspace(nodes[0], nodes[-1], _REFINEMENT * (len(nodes) - 1) + 1) for nodes in coarse
    ]
    targets = _targets(x_m, *coarse)
    episodes = run_episodes(
        scenario,
        len(targets),
        num_workers=num_workers,
        goals=targets,
        is_standing=True,
        progress=partial(progress, "targets of the plane"),
    )
    outcomes = np.array([SAFE if episode.is_safe else episode.cause for episode in episodes])

    targets = _targets(x_m, *fine)
    reachability = {}
    if isinstance(loop, LeggedLoop) and with_goals.hand is not None:
        for name, is_base_free in BASELINES.items():
            one = Reachability(loop.robot, with_goals.hand, is_base_free=is_base_free)
            reachability[name] = one
    scorer = assessment_scorer("sharpened", assessment)
    probabilities = []
    reachable: dict[str, list[np.ndarray]] = {name: [] for name in reachability}
    for start in range(0, len(targets), _REPORT_EVERY):
        progress("verdicts on the plane", start, len(targets))
        chunk = targets[start : start + _REPORT_EVERY]
        probabilities.append(scorer.probability(*goal_inputs(loop, chunk)))
        for name, kinematics in reachability.items():
            reachable[name].append(kinematics.is_reachable(chunk))
    progress("verdicts on the plane", len(targets), len(targets))
    shape = (len(fine[1]), len(fine[0]))
    edge = [np.arange(low, high + 0.5 * _EDGE_STEP_M, _EDGE_STEP_M) for low, high in box.T]
    return ReachableRegion(
        x_m=x_m,
        y_m=fine[0],
        z_m=fine[1],
        probability=np.concatenate(probabilities).reshape(shape),
        threshold=threshold,
        is_reachable={name: np.concatenate(one).reshape(shape) for name, one in reachable.items()},
        obstacle_y_m=edge[0],
        obstacle_z_m=edge[1],
        obstacle_distance_m=_obstacle_distance(loop, _targets(x_m, *edge)).reshape(
            len(edge[1]), -1
        ),
        simulated_y_m=coarse[0],
        simulated_z_m=coarse[1],
        outcomes=outcomes.reshape(len(coarse[1]), len(coarse[0])),
    )


def _targets(x_m: float, y_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """The points of a grid, y changing fastest, (n_z n_y, 3) [m]."""
    z, y = np.meshgrid(z_m, y_m, indexing="ij")
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()])


def _obstacle_distance(loop: ClosedLoop, points: np.ndarray) -> np.ndarray:
    """Signed distance of points (N, 3) to obstacles, at most `_MAX_DISTANCE_M`, (N,) [m]."""
    distance = np.full(len(points), _MAX_DISTANCE_M)
    if not isinstance(loop, LeggedLoop):
        return distance
    plant, robot, scene_graph = loop.plant, loop.robot_instance, loop.scene_graph
    context = scene_graph.GetMyContextFromRoot(loop.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    inspector = query.inspector()
    for i, point in enumerate(points):
        for found in query.ComputeSignedDistanceToPoint(point, _MAX_DISTANCE_M):
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(found.id_G))
            if body.model_instance() != robot:
                distance[i] = min(distance[i], found.distance)
    return distance


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
        if (region.obstacle_distance_m < 0).any():
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
            of = (region.y_m, region.z_m, is_unknown.astype(float))
            axes.contourf(*of, levels=[0.5, 1.5], colors="none", hatches=["////"])
            label = f"Γ: don't know, {100 * is_unknown.mean():.0f} %"
            handles.append(
                Patch(facecolor="white", edgecolor=INK, linewidth=0.4, hatch="////", label=label)
            )
        gamma = np.nan_to_num(region.probability)
        label = f"probability {region.threshold:.2f}"
        # A white edge separates the line from the areas below.
        lines: list[tuple[str, float, Any, np.ndarray, float, str]]
        lines = [("white", 5.0, "-", gamma, region.threshold, "")]
        lines.append((UNSAFE_COLOUR, 2.4, "-", gamma, region.threshold, label))
        for name, is_reachable in region.is_reachable.items():
            style, words = _KINEMATICS[name]
            lines.append((SAFE_COLOUR, 2.0, style, is_reachable.astype(float), 0.5, words))
        for colour, width, dashes, values, level, label in lines:
            axes.contour(
                *_closed(region.y_m, region.z_m, values),
                levels=[level],
                colors=[colour],
                linewidths=width,
                linestyles=[dashes],
            )
            if label:
                handles.append(Line2D([], [], color=colour, lw=width, ls=dashes, label=label))
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

    names = list(dict.fromkeys([SAFE, *constraint_names, *sorted(set(region.outcomes.ravel()))]))
    tints = [_SAFE_TINT, *(_UNSAFE_TINTS[i % len(_UNSAFE_TINTS)] for i in range(len(names) - 1))]
    axes.pcolormesh(
        region.simulated_y_m,
        region.simulated_z_m,
        np.vectorize(names.index)(region.outcomes),
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
