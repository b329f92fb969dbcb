"""``python -m studies animation``: a GIF of a run: the robot, and the probability below it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from PIL import Image

from drake_safety.cli.ask import parse_target
from drake_safety.cli.console import AssessmentOption, ScenarioArgument, TargetOption, say
from drake_safety.cli.run import alarm_times, motion_threshold, named_push, parse_pushes
from drake_safety.cli.training_folder import (
    MODES,
    assessment_folder,
    goal_threshold,
    load_assessment,
)
from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.evaluation.stills import StillCamera, stack_positions
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.simulation.rollouts import run_to_goal
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.throws import run_throw

if TYPE_CHECKING:
    from drake_safety.simulation.legged_loop import LeggedLoop

_WIDTH, _PICTURE_HEIGHT, _GAMMA_HEIGHT = 5.6, 3.5, 1.1  # [inches]
_DOTS_PER_INCH = 100
_FRAMES_PER_SECOND = 10
_PORT = "safety_probability"
_COLOURS, _PALETTE_FRAMES = 127, 8


def animation(
    scenario: ScenarioArgument,
    out: Annotated[Path, typer.Option(help="The GIF.")],
    assessment: AssessmentOption = None,
    target: TargetOption = None,
    push: Annotated[list[str] | None, typer.Option(help="As those of `run`.")] = None,
    duration: Annotated[float, typer.Option(help="Seconds to simulate.")] = 5.0,
    variation: Annotated[str, typer.Option(help="Variation of the plant.")] = "actual",
    seed: Annotated[int, typer.Option(help="Seed of start and noise.")] = DEMONSTRATION.first,
) -> None:
    """Write a GIF of a run with balls, or of a motion to a target."""
    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, assessment).path
    gamma = load_assessment(folder, MODES[0])
    options: dict[str, Any] = {"seed": seed, "duration_s": duration}
    if target is None:
        loop = loaded.make_loop(variation, assessment=gamma, ball=True)
        throws = parse_pushes(loaded, push or [])
        log = run_throw(loop, 0, throws=throws, ports=(_PORT, "ball_state"), **options)
        states = {loop.robot.name: log["plant_state"], "ball": log["ball_state"]}
        threshold = loaded.parameters.recovery.threshold
        events = [start for start, _ in log.recovery_intervals_s]
    else:
        loop = loaded.make_loop(variation, assessment=gamma)
        goal, pushed = parse_target(loop, target), named_push(loop, push or [])
        log = run_to_goal(loop, goal, push=pushed, ports=(_PORT,), **options)
        states = {loop.robot.name: log["plant_state"]}
        threshold, _ = motion_threshold(gamma, goal_threshold(folder, gamma))
        events = alarm_times(log, threshold)
    probability, positions = log[_PORT][:, 0], stack_positions(loop, states)
    save_animation(loop, log.time_s, positions, probability, threshold, out, events)
    say("animation", out)


def save_animation(
    loop: LeggedLoop,
    time_s: np.ndarray,
    positions: np.ndarray,
    probability: np.ndarray,
    threshold: float,
    path: Path,
    event_times_s: Sequence[float],
) -> None:
    """Writes a GIF of a logged run, in real time, which says how far the robot has turned.

    Args:
        loop: The closed loop that was simulated, or one with the same plant.
        time_s: Instants of the log [s], (N,), increasing.
        positions: All of the plant's positions at these instants, (N, n_q).
        probability: As triggers or alarms take it, (N,).
        threshold: Threshold of triggers or alarms.
        path: Path of the GIF.
        event_times_s: Times of triggers or alarms, marked on the curve [s].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    instants = np.arange(time_s[0], time_s[-1] + 1e-9, 1.0 / _FRAMES_PER_SECOND)
    rows = np.abs(time_s[:, None] - instants).argmin(axis=0)
    width, height = (round(size * _DOTS_PER_INCH) for size in (_WIDTH, _PICTURE_HEIGHT))
    camera = StillCamera(loop, positions[0], width=width, height=height)
    with drawing_style():
        fig = new_figure(_WIDTH, _PICTURE_HEIGHT + _GAMMA_HEIGHT)
        fig.set_dpi(_DOTS_PER_INCH)
        canvas = FigureCanvasAgg(fig)
        fig.set_layout_engine("none")
        share = _GAMMA_HEIGHT / (_PICTURE_HEIGHT + _GAMMA_HEIGHT)
        picture_axes = fig.add_axes((0.0, share, 1.0, 1.0 - share))
        picture_axes.set_axis_off()
        picture = picture_axes.imshow(camera.render(positions[0]))
        # The ground has no marks by which a turn of the robot could be told from one of the camera.
        words = picture_axes.text(0.02, 0.95, "", transform=picture_axes.transAxes, va="top")
        axes = fig.add_axes((0.09, 0.34 * share, 0.88, 0.58 * share))
        axes.set(xlim=(time_s[0], time_s[-1]), ylim=(-0.05, 1.05), yticks=[0.0, 1.0])
        axes.set_ylabel("probability", fontsize=8)
        axes.set_xlabel("time [s]", labelpad=0)
        axes.axhline(threshold, color=FAINT_INK, linewidth=1.0, linestyle=(0, (4, 3)))
        (curve,) = axes.plot([], [], color=INK, linewidth=1.6)
        (dot,) = axes.plot([], [], marker="o", markersize=7, clip_on=False)
        marks = [(event, axes.axvline(event, color=UNSAFE_COLOUR)) for event in event_times_s]
        heading = _heading(loop, positions[0])
        frames = []
        for row in rows:
            picture.set_data(camera.render(positions[row]))
            turn = math.remainder(_heading(loop, positions[row]) - heading, 2.0 * math.pi)
            words.set_text(
                f"the camera does not turn; the robot turned by {round(math.degrees(turn))}°"
            )
            curve.set_data(time_s[: row + 1], probability[: row + 1])
            dot.set_data([time_s[row]], [probability[row]])
            dot.set_color(SAFE_COLOUR if probability[row] >= threshold else UNSAFE_COLOUR)
            for event, mark in marks:
                mark.set_visible(bool(event <= time_s[row]))
            canvas.draw()
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    # With a common palette, unchanged pixels are stored once.
    joined = Image.fromarray(np.concatenate(frames[:: max(len(frames) // _PALETTE_FRAMES, 1)]))
    # The median cut would drop the colour of a ball, which has few pixels.
    palette = joined.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE)
    first, *others = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    duration_ms = 1000 // _FRAMES_PER_SECOND
    first.save(path, save_all=True, append_images=others, duration=duration_ms, loop=0)


def _heading(loop: LeggedLoop, positions: np.ndarray) -> float:
    """Direction of the base's forward axis from the world's x axis [rad]."""
    w, x, y, z = loop.plant.GetPositionsFromArray(loop.robot_instance, positions)[:4]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
