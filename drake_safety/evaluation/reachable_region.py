"""The reachable region on a vertical plane by Γ, by inverse kinematics and by simulation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.plan_study import SAFE
from drake_safety.evaluation.reachability import BASELINES, Reachability
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.planning.goal_verdict import goal_inputs
from drake_safety.simulation.capabilities import HasGoals, fair_box, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario

_REFINEMENT = 4  # Γ and kinematics have so many points per simulated one along each axis.
_EDGE_STEP_M = 0.01  # Spacing of the grid of obstacle distances.
_MAX_DISTANCE_M = 0.05  # Obstacle distances saturate here.
_REPORT_EVERY = 50


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
        obstacle_distance_m: Signed distance to the nearest obstacle, at most 5 cm, (o_z, o_y) [m];
            None for a diagram without geometry.
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
    obstacle_distance_m: np.ndarray | None
    simulated_y_m: np.ndarray
    simulated_z_m: np.ndarray
    outcomes: np.ndarray

    def estimates(self) -> dict[str, Estimate]:
        """Shares of correct verdicts on the simulated grid.

        Returns:
            `share_safe`, `sharpened.right`, and `NAME.right` for the names of `BASELINES`. Points
            of a grid are not a random sample: the intervals only indicate their number.
        """
        is_safe = self.outcomes == SAFE
        verdicts = {"sharpened": self.probability >= self.threshold, **self.is_reachable}
        estimates = {"share_safe": proportion(int(is_safe.sum()), is_safe.size)}
        for name, verdict in verdicts.items():
            on_grid = verdict[::_REFINEMENT, ::_REFINEMENT]
            estimates[f"{name}.right"] = proportion(int((on_grid == is_safe).sum()), is_safe.size)
        return estimates


def reachable_region(
    scenario: Scenario,
    assessment: SafetyAssessment,
    *,
    threshold: float,
    x_m: float | None = None,
    step_m: float = 0.1,
    variation: str = "nominal",
    num_workers: int | None = None,
    progress: StageProgress | bool | None = None,
) -> ReachableRegion:
    """Evaluates Γ and inverse kinematics on a plane of the target box, and simulates it.

    Args:
        scenario: A scenario of a task whose plans have a goal.
        assessment: Γ.
        threshold: Lowest probability of an accepted target.
        x_m: Position of the plane [m]; the middle of the fair box by default.
        step_m: Spacing of the simulated targets [m].
        variation: Variation of the plant.
        num_workers: Number of worker processes.
        progress: Called with a stage, the number done and the number wanted; True shows it.

    Raises:
        ValueError: The task's plans have no goal, the plane misses the target box, or the step is
            not positive or too large for two targets a side.
    """
    loop = scenario.make_loop(variation)
    x_m, box = plane_of(loop, x_m, step_m)
    coarse = [np.linspace(low, high, round((high - low) / step_m) + 1) for low, high in box.T]
    fine = [
        np.linspace(nodes[0], nodes[-1], _REFINEMENT * (len(nodes) - 1) + 1) for nodes in coarse
    ]

    targets = _targets(x_m, *coarse)
    with shown(progress, lambda stages: stages) as report:
        episodes = run_episodes(
            scenario,
            len(targets),
            variation=variation,
            num_workers=num_workers,
            goals=targets,
            is_standing=True,
            progress=None if report is None else partial(report, "targets of the plane"),
        )
        outcomes = np.array([SAFE if episode.is_safe else episode.cause for episode in episodes])

        targets = _targets(x_m, *fine)
        reachability = {}
        if isinstance(loop, LeggedLoop) and isinstance(loop, HasGoals) and loop.hand is not None:
            for name, is_base_free in BASELINES.items():
                reachability[name] = Reachability(loop.robot, loop.hand, is_base_free=is_base_free)
        scorer = assessment_scorer("sharpened", assessment)
        probabilities = []
        reachable: dict[str, list[np.ndarray]] = {name: [] for name in reachability}
        for start in range(0, len(targets), _REPORT_EVERY):
            if report is not None:
                report("verdicts on the plane", start, len(targets))
            chunk = targets[start : start + _REPORT_EVERY]
            probabilities.append(scorer.probability(*goal_inputs(loop, chunk)))
            for name, kinematics in reachability.items():
                reachable[name].append(kinematics.is_reachable(chunk))
        if report is not None:
            report("verdicts on the plane", len(targets), len(targets))
    shape = (len(fine[1]), len(fine[0]))
    edge = [np.arange(low, high + 0.5 * _EDGE_STEP_M, _EDGE_STEP_M) for low, high in box.T]
    distance = _obstacle_distance(loop, loop.CreateDefaultContext(), _targets(x_m, *edge))
    return ReachableRegion(
        x_m=x_m,
        y_m=fine[0],
        z_m=fine[1],
        probability=np.concatenate(probabilities).reshape(shape),
        threshold=threshold,
        is_reachable={name: np.concatenate(one).reshape(shape) for name, one in reachable.items()},
        obstacle_y_m=edge[0],
        obstacle_z_m=edge[1],
        obstacle_distance_m=None if distance is None else distance.reshape(len(edge[1]), -1),
        simulated_y_m=coarse[0],
        simulated_z_m=coarse[1],
        outcomes=outcomes.reshape(len(coarse[1]), len(coarse[0])),
    )


def plane_of(loop: ClosedLoop, x_m: float | None, step_m: float) -> tuple[float, np.ndarray]:
    """Position of a plane, and its intersection with the target box.

    Args:
        loop: The closed loop.
        x_m: Requested position [m]; None for the middle of the fair box.
        step_m: Spacing of the targets [m].

    Returns:
        Its x [m], and the lowest and highest corner (y, z) of the targets on it, (2, 2) [m].

    Raises:
        ValueError: As :func:`reachable_region`.
    """
    with_goals = require(loop, HasGoals, "reachable region")
    box, fair = with_goals.target_box, fair_box(with_goals)
    x_m = float(fair[:, 0].mean()) if x_m is None else x_m
    if not box[0, 0] <= x_m <= box[1, 0]:
        raise ValueError(
            f"reachable region: the plane x = {x_m:g} m misses the target box, "
            f"{box[0, 0]:g}..{box[1, 0]:g} m"
        )
    sides = box[1, 1:] - box[0, 1:]
    if not 0 < step_m <= sides.min():
        raise ValueError(
            "reachable region: the step must be positive and no longer than the target box's "
            f"sides, {sides} m; got {step_m:g}"
        )
    return x_m, box[:, 1:]


def _targets(x_m: float, y_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """The points of a grid, y changing fastest, (n_z n_y, 3) [m]."""
    z, y = np.meshgrid(z_m, y_m, indexing="ij")
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()])


def _obstacle_distance(loop: ClosedLoop, context: Context, points: np.ndarray) -> np.ndarray | None:
    """Signed distance of points (N, 3) to obstacles, at most `_MAX_DISTANCE_M`, (N,) [m]."""
    if not isinstance(loop, LeggedLoop):
        return None
    plant, robot, scene_graph = loop.plant, loop.robot_instance, loop.scene_graph
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()
    distance = np.full(len(points), _MAX_DISTANCE_M)
    for i, point in enumerate(points):
        for found in query.ComputeSignedDistanceToPoint(point, _MAX_DISTANCE_M):
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(found.id_G))
            if body.model_instance() != robot:
                distance[i] = min(distance[i], found.distance)
    return distance
