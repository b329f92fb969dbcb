"""``python -m studies truth``: Γ against the true safe set, simulated on a grid of two states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated

import numpy as np
import typer
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.ndimage import distance_transform_edt

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption, say
from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.episode_study import first_segments
from drake_safety.evaluation.figure_style import (
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
    save,
)
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.shift_study import CONFIDENT
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress, map_items
from studies.harness import EpisodesOption, ReleaseOption, SeedOption, open_study

THRESHOLD = 0.5
"""Lowest Γ that is classified safe."""


def truth(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: EpisodesOption = 1000,
    resolution: Annotated[
        int, typer.Option(help="Starts simulated along either axis of a state plane.", min=2)
    ] = 41,
    seed: SeedOption = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Compare Γ of both modes with the truth on state planes and on random plans, at k = 0.

    Writes ASSESSMENT/known_truth.json and a figure for each mode.
    """
    with open_study(
        "known_truth", scenario, assessment, seed=seed, release=release, workers=workers
    ) as study:
        loop = study.scenario.make_loop()
        planes = getattr(loop, "state_planes", {})
        if not planes:
            raise ValueError(f"truth: task '{type(loop).__name__}' has no state planes")
        assessments = {mode: study.load(mode, [study.seed]) for mode in MODES}
        fresh = study.fresh(episodes)
        truths = [
            simulate_truth(
                study.scenario,
                plane,
                resolution,
                num_workers=workers,
                progress=partial(study.stages, f"truth, {plane}"),
            )
            for plane in planes
        ]
        study.entries["resolution"] = resolution
        pictures = []
        for mode, gamma in assessments.items():
            panels = []
            for one in truths:
                probability = one.safety_probability(gamma)
                found = agreement(one.is_safe, probability)
                panels.append((one, probability, found))
                shares = {"safe_share": float(one.is_safe.mean()), **asdict(found)}
                exact = {key: Estimate.exact(v, one.is_safe.size) for key, v in shares.items()}
                study.add(f"{one.plane}.{mode}", exact)
            study.add(f"random.{mode}", random_plan_estimates(gamma, fresh))
            figure = known_truth_figure(panels, f"{study.scenario.name}, {mode}")
            pictures += save(figure, assessment / f"known_truth_{mode}")
    for path in pictures:
        say("picture", path)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownTruth:
    """Outcomes of all starts on a plane, and their inputs at k = 0.

    Attributes:
        plane: Name of the plane, which is that of its plan.
        axes: Labels of the two variables.
        points: Values of the variables, (n, n, 2); the first index is that of the first variable.
        is_safe: Whether the episode stays in the safe set, (n, n).
        state, desired_preview, features: Inputs at k = 0, (n, n, size) each.
    """

    plane: str
    axes: tuple[str, str]
    points: np.ndarray
    is_safe: np.ndarray
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray

    def safety_probability(self, assessment: SafetyAssessment) -> np.ndarray:
        """Safe share of every start's belief, (n, n).

        Args:
            assessment: Γ.
        """
        rows = [
            array.reshape(-1, array.shape[-1])
            for array in (self.state, self.desired_preview, self.features)
        ]
        return safe_share(assessment.predict(*rows).belief).reshape(self.is_safe.shape)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Agreement of Γ with the truth on a plane.

    Attributes:
        threshold: Lowest Γ that is classified safe.
        intersection_over_union: Of the starts classified safe and the safe ones; 1 if both are
            empty.
        confident_errors: Share of the starts at which Γ is confident and wrong.
        band: Largest distance of such an error to the true boundary, as a share of the sides of
            the plane; 0 without errors.
    """

    threshold: float
    intersection_over_union: float
    confident_errors: float
    band: float


def simulate_truth(
    scenario: Scenario,
    plane: str,
    resolution: int,
    *,
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> KnownTruth:
    """Simulates the nominal loop from every point of a grid, in worker processes.

    Args:
        scenario: A scenario whose task has state planes.
        plane: Name of the plane.
        resolution: Number of points along each variable.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number done and the number wanted.

    Raises:
        ValueError: The task has no such plane.
    """
    make = worker_loop(scenario)
    loop = make()
    planes = getattr(loop, "state_planes", {})
    if plane not in planes:
        raise ValueError(
            f"task '{type(loop).__name__}' has no state plane '{plane}'; it has {list(planes)}"
        )
    points = planes[plane].points(resolution)
    flat = points.reshape(-1, 2)
    run = partial(make.run, _outcome, plane)
    rows = dict(map_items(run, enumerate(flat), num_workers=num_workers, progress=progress))
    columns = zip(*(rows[index] for index in range(len(flat))), strict=True)
    shape = (resolution, resolution)
    is_safe, state, preview, features = (np.array(column).reshape(*shape, -1) for column in columns)
    return KnownTruth(
        plane=plane,
        axes=planes[plane].axes,
        points=points,
        is_safe=is_safe[..., 0],
        state=state,
        desired_preview=preview,
        features=features,
    )


def _outcome(
    loop: ClosedLoop, plane: str, item: tuple[int, np.ndarray]
) -> tuple[int, tuple[bool, np.ndarray, np.ndarray, np.ndarray]]:
    index, point = item
    episode = run_episode(loop, index, start=loop.state_planes[plane].start(point))
    inputs = episode.state[0], episode.desired_preview[0], episode.features[0]
    return index, (episode.is_safe, *inputs)


def agreement(
    is_safe: np.ndarray, probability: np.ndarray, threshold: float = THRESHOLD
) -> Agreement:
    """Compares Γ with the truth on a grid.

    Args:
        is_safe: The truth, (n, m).
        probability: Γ, (n, m).
        threshold: Lowest Γ that is classified safe.

    Raises:
        ValueError: The shapes differ.
    """
    if is_safe.shape != probability.shape:
        raise ValueError(
            f"known truth: {is_safe.shape} outcomes and {probability.shape} probabilities differ"
        )
    says_safe = probability >= threshold
    union = np.count_nonzero(is_safe | says_safe)
    shared = np.count_nonzero(is_safe & says_safe)
    wrong = is_confidently_wrong(is_safe, probability)
    depth = boundary_distance(is_safe)
    return Agreement(
        threshold=threshold,
        intersection_over_union=shared / union if union else 1.0,
        confident_errors=float(wrong.mean()),
        band=float(depth[wrong].max()) if wrong.any() else 0.0,
    )


def random_plan_estimates(assessment: SafetyAssessment, episodes: Episodes) -> dict[str, Estimate]:
    """Agreement of Γ with the truth at k = 0 on random starts and plans.

    Args:
        assessment: Γ.
        episodes: Fresh episodes with the distribution of the training episodes.

    Returns:
        "safe_share", "intersection_over_union" and "confident_errors", as in `Agreement`.
    """
    first = first_segments(episodes)
    found = assessment.predict_rows(first)
    probability = safe_share(found.belief)
    is_safe, says_safe = ~first.is_unsafe, probability >= THRESHOLD
    wrong = is_confidently_wrong(is_safe, probability)
    return {
        "safe_share": proportion(int(is_safe.sum()), len(first)),
        "intersection_over_union": proportion(
            int(np.sum(is_safe & says_safe)), int(np.sum(is_safe | says_safe))
        ),
        "confident_errors": proportion(int(wrong.sum()), len(first)),
    }


def is_confidently_wrong(is_safe: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Whether Γ is confident, at `CONFIDENT` or one minus it, and wrong, element by element."""
    return np.where(is_safe, probability <= 1 - CONFIDENT, probability >= CONFIDENT)


