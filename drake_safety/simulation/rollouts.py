"""Rollouts: episodes of closed loops, simulated in worker processes."""

import hashlib
import logging
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import cache, partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.framework import Context, Diagram
from pydrake.systems.primitives import RandomSource

from drake_safety.files.schema import check_times
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from drake_safety.learning.seeds import MOTION
from drake_safety.learning.segments import (
    DIVERGED,
    RECORDED,
    Episode,
    Episodes,
    EpisodesInfo,
    installed_versions,
)
from drake_safety.plants.pushes import Push
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.capabilities import (
    CanBePushed,
    CanFall,
    CanStartAnywhere,
    HasGoals,
    MovesUndisturbed,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, is_same, load_episodes
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import (
    BATCH_SIZE,
    CloudPickled,
    MadeOnce,
    Progress,
    map_items,
)
from drake_safety.systems.monitored_assessor import leaf_systems

MOTION_PIECE_S = 60.0  # Duration of one undisturbed motion.
_AFTER_LEAVING_S = 1.0  # Until a robot has fallen, if it does.
_MANY = 64  # Episodes of which two more are a small share.
_LOGGER = logging.getLogger("drake_safety")
HIDDEN_STATE = (
    "differs: the diagram, or its reset, keeps state outside its Context, such as a memory, a "
    "random generator or a cache in an attribute of a system; declare it as state"
)


def worker_loop(
    scenario: Scenario, variation: str = "nominal", **options: Any
) -> MadeOnce[ClosedLoop]:
    """Makes the loop of a process, once per scenario, variation, options and robot."""
    # The hash covers the robot's files, and the text what the hash leaves out, such as a threshold.
    files, text = scenario.simulation_hash(variation), scenario.to_yaml()
    key = (files, text, variation, repr(sorted(options.items())))
    return MadeOnce(key, partial(scenario.make_loop, variation, **options))


def loops_by_plant(key: Hashable, make: Callable[[int], Any]) -> MadeOnce[Callable[[int], Any]]:
    """The loops of a process for a family's plants, from number 1 on, each made at first need."""
    return MadeOnce(key, partial(cache, CloudPickled(make)))


def run_on_plant(
    run: Callable[..., Episode], info: EpisodesInfo, loops: Callable[[int], Any], index: int
) -> Episode:
    """Runs the episode of an index with the loop of its plant."""
    number = info.plant_of(index)
    return replace(run(loops(number), index), plant=number)


def _loops(
    scenario: Scenario, variation: str, plants: int | None, seed: int, options: dict[str, Any]
) -> tuple[MadeOnce[Any], ClosedLoop, int]:
    """Returns a maker of a process's loops, one loop, and the number of a family's plants."""
    make: MadeOnce[Any] = worker_loop(scenario, variation, **options)
    if variation != FAMILY or scenario.family is None:
        return make, make(), 0
    make = loops_by_plant(
        (make.key, seed),
        lambda number: scenario.with_plant(seed, number).make_loop(FAMILY, **options),
    )
    return make, make()(1), plants or scenario.family.plants


def episode_rng(seed: int, index: int) -> np.random.Generator:
    """Makes the generator of an episode, which depends on the seed and the index alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))


def seed_random_sources(
    diagram: Diagram,
    context: Context,
    seed: int,
    index: int,
    draws: np.random.Generator | None = None,
) -> np.random.Generator:
    """Seeds Drake's random sources, and returns the generator of the start.

    Both draw from ``draws``; by default each has a generator that depends on seed and index alone.
    """
    own = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, 0)))
    for system in leaf_systems([diagram]):
        if isinstance(system, RandomSource):
            generator = RandomGenerator(int((draws or own).integers(2**31)))
            system.SetRandomContext(system.GetMyMutableContextFromRoot(context), generator)
    return draws or episode_rng(seed, index)


def episodes_info(
    loop: ClosedLoop, seed: int, loop_options: dict[str, Any] | None = None
) -> EpisodesInfo:
    """Metadata common to all episodes of a loop; its options are part of the set's hash."""
    scenario = loop.scenario
    scenario_hash = scenario.simulation_hash(loop.variation)
    if loop_options:
        text = f"{scenario_hash} {sorted(loop_options.items())}"
        scenario_hash = hashlib.sha256(text.encode()).hexdigest()
    return EpisodesInfo(
        scenario=scenario.identity or scenario.name,
        scenario_hash=scenario_hash,
        variation=loop.variation,
        seed=seed,
        step_s=scenario.step_s,
        horizon=scenario.assessment.horizon,
        constraint_names=list(loop.constraint_names),
        state_names=list(loop.state_names),
        output_names=list(loop.output_names),
        feature_names=list(loop.feature_names),
        versions=installed_versions("drake", "numpy", scenario.variation(loop.variation).engine),
        num_steps=scenario.num_steps,
        preview_stride=scenario.assessment.preview_stride,
        monitored_states=loop.monitored.get("states"),
        monitored_features=loop.monitored.get("features"),
        robot=scenario.robot_name,
    )


def run_episode(
    loop: ClosedLoop,
    index: int = 0,
    *,
    seed: int = 0,
    goal: np.ndarray | None = None,
    start: EpisodeStart | None = None,
    at_start: Callable[[Context], object] | None = None,
    until_fall: bool = False,
    monitor: Callable[[Context], object] | None = None,
    draws: np.random.Generator | None = None,
    **end: Any,
) -> Episode:
    """Simulates one episode, which ends when it leaves the safe set or its time is over.

    If the simulation fails, its cause is ``diverged`` and it has the rows that are finite; an error
    of a system raises ``EpisodeError``.

    Args:
        goal, start: Goal of the plan, or initial state and plan; random by default.
        at_start: Called with the root Context at the start.
        until_fall: Whether it goes on for a second outside, and only a fall is an unsafe end.
        monitor: Called with the Context after each step of the simulator.
        draws: Generator of all random numbers; by default of seed and index.
        **end: Fields of :class:`~drake_safety.simulation.motion.End`.

    Example: ``cause = run_episode(loop, seed=1).cause``
    """
    if start is not None and goal is not None:
        raise ValueError("run_episode: a start has a plan of its own; leave out the goal")
    fall = require(loop, CanFall, "run_episode until a fall").fall_name if until_fall else ""
    scenario = loop.scenario

    def begin(context: Context) -> int:
        rng, first_step = seed_random_sources(loop, context, seed, index, draws), 0
        if start is not None:
            require(loop, CanStartAnywhere).reset_to(context, rng, start)
        elif goal is None:
            first_step = loop.reset(context, rng)
        else:
            first_step = require(loop, HasGoals).reset(context, rng, goal)
        if at_start is not None:
            at_start(context)
        return first_step

    end = {"after_leaving_s": _AFTER_LEAVING_S if until_fall else 0.0} | end
    motion = simulate(
        loop,
        begin,
        (*RECORDED, *filter(loop.HasOutputPort, ["num_controller_failures"])),
        End(duration_s=scenario.episode_duration_s, **end),
        step_s=scenario.step_s,
        watch_period_s=scenario.watch_period_s,
        monitor=monitor,
        may_fail=True,
        index=index,
        who=f"episode {index} of '{scenario.name}' (seed {seed})",
    )
    if until_fall:
        motion.cause = fall if motion.has_fallen else ""
    return motion.episode()


def run_to_goal(
    loop: ClosedLoop,
    goal: np.ndarray,
    *,
    duration_s: float,
    after_fall_s: float = 0.0,
    push: Push | None = None,
    seed: int = 0,
    ports: Iterable[str] = (),
    **options: Any,
) -> Motion:
    """Simulates the motion from the standing posture to a goal (3,), until the robot falls.

    It logs ``output``, ``margins``, ``plant_state`` and further ports; ``options`` are as for
    :func:`~drake_safety.simulation.motion.simulate`.
    """

    def begin(context: Context) -> None:
        require(loop, HasGoals).reset_standing(context, goal, episode_rng(seed, 0))
        if push is not None:
            require(loop, CanBePushed).set_push(context, push)

    options = {"who": f"motion of '{loop.scenario.name}' to a goal (seed {seed})"} | options
    end = End(duration_s=duration_s, after_fall_s=after_fall_s)
    logged = ("output", "margins", "plant_state", *ports)
    motion = simulate(loop, begin, logged, end, **options)
    motion.push_time_s = math.inf if push is None else push.time_s
    return motion


def inputs_at(loop: ClosedLoop, start: EpisodeStart) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes Γ's inputs (n_s,), (H n_z,) and (n_f,) for a hypothetical state and plan.

    Example: ``state, preview, features = inputs_at(legged_loop, start)``
    """
    context = loop.CreateDefaultContext()
    require(loop, CanStartAnywhere).reset_to(context, None, start)
    names = ("state", "desired_preview", "features")
    state, preview, features = (loop.GetOutputPort(n).Eval(context).copy() for n in names)
    return state, preview, features


def run_motions(
    scenario: Scenario,
    duration_s: float,
    *,
    variation: str = "nominal",
    plants: int | None = None,
    seed: int = MOTION.first,
    are_episodes: bool = False,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    **loop_options: Any,
) -> Episodes:
    """Simulates undisturbed motion for a `ChangeDetector`; rows are `monitor_step_s` apart.

    Args:
        duration_s: Sum of all motions [s]; pieces of a task that `MovesUndisturbed` last a minute.
        are_episodes: Whether the motions are episodes, as of other tasks.
        variation, plants, seed, num_workers, path, progress, extra: As of `run_episodes`.

    Example: ``motions = run_motions(scenario, 10.0, num_workers=1)``
    """
    check_times("run_motions", duration_s=duration_s)
    make, loop, num_plants = _loops(scenario, variation, plants, seed, loop_options)
    step_s, piece_s = scenario.monitor_step_s, motion_piece_s(loop, are_episodes)
    options = {**loop_options, "episodes_s" if are_episodes else "undisturbed_s": piece_s}
    info = replace(episodes_info(loop, seed, options), step_s=step_s, plants=num_plants)
    info.num_steps = round(piece_s / step_s)
    run = partial(run_motion, seed=seed, is_episode=are_episodes)
    number = math.ceil(duration_s / piece_s - 1e-6)
    kept = dict[str, Any](num_workers=num_workers, path=path, progress=progress, extra=extra)
    size = 1 if piece_s > scenario.episode_duration_s else BATCH_SIZE
    return collect_episodes(info, range(number), make, run, batch_size=size, **kept)


def motion_piece_s(loop: ClosedLoop, is_episode: bool = False) -> float:
    """Duration of one undisturbed motion of a loop, or of an episode [s]."""
    is_long = isinstance(loop, MovesUndisturbed) and not is_episode
    return MOTION_PIECE_S if is_long else loop.scenario.episode_duration_s


def run_motion(
    loop: ClosedLoop,
    index: int = 0,
    *,
    seed: int = MOTION.first,
    until_s: float = math.inf,
    with_features: bool = False,
    is_episode: bool = False,
) -> Episode:
    """Simulates one undisturbed motion, at most until a time; see `run_motions`.

    Features that the monitor does not read are zero, unless ``with_features``.
    """
    scenario, piece_s = loop.scenario, motion_piece_s(loop, is_episode)

    def begin(context: Context) -> int | None:
        rng = seed_random_sources(loop, context, seed, index)
        if isinstance(loop, MovesUndisturbed) and not is_episode:
            return loop.reset_undisturbed(context, rng, piece_s)
        return math.ceil(loop.reset(context, rng) * scenario.step_s / scenario.monitor_step_s)

    # Features may cost more than the simulation.
    left_out = "features" if loop.monitored.get("features") == [] and not with_features else ""
    return simulate(
        loop,
        begin,
        [name for name in RECORDED if name != left_out],
        End(duration_s=min(piece_s, until_s), after_leaving_s=0.0),
        step_s=scenario.monitor_step_s,
        watch_period_s=scenario.watch_period_s,
        may_fail=True,
        index=index,
        who=f"motion {index} of '{scenario.name}' (seed {seed})",
    ).episode(len(loop.feature_names))


def run_episodes(
    scenario: Scenario,
    num_episodes: int,
    *,
    variation: str = "nominal",
    plants: int | None = None,
    seed: int = 0,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    until_fall: bool = False,
    **loop_options: Any,
) -> Episodes:
    """Simulates a set of episodes, in worker processes.

    Episode i depends on the scenario, the variation, the seed and i alone. With the variation
    ``family`` its plant is number i modulo ``plants`` of the seed's random plants.

    Args:
        plants: Number of the family's plants; by default the scenario's.
        num_workers: Number of processes; by default one a core. 1 runs in this process.
        path: Folder for the episodes. Existing episodes are kept, if one of them, simulated again,
            is the same to the last bit; another set is refused.
        progress: Called with the number done and in all; True shows it.
        extra: Further content of the folder's ``info.json``.
        until_fall: As of `run_episode`.
        **loop_options: Options of the task; part of the set's hash.

    Example: ``more = run_episodes(scenario, 8, variation="actual", seed=1, num_workers=1)``
    """
    make, loop, num_plants = _loops(scenario, variation, plants, seed, loop_options)
    info = episodes_info(loop, seed, loop_options | ({"until_fall": True} if until_fall else {}))
    info.plants = num_plants
    if until_fall:
        info.until = require(loop, CanFall).fall_name
    run, is_many = partial(run_episode, seed=seed, until_fall=until_fall), num_episodes >= _MANY
    kept = dict[str, Any](num_workers=num_workers, path=path, progress=progress, extra=extra)
    return collect_episodes(info, range(num_episodes), make, run, is_repeated=is_many, **kept)


def collect_episodes(
    info: EpisodesInfo,
    indices: Sequence[int],
    make: MadeOnce[Any],
    run: Callable[..., Episode],
    *,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    batch_size: int = BATCH_SIZE,
    is_repeated: bool = False,
) -> Episodes:
    """Simulates the episodes of a set that a folder does not hold yet, in worker processes.

    ``run`` returns the episode of a diagram, of a family the plant's, and an index. If
    ``is_repeated``, the first episode with several rows, simulated again after the next by a new
    diagram, must be the same.
    """
    if info.plants:
        run = partial(run_on_plant, run, info)
    with nullcontext() if path is None else EpisodeWriter(path, info, extra) as writer:
        there = [] if writer is None else load_episodes(writer.path)
        wanted = set(indices)
        episodes = [episode for episode in there if episode.index in wanted]
        if writer is not None and episodes:
            check_kept(writer.path, episodes, partial(run, make()))
            counts = (len(episodes), len(indices), path)
            _LOGGER.warning("%d of %d episodes are kept from %s", *counts)
        known = {episode.index for episode in episodes}
        pending = [index for index in indices if index not in known]
        results = map_items(
            run,
            pending,
            make=make,
            num_workers=num_workers,
            progress=progress,
            num_done=len(known),
            stage=f"episodes of '{info.scenario}'",
            batch_size=batch_size,
        )
        judged = set(pending[:1] if is_repeated else ())
        with closing(results):
            for episode in results:
                if episode.index in judged:
                    # A single row vouches for nothing.
                    judged = set() if episode.num_steps else set(pending)
                    if not judged and not is_repeatable(episode, make.make(), run):
                        who = f"episode {episode.index} of '{info.scenario}'"
                        raise ValueError(f"{who}, simulated again after the next, {HIDDEN_STATE}")
                episodes.append(episode)
                if writer is not None:
                    writer.append(episode)
    collected = Episodes(info, sorted(episodes, key=lambda episode: episode.index))
    diverged = [episode.index for episode in collected if episode.cause == DIVERGED]
    failed = [episode.index for episode in collected if episode.num_controller_failures]
    for problem, numbers in (
        ("diverged and have no safety label", diverged),
        ("held the last action, where the controller had none", failed),
    ):
        if numbers:
            counts = (len(numbers), len(indices), info.scenario)
            _LOGGER.warning("%d of %d simulations of '%s' %s: %s", *counts, problem, numbers[:10])
    return collected


def is_repeatable(episode: Episode, diagram: Diagram, run: Callable[..., Episode]) -> bool:
    """Whether a new diagram simulates an episode alike, to the last bit, after the next one."""
    with ONE_BLAS_THREAD:
        run(diagram, episode.index + 1)
        return is_same(episode, run(diagram, episode.index))


def check_kept(path: Path, kept: Sequence[Episode], run: Callable[[int], Episode]) -> None:
    """Simulates one of a folder's episodes again, a long unsafe one if there is one."""
    chosen = min(kept, key=lambda e: (e.num_steps == 0, e.is_safe, -e.num_steps, e.index))
    with ONE_BLAS_THREAD:
        again = run(chosen.index)
    if not is_same(chosen, again):
        text = f"episode {chosen.index}, simulated again, differs; choose another folder"
        count = f"{path} holds {len(kept)} episodes of this set"
        raise ValueError(f"{count} that are not the same any more: {text}")
