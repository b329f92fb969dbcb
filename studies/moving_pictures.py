"""The moving picture of README and docs: a ball without and with recovery, and Γ."""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from pydrake.geometry import Box, GeometryInstance, PerceptionProperties, Rgba
from pydrake.math import RigidTransform

from drake_safety.assessments import shipped_folder
from drake_safety.cli.training_folder import MODES, load_assessment
from drake_safety.diagrams.balancing.throws import run_throw
from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.stills import StillCamera, stack_positions
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.plants.balls import Throw
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import load_scenario

_WIDTH, _PICTURE, _CAPTION, _CURVE = 8.8, 3.7, 0.45, 1.5  # [inches]
_DOTS_PER_INCH = 100
_STEP_S, _FRAME_MS, _EVENT_MS, _END_MS = 0.06, 120, 1000, 2500  # At half of real time.
_BEFORE_S, _AFTER_S = 0.32, 0.6  # Shown before the disturbance and after the last event.
_ACTS_S = 0.12  # From the trigger until the recovery is seen.
_NUM_COLOURS = 127
_GROUND, _LINES = Rgba(0.78, 0.80, 0.83), Rgba(0.55, 0.58, 0.62)
_LINE_M, _TILE_M, _NUM_LINES = 0.012, 0.5, 33
_PORTS = ("safety_probability", "belief", "ball_state")
_OPTIONS: dict[str, Any] = {"seed": DEMONSTRATION.first, "duration_s": 3.0, "after_fall_s": 0.8}
_TURNS = np.radians([90.0, -90.0, 135.0, 45.0, -135.0, -45.0])  # From the camera's direction.
_COLOURS = (style.INK, style.UNSAFE_COLOUR, style.RECOVERY_COLOUR, style.SAFE_COLOUR)


class SceneCamera(StillCamera):
    """A camera that also draws the ground."""

    def draw_ground(self) -> None:
        """Adds a wide ground, with lines by which motions of the robot are seen."""
        context = self._scene_graph.GetMyMutableContextFromRoot(self.context)
        source, length = self._plant.get_source_id(), _NUM_LINES * _TILE_M

        def draw(sides: list[float], place: list[float], colour: Rgba, name: str) -> None:
            shown = GeometryInstance(RigidTransform(place), Box(*sides), f"shown {name}")
            properties = PerceptionProperties()
            properties.AddProperty("phong", "diffuse", colour)
            shown.set_perception_properties(properties)
            self._scene_graph.RegisterGeometry(
                context, source, self._scene_graph.world_frame_id(), shown
            )

        # Below that of the plant, which is smaller.
        draw([100.0, 100.0, 0.01], [0.0, 0.0, -0.01], _GROUND, "ground")
        for at in _TILE_M * (np.arange(_NUM_LINES) - _NUM_LINES // 2):
            draw([length, _LINE_M, 0.002], [0.0, at, 0.0], _LINES, f"line along x at {at}")
            draw([_LINE_M, length, 0.002], [at, 0.0, 0.0], _LINES, f"line along y at {at}")


class Take(NamedTuple):
    """A run, and its captions: times [s] in order, and words."""

    title: str
    motion: Motion
    captions: Sequence[tuple[float, str]]


def recovery(folder: Path) -> Path:
    """Laikago and the fastest ball of 3 kg that makes it fall without recovery only."""
    scenario = load_scenario("laikago_balancing")
    gamma = load_assessment(shipped_folder(scenario.name), MODES[0])
    options: dict[str, Any] = {"assessment": gamma, "ball": True}
    plain, guarded = (scenario.make_loop("actual", recovery=on, **options) for on in (False, True))
    slowest, fastest = scenario.parameters.push.speed_m_s
    balls = [
        Throw(time_s=0.5, mass_kg=3.0, speed_m_s=speed, direction_rad=direction)
        for direction in plain.view.azimuth_rad + _TURNS
        for speed in np.arange(fastest, slowest, -1.0).tolist()
    ]
    ball, takes = _first_saved(plain, guarded, balls)
    hit = ball.time_s, f"hit by a ball of 3 kg at {ball.speed_m_s:g} m/s"
    return save_moving_picture(guarded, takes, hit, folder / "recovery.gif")


def _first_saved(plain: Any, guarded: Any, balls: Iterable[Throw]) -> tuple[Throw, list[Take]]:
    """The first ball after which a robot falls without recovery only, and both runs."""
    threshold = guarded.scenario.parameters.recovery.threshold
    for ball in balls:
        fallen = run_throw(plain, 0, throws=[ball], ports=_PORTS, **_OPTIONS)
        is_down = fallen["margins"][-1, plain.constraint_names.index(plain.fall_name)] < 0.0
        if not is_down:  # It may have got up again.
            continue
        saved = run_throw(guarded, 0, throws=[ball], ports=_PORTS, **_OPTIONS)
        is_one = len(saved.recovery_intervals_s) == 1
        if saved.has_fallen or saved["violations"].any() or not is_one:
            continue
        ((start_s, end_s),) = saved.recovery_intervals_s
        belief = saved["belief"][np.abs(saved.time_s - start_s).argmin()]
        is_lost = is_unknown(belief, guarded.assessment.parameters.initial_uncertainty)
        why = "don't know" if is_lost else f"probability below {threshold:g}"
        acts = start_s + _ACTS_S, "steps until it stands"
        told = [(start_s, f"{why}: recovery"), acts, (end_s, "stands")]
        falls = Take("without recovery", fallen, [(fallen.fall_time_s, "falls")])
        return ball, [falls, Take("with recovery", saved, told)]
    raise ValueError(f"no ball at '{guarded.scenario.name}' calls for recovery")


def save_moving_picture(
    loop: LeggedLoop,
    takes: Sequence[Take],
    hit: tuple[float, str],
    path: Path,
) -> Path:
    """Writes a GIF of runs side by side, with the probability of the last one below."""
    takes = [one._replace(captions=[hit, *one.captions]) for one in takes]
    stops = sorted({round(time_s, 2) for one in takes for time_s, _ in one.captions})
    begin_s = max(hit[0] - _BEFORE_S, 0.0)
    end_s = min(max(stops) + _AFTER_S, max(one.motion.time_s[-1] for one in takes))
    instants = sorted({*stops, *np.arange(begin_s, end_s, _STEP_S).round(2).tolist()})
    durations = [_EVENT_MS if instant in stops else _FRAME_MS for instant in instants]
    height, share = _PICTURE + _CAPTION + _CURVE, 1.0 / len(takes)
    with style.drawing_style():
        fig = style.new_figure(_WIDTH, height)
        fig.set_dpi(_DOTS_PER_INCH)
        fig.set_layout_engine("none")
        canvas, frames = FigureCanvasAgg(fig), []
        place = 1.0 - _PICTURE / height, share - 0.004, _PICTURE / height
        updates = [
            _draw_scene(fig.add_axes((i * share, *place)), loop, one) for i, one in enumerate(takes)
        ]
        curve = fig.add_axes((0.04, 0.42 / height, 0.82, (_CURVE - 0.75) / height))
        curve.set_xlim(begin_s, end_s)
        threshold = loop.scenario.parameters.recovery.threshold
        updates.append(_draw_curve(curve, takes[-1], threshold))
        for instant in instants:
            for update in updates:
                update(instant)
            canvas.draw()
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    # With a common palette, unchanged pixels are stored once.
    joined = Image.fromarray(np.concatenate([frames[instants.index(stop)] for stop in stops]))
    # The median cut would drop the colour of a ball, which has few pixels.
    palette = joined.quantize(_NUM_COLOURS, method=Image.Quantize.FASTOCTREE)
    first, *others = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    durations[-1] = _END_MS
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)
    return path


