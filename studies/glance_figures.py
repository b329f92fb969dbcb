"""The method in one picture, and its block diagram."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from drake_safety.assessments import load_assessment
from drake_safety.diagrams.balancing.throws import run_throw
from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.embedding_figure import draw_bar, draw_values
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.learning.segments import split
from drake_safety.plants.balls import Throw
from drake_safety.simulation.rollouts import inputs_at, run_episodes
from drake_safety.simulation.scenario import Scenario, load_scenario

_EPISODES, _LINES = 120, 40
_BALL = Throw(time_s=0.8, mass_kg=3.0, speed_m_s=9.0, direction_rad=-1.2)
_MASSES = "safe", "unsafe", "don't know"
_COLOURS = style.SAFE_COLOUR, style.UNSAFE_COLOUR, style.UNKNOWN_COLOUR


def glance(folder: Path) -> Figure:
    """Laikago's episodes, their segments in the plane, beliefs of the cells, and three verdicts."""
    scenario, gamma = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    episodes = run_episodes(scenario, _EPISODES, seed=DEMONSTRATION.first)
    with style.drawing_style():
        fig = style.new_figure(style.PAGE_WIDTH, 4.8)
        rollouts, plane, grid, verdicts = fig.subplots(2, 2).ravel()
        for episode in episodes[:_LINES]:
            margin = episode.margins.min(axis=1)
            colour = _COLOURS[not episode.is_safe]
            rollouts.plot(episode.time_s, margin, color=colour, linewidth=0.9, alpha=0.7)
        rollouts.axhline(0.0, color=style.INK, linewidth=0.8)
        rollouts.set(title="1  Simulated episodes", xlabel="time [s]", ylabel="smallest margin")
        rollouts.set_ylim(-0.02, 0.105)
        segments = split(episodes, stride=5, discount=gamma.parameters.discount)
        inputs = segments.state, segments.desired_preview, segments.features
        x, y = gamma.predict(*inputs).embedding.T
        colours = np.where(segments.score > 0.0, style.UNSAFE_COLOUR, style.SAFE_COLOUR)
        order = np.random.default_rng(0).permutation(len(x))
        plane.scatter(x[order], y[order], c=colours[order], s=5.0, linewidths=0.0, alpha=0.7)
        half = gamma.grid_.half_width
        plane.set(title="2  Segments in a plane", xticks=[], yticks=[], aspect="equal")
        plane.set_xlabel("by Ψ: alike means close")
        cells = gamma.beliefs_[0]
        is_empty, most = cells[:, UNCERTAINTY] >= 1.0, 1.0 - gamma.parameters.initial_uncertainty
        draw_values(grid, gamma.grid_, cells[:, SAFE], is_empty, most)
        draw_bar(fig, grid, "belief: safe", most)
        grid.set(title="3  Beliefs on a grid", xlabel="hatched: don't know")
        for axes in (plane, grid):
            axes.set(xlim=(-half, half), ylim=(-0.6 * half, 0.6 * half))
        _draw_verdicts(verdicts, scenario, gamma)
    return fig


def _draw_verdicts(axes: Axes, scenario: Scenario, gamma: SafetyAssessment) -> None:
    """Draws the belief before and after a ball, and of a lifted robot."""
    loop = scenario.make_loop("actual", assessment=gamma, ball=True, recovery=False)
    start = loop.standing_start()
    lifted = start.q.copy()
    lifted[6] += 0.3
    ports = ("belief", "safety_probability")
    motion = run_throw(loop, 0, throws=[_BALL], seed=0, duration_s=1.0, ports=ports)
    found = gamma.predict_one(*inputs_at(loop, replace(start, q=lifted)))
    shown = {"lifted by 0.3 m": (found.belief, float(found.probability))}
    for name, at_s in {"just after the ball": 0.05, "before a ball": -0.05}.items():
        row = int(np.abs(motion.time_s - _BALL.time_s - at_s).argmin())
        shown[name] = motion["belief"][row], motion["safety_probability"][row, 0]
    for row, (name, (belief, probability)) in enumerate(reversed(shown.items())):
        left = 0.0
        for mass, colour in zip(belief, _COLOURS, strict=True):
            axes.barh(row, mass, left=left, color=colour, height=0.5)
            left += mass
        text = f"{name}: probability {probability:.2f}"
        axes.annotate(text, (0.0, row - 0.36), fontsize=9.5)
    for k, (word, colour) in enumerate(zip(_MASSES, _COLOURS, strict=True)):
        axes.annotate(word, (0.36 * k, 2.75), color=style.INK, fontsize=9.5)
        axes.barh(2.7, 0.03, left=0.36 * k - 0.045, color=colour, height=0.12)
    axes.set(xlim=(-0.05, 1.0), ylim=(2.95, -0.6))
    axes.set_axis_off()
    axes.set_title("4  Γ of a state and a plan")


def blocks(folder: Path) -> Figure:
    """The block diagram of a loop with Γ."""
    boxes = {
        (0.0, 0.0): ("planner", "white"),
        (3.3, 0.0): ("recovery switch,\ncontroller or policy", "white"),
        (6.6, 0.0): ("plant\n(Drake or MuJoCo)", "white"),
        (3.3, 1.3): ("Γ: SafetyAssessor\nbelief, probability, cause", "#e6eef8"),
        (6.6, 1.3): ("monitor\nchanged plant or sensor?", "#e6eef8"),
    }
    arrows = {
        "plan": ((2.2, 0.35), (3.3, 0.35), (2.75, 0.42)),
        "command": ((5.5, 0.35), (6.6, 0.35), (6.05, 0.42)),
        "next H samples": ((1.1, 0.7), (3.3, 1.5), (1.75, 1.25)),
        "step, stop,\nor refuse": ((4.4, 1.3), (4.4, 0.7), (3.85, 0.9)),
        "state": ((7.0, 0.7), (5.5, 1.4), (6.0, 0.9)),
        "states": ((7.9, 0.7), (7.9, 1.3), (8.25, 0.95)),
        "alarm": ((6.6, 1.8), (5.5, 1.8), (6.05, 1.87)),
    }
    with style.drawing_style():
        fig = style.new_figure(9.4, 2.6)
        axes = fig.subplots()
        for (x, y), (text, colour) in boxes.items():
            look: dict[str, Any] = {"boxstyle": "round,pad=0.0", "fc": colour, "ec": style.INK}
            axes.add_patch(FancyBboxPatch((x, y), 2.2, 0.7, lw=1.0, **look))
            axes.annotate(text, (x + 1.1, y + 0.35), ha="center", va="center", fontsize=10)
        for text, (begin, end, place) in arrows.items():
            arrow = {"arrowstyle": "-|>", "color": style.INK, "linewidth": 1.2, "shrinkA": 0}
            axes.annotate("", end, begin, arrowprops=arrow)
            axes.annotate(text, place, fontsize=9, color=style.FAINT_INK, ha="center")
        axes.set(xlim=(-0.1, 8.9), ylim=(-0.1, 2.1), aspect="equal")
        axes.set_axis_off()
    return fig