def boundary_distance(is_safe: np.ndarray) -> np.ndarray:
    """Distance of every point of a grid to the nearest one with the other outcome.

    Args:
        is_safe: Outcomes, (n, m).

    Returns:
        Distances as shares of the sides of the grid, (n, m); infinite if all outcomes are equal.
    """
    if is_safe.all() or not is_safe.any():
        return np.full(is_safe.shape, np.inf)
    spacing = [1 / (size - 1) for size in is_safe.shape]
    inside = distance_transform_edt(is_safe, sampling=spacing)
    outside = distance_transform_edt(~is_safe, sampling=spacing)
    return np.where(is_safe, inside, outside)


def known_truth_figure(
    panels: Sequence[tuple[KnownTruth, np.ndarray, Agreement]], title: str
) -> Figure:
    """Plots one panel per plane.

    Args:
        panels: The truth, Γ at its points (n, n), and their agreement.
        title: Title of the figure.
    """
    colours = LinearSegmentedColormap.from_list("safety", [UNSAFE_COLOUR, "white", SAFE_COLOUR])
    with drawing_style():
        fig = new_figure(max(3.8 * len(panels) + 1.0, 6.4), 4.6)
        fig.suptitle(title, x=0.02, ha="left", fontsize=12, fontweight="bold", color=INK)
        all_axes = fig.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (truth, probability, found) in zip(all_axes, panels, strict=True):
            x, y = truth.points[:, 0, 0], truth.points[0, :, 1]
            image = axes.pcolormesh(
                x, y, probability.T, cmap=colours, vmin=0.0, vmax=1.0, shading="nearest", alpha=0.6
            )
            if truth.is_safe.any() and not truth.is_safe.all():
                axes.contour(x, y, truth.is_safe.T, levels=[0.5], colors=[INK], linewidths=2.0)
            if probability.min() < found.threshold < probability.max():
                axes.contour(
                    x,
                    y,
                    probability.T,
                    levels=[found.threshold],
                    colors=[SAFE_COLOUR],
                    linewidths=1.6,
                    linestyles="--",
                )
            wrong = is_confidently_wrong(truth.is_safe, probability)
            axes.plot(*truth.points[wrong].T, "x", color=INK, markersize=5)
            axes.set_xlabel(truth.axes[0])
            axes.set_title(
                f"{truth.plane}\nIoU {found.intersection_over_union:.3f}, band "
                f"{100 * found.band:.1f} %",
                fontsize=10,
            )
        all_axes[0].set_ylabel(panels[0][0].axes[1])
        fig.colorbar(image, ax=list(all_axes), label="safe share", fraction=0.03)
        handles = [
            Line2D([], [], color=INK, lw=2.0, label="true safe set, simulated"),
            Line2D(
                [],
                [],
                color=SAFE_COLOUR,
                lw=1.6,
                ls="--",
                label=f"safe share = {panels[0][2].threshold:g}",
            ),
            Line2D([], [], color=INK, marker="x", ls="", label="confident and wrong"),
        ]
        fig.legend(handles=handles, loc="outside lower center", ncols=3)
    return fig
