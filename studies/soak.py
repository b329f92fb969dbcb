"""``python -m studies soak``: memory over hours of throws, recovery and adaptation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import DiagramBuilder, EventStatus

from drake_safety.cli.console import ScenarioArgument, console, open_stages, print_path
from drake_safety.evaluation.figure_style import SAFE_COLOUR, drawing_style, new_figure, save
from drake_safety.simulation.capabilities import CanFall, HasBall, require
from drake_safety.simulation.feedback import AddFeedbackRecorder
from drake_safety.simulation.online_adaptation import OnlineAdaptation
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.simulation.scenario import load_scenario
from studies import command_line

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BETWEEN_S, _LEAD_S = (3.0, 7.0), 0.1  # Between throws; from release to impact.
_WARM_UP_S = 600.0
_FALLEN = SimulatorStatus.ReturnReason.kReachedTerminationCondition


def soak(
    scenario: ScenarioArgument = "laikago_balancing",
    hours: Annotated[float, typer.Option(help="Simulated time [h].", min=0.01)] = 2.0,
    variation: Annotated[str, typer.Option(help="The plant.")] = "actual",
    out: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("runs/soak"),
    seed: Annotated[int, typer.Option(help="Seed of the throws.")] = 0,
) -> None:
    """Throw balls at a robot with assessor, recovery, recorder and adaptation; watch the memory.

    The robot is set up again when it has fallen. The memory is that of this process, every ten
    simulated seconds; its growth counts from ten minutes on.
    """
    from drake_safety import load_assessment

    loaded = load_scenario(scenario)
    prior = load_assessment(loaded.name)
    builder = DiagramBuilder()
    loop = builder.AddSystem(
        loaded.make_loop(variation, assessment=prior, recovery=True, ball=True)
    )
    recorder = AddFeedbackRecorder(builder, loop)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    assessor = loop.GetSubsystemByName("safety_assessor")
    adaptation = OnlineAdaptation(loaded, prior, recorder, assessor)
    thrower, fall_name = require(loop, HasBall), require(loop, CanFall).fall_name
    fall_column = loop.constraint_names.index(fall_name)
    margins, own = loop.GetOutputPort("margins"), loop.GetMyContextFromRoot(root)
    num_falls = num_throws = 0

    def watch(context: object) -> EventStatus:
        if margins.Eval(own)[fall_column] < 0.0:
            return EventStatus.ReachedTermination(loop, "fallen")
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    rng = np.random.default_rng(seed)
    done_s, wanted_s = 0.0, 3600.0 * hours
    samples: list[tuple[float, float]] = []
    with open_stages() as stages:
        while done_s < wanted_s:
            loop.reset(root, episode_rng(seed, num_falls))
            simulator.Initialize()
            has_fallen = False
            while not has_fallen and done_s + root.get_time() < wanted_s:
                until_s = root.get_time() + rng.uniform(*_BETWEEN_S)
                status = adaptation.advance(simulator, until_s)
                has_fallen = status.reason() == _FALLEN
                if not has_fallen:
                    throw = thrower.sample_throw(rng, root.get_time() + _LEAD_S)
                    thrower.throw_ball(root, throw, _LEAD_S)
                    num_throws += 1
                elapsed_s = done_s + root.get_time()
                if not samples or elapsed_s > samples[-1][0] + 10.0:
                    samples.append((elapsed_s, _memory_mb()))
                stages("simulated minutes", round(elapsed_s / 60.0), round(wanted_s / 60.0))
            done_s += root.get_time()
            num_falls += has_fallen
    growth = share_grown(np.array(samples))
    out.mkdir(parents=True, exist_ok=True)
    report = {
        "command": command_line(),
        "simulated_s": done_s,
        "throws": num_throws,
        "falls": num_falls,
        "updates": adaptation.num_updates,
        "growth": growth,
        "memory_mb": samples,
    }
    (out / "soak.json").write_text(json.dumps(report) + "\n", encoding="utf-8")
    console.print(
        f"{done_s / 3600:.2f} h: {num_throws} throws, {num_falls} falls, "
        f"{adaptation.num_updates} updates; memory {samples[-1][1]:.0f} MB, "
        f"{100 * growth:+.1f} % since the tenth minute"
    )
    print_path("figures", out / "soak.json")
    for picture in save(_figure(np.array(samples)), out / "soak"):
        print_path("picture", picture)


def share_grown(samples: np.ndarray) -> float:
    """Growth of the memory from ten minutes on, as a share; medians of ten samples.

    Args:
        samples: Simulated time [s] and memory, (N, 2).
    """
    late = samples[samples[:, 0] >= min(_WARM_UP_S, 0.5 * samples[-1, 0]), 1]
    return float(np.median(late[-10:]) / np.median(late[:10]) - 1.0)


def _memory_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(next(x.split()[1] for x in status.splitlines() if x.startswith("VmRSS"))) / 1024


def _figure(samples: np.ndarray) -> Figure:
    with drawing_style():
        fig = new_figure(7.0, 3.2)
        axes = fig.subplots()
        axes.plot(samples[:, 0] / 60.0, samples[:, 1], color=SAFE_COLOUR)
        axes.set_ylim(0.0, 1.15 * samples[:, 1].max())
        axes.set_xlabel("simulated time [min]")
        axes.set_title("Memory [MB]")
        axes.grid(axis="y", color="#eceef0", linewidth=0.7)
    return fig
