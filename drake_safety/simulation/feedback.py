"""Feedback by simulation: actual episodes and their nominal twins."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from drake_safety.learning.feedback import EpisodePair, pair_episodes
from drake_safety.learning.seeds import ADAPTATION, NOT_DRAWN
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.capabilities import CanStartAnywhere, require
from drake_safety.simulation.closed_loop import ClosedLoop, port_sizes
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.rollouts import episodes_info, run_episode, run_episodes, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress
from drake_safety.systems.feedback_recorder import FeedbackRecorder, RecordedWindow

_TWINS = "nominal"


@dataclass(frozen=True, kw_only=True)
class EpisodePairs:
    """Actual episodes and their nominal twins."""

    actual: Episodes
    nominal: Episodes
    nominal_hash: str

    def feedback(self) -> list[EpisodePair]:
        """The pairs in the order of the episodes, without diverged episodes."""
        return pair_episodes(self.actual, self.nominal, nominal_hash=self.nominal_hash)


def run_pairs(
    scenario: Scenario,
    num_pairs: int,
    *,
    variation: str = "actual",
    seed: int = ADAPTATION.first,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    **options: Any,
) -> EpisodePairs:
    """Simulates actual episodes and their nominal twins, which start alike, as `run_episodes`."""
    options = scenario.options_for("pairs", variation) | options
    sets = {}
    for i, name in enumerate((variation, _TWINS)):

        def report(done: int, wanted: int, first: int = i * num_pairs) -> None:
            if callable(progress):
                progress(first + done, 2 * num_pairs)

        sets[name] = run_episodes(
            scenario,
            num_pairs,
            variation=name,
            seed=seed,
            path=None if path is None else Path(path) / name,
            progress=report if callable(progress) else progress,
            **options,
        )
    own_hash = scenario.simulation_hash()
    return EpisodePairs(actual=sets[variation], nominal=sets[_TWINS], nominal_hash=own_hash)


def AddFeedbackRecorder(builder: DiagramBuilder, loop: ClosedLoop) -> FeedbackRecorder:
    """Adds a recorder named ``feedback_recorder`` to a diagram, and connects it to a loop."""
    recorder = FeedbackRecorder(
        episodes_info(loop, seed=NOT_DRAWN),
        num_steps=loop.scenario.num_steps,
        plant_state_size=loop.GetOutputPort("plant_state").size(),
        watch_period_s=loop.scenario.watch_period_s,
        controller_memory_size=_memory_size(loop),
    )
    builder.AddNamedSystem("feedback_recorder", recorder)
    for port in map(recorder.get_input_port, range(recorder.num_input_ports())):
        if loop.HasOutputPort(port.get_name()):
            builder.Connect(loop.GetOutputPort(port.get_name()), port)
    return recorder


def window_start(loop: ClosedLoop, window: RecordedWindow) -> EpisodeStart:
    """Makes the start of a window's nominal twin, with a plan through its desired outputs."""
    preview = window.episode.desired_preview
    num_outputs = len(loop.output_names)
    # The first sample of a preview is that of its own row; the last preview reaches beyond.
    plan = np.concatenate([preview[:-1, :num_outputs], preview[-1].reshape(-1, num_outputs)])
    scenario, num_rows = loop.scenario, len(preview) - 1
    ahead_s = scenario.preview_step_s * np.arange(scenario.assessment.horizon)
    times = np.append(scenario.step_s * np.arange(num_rows), scenario.step_s * num_rows + ahead_s)
    q, v = np.split(window.plant_state, [require(loop, CanStartAnywhere).plant_state_sizes[0]])
    return EpisodeStart(
        q=q,
        v=v,
        plan=PiecewisePolynomial.CubicShapePreserving(times, plan.T),
        controller_state=window.controller_memory,
    )


def _memory_size(loop: ClosedLoop) -> int:
    size = port_sizes(loop).get("controller_memory", 0)
    # A window begins at a row, so a row must be a time at which the controller updates.
    period_s, step_s = getattr(loop, "memory_period_s", loop.scenario.step_s), loop.scenario.step_s
    if abs(step_s / period_s - round(step_s / period_s)) > 1e-6:
        text = f"step_s {step_s:g} is not a multiple of the controller's period {period_s:g} s"
        raise ValueError(f"feedback of '{loop.scenario.name}': {text}")
    return size


def pair_starts(
    scenario: Scenario,
    actual: Episodes,
    starts: Sequence[EpisodeStart],
    *,
    seed: int = ADAPTATION.first,
) -> EpisodePairs:
    """Simulates the nominal twins of episodes with known starts, in this process."""
    loop = worker_loop(scenario, _TWINS)()
    with ONE_BLAS_THREAD:
        twins = [
            run_episode(loop, episode.index, seed=seed, start=start)
            for episode, start in zip(actual, starts, strict=True)
        ]
    nominal, own_hash = Episodes(episodes_info(loop, seed), twins), scenario.simulation_hash()
    return EpisodePairs(actual=actual, nominal=nominal, nominal_hash=own_hash)


def pair_windows(
    scenario: Scenario, recorder: FeedbackRecorder, windows: Sequence[RecordedWindow]
) -> list[EpisodePair]:
    """Pairs of recorded windows and their nominal twins, which are simulated in this process."""
    loop = worker_loop(scenario, _TWINS)()
    size = _memory_size(loop)
    for window in windows:
        memory = window.controller_memory
        if (got := 0 if memory is None else len(memory)) != size:
            text = f"a window has {got} entries of the controller's memory, expected {size}"
            raise ValueError(f"feedback of '{scenario.name}': {text}")
    actual = Episodes(recorder.info, [window.episode for window in windows])
    starts = [window_start(loop, window) for window in windows]
    return pair_starts(scenario, actual, starts).feedback()