def _draw_scene(axes: Any, loop: LeggedLoop, take: Take) -> Callable[[float], None]:
    """Prepares the picture of a run, with captions below; returns what draws an instant [s]."""
    motion = take.motion
    states = {loop.robot.name: motion["plant_state"], "ball": motion["ball_state"]}
    positions = stack_positions(loop, states)
    width, height = (round(size * _DOTS_PER_INCH) for size in (_WIDTH / 2, _PICTURE))
    camera = SceneCamera(loop, positions[0], width=width, height=height)
    camera.draw_ground()
    axes.set_axis_off()
    render = lru_cache(1)(lambda row: camera.render(positions[row]))  # The last row may stay.
    picture = axes.imshow(render(0))
    place: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "weight": "bold"}
    axes.text(0.5, 0.97, take.title, va="top", fontsize=13, **place)
    words = axes.text(0.5, -0.03, "", va="top", fontsize=12.5, **place)

    def update(instant: float) -> None:
        picture.set_data(render(int(np.abs(motion.time_s - instant).argmin())))
        count = sum(time_s <= instant + 0.01 for time_s, _ in take.captions)
        words.set_text(take.captions[count - 1][1] if count else "")
        words.set_color(_COLOURS[count - 1])

    return update


def _draw_curve(axes: Any, take: Take, threshold: float) -> Callable[[float], None]:
    """Prepares the curve of the probability; returns what draws it until an instant [s]."""
    time_s, probability = take.motion.time_s, take.motion["safety_probability"][:, 0]
    axes.set(ylim=(-0.06, 1.06), yticks=[0.0, 1.0])
    axes.set_title("probability of staying safe, with recovery", fontsize=10.5)
    axes.set_xlabel("time [s]", labelpad=0)
    style.draw_threshold(axes, threshold, style.UNSAFE_COLOUR)
    (curve,) = axes.step([], [], where="post", color=style.SAFE_COLOUR, linewidth=2.2)
    (dot,) = axes.plot([], [], marker="o", markersize=8, clip_on=False)

    def update(instant: float) -> None:
        until = int(np.searchsorted(time_s, instant + 1e-9))
        curve.set_data(time_s[:until], probability[:until])
        dot.set_data(time_s[until - 1 : until], probability[until - 1 : until])
        is_safe = probability[until - 1] >= threshold
        dot.set_color(style.SAFE_COLOUR if is_safe else style.UNSAFE_COLOUR)

    return update
