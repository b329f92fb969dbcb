"""Animation of a run: the robot, and Γ up to the current time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.evaluation.stills import StillCamera

if TYPE_CHECKING:
    from PIL import Image

    from drake_safety.simulation.legged_loop import LeggedLoop

_WIDTH, _PICTURE_HEIGHT, _GAMMA_HEIGHT = 5.6, 3.5, 1.1  # [inches]
_DOTS_PER_INCH = 100
_FRAMES_PER_SECOND = 10.0
_COLOURS, _PALETTE_FRAMES = 127, 8


def save_animation(
    loop: LeggedLoop,
    time_s: np.ndarray,
    positions: np.ndarray,
    probability: np.ndarray,
    threshold: float,
    path: Path,
    *,
    event_times_s: Sequence[float] = (),
    frames_per_second: float = _FRAMES_PER_SECOND,
) -> Path:
    """Writes a GIF of a logged run, in real time, which says how far the robot has turned.

    Args:
        loop: The closed loop that was simulated, or one with the same plant.
        time_s: Instants of the log [s], (N,), increasing.
        positions: All of the plant's positions at these instants, (N, n_q).
        probability: As triggers or alarms take it, (N,).
        threshold: Threshold of triggers or alarms.
        path: Path of the GIF.
        event_times_s: Times of triggers or alarms, marked on the curve [s].
        frames_per_second: Frame rate.

    Returns:
        The path.

    Raises:
        ValueError: Logs have different lengths, or the frame rate is not positive.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    if not len(time_s) == len(positions) == len(probability) or len(time_s) < 2:
        raise ValueError(
            f"animation: {len(time_s)} instants, {len(positions)} positions and "
            f"{len(probability)} probabilities; expected as many of each, two at least"
        )
    if not frames_per_second > 0.0:
        raise ValueError(f"animation: frames_per_second must be positive; got {frames_per_second}")
    instants = np.arange(time_s[0], time_s[-1] + 1e-9, 1.0 / frames_per_second)
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
        axes.set_xlim(time_s[0], time_s[-1])
        axes.set_ylim(-0.05, 1.05)
        axes.set_yticks([0.0, 1.0])
        axes.set_ylabel("Γ", rotation=0, labelpad=8)
        axes.set_xlabel("time [s]", labelpad=0)
        axes.axhline(threshold, color=FAINT_INK, linewidth=1.0, linestyle=(0, (4, 3)))
        (curve,) = axes.plot([], [], color=INK, linewidth=1.6)
        (dot,) = axes.plot([], [], marker="o", markersize=7, clip_on=False)
        marks = [
            axes.axvline(event, color=UNSAFE_COLOUR, linewidth=1.2, visible=False)
            for event in event_times_s
        ]

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
            for mark, event in zip(marks, event_times_s, strict=True):
                mark.set_visible(bool(event <= time_s[row]))
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    # With a common palette, unchanged pixels are stored once.
    joined = _joined(frames[:: max(len(frames) // _PALETTE_FRAMES, 1)])
    # The median cut would drop the colour of a ball, which has few pixels.
    palette = joined.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration_ms = round(100 / frames_per_second) * 10  # GIFs count in hundredths of a second.
    first.save(path, save_all=True, append_images=others, duration=duration_ms, loop=0)
    return path


def _heading(loop: LeggedLoop, positions: np.ndarray) -> float:
    """Direction of the base's forward axis from the world's x axis [rad]."""
    w, x, y, z = loop.plant.GetPositionsFromArray(loop.robot_instance, positions)[:4]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _joined(frames: Sequence[Image.Image]) -> Image.Image:
    from PIL import Image

    return Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames]))
