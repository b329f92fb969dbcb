"""Rollouts: episodes of closed loops, simulated in worker processes."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
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
    floats,
    installed_versions,
)
from drake_safety.plants.pushes import Push
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
from drake_safety.simulation.hidden_state import difference
from drake_safety.simulation.motion import Motion, simulate
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import BATCH_SIZE, MadeOnce, Progress, map_items
from drake_safety.systems.monitored_assessor import leaf_systems

MOTION_PIECE_S = 60.0
"""Duration of one undisturbed motion [s]."""
_AFTER_LEAVING_S = 1.0  # Until a robot has fallen, if it does.
_MANY = 64  # Episodes of which two more are a small share.
_LOGGER = logging.getLogger("drake_safety")


def worker_loop(
    scenario: Scenario, variation: str = "nominal", **options: Any
) -> MadeOnce[ClosedLoop]:
    """Makes the loop of a process, once per scenario, variation, options and robot."""
    # The hash covers the robot's files, and the text what the hash leaves out, such as a threshold.
    hash_ = scenario.simulation_hash(variation)
    key = (hash_, scenario.to_yaml(), variation, repr(sorted(options.items())))
    return MadeOnce(key, partial(scenario.make_loop, variation, **options))


def episode_rng(seed: int, index: int) -> np.random.Generator:
    """The random generator of an episode, which depends on the seed and the index alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))


def seed_random_sources(diagram: Diagram, context: Context, seed: int, index: int) -> None:
    """Seeds Drake's random sources by seed and index, apart from the generator of the start."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, 0)))
    for one in leaf_systems([diagram]):
        if isinstance(one, RandomSource):
            generator = RandomGenerator(int(rng.integers(2**31)))
            one.SetRandomContext(one.GetMyMutableContextFromRoot(context), generator)


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
    is_standing: bool = False,
    start: EpisodeStart | None = None,
    at_start: Callable[[Context], object] = lambda context: None,
    until_fall: bool = False,
    **options: Any,
) -> Episode:
    """Simulates one episode, which ends when it leaves the safe set or its time is over.

    Args:
        loop: The closed loop; it has no state and can be used again.
        goal: Goal of the plan, in place of a random one; for tasks with goals.
        is_standing: Whether it begins in the standing posture instead of a random one; requires a
            goal.
        start: Initial state and plan, in place of random ones. The noise is that of the seed and
            the index.
        at_start: Called with the root Context at the start.
        until_fall: Whether it goes on for a second after it leaves the safe set, and only a fall is
            an unsafe end; of a :class:`CanFall`.
        **options: Those of :func:`~drake_safety.simulation.motion.simulate`, as ``monitor``.

    Returns:
        The episode. If the simulation fails, its cause is ``diverged`` and it has the rows that
        are finite.

    Raises:
        ValueError: The task takes no goal or start, or not this one, or both are given.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    if until_fall:
        require(loop, CanFall, "run_episode until a fall")
    if start is not None and (goal is not None or is_standing):
        raise ValueError("run_episode: a start has a plan of its own; leave out the goal")
    if is_standing and goal is None:
        raise ValueError("run_episode: an episode from the standing posture requires a goal")
    scenario = loop.scenario

    def begin(context: Context) -> int:
        rng, first_step = episode_rng(seed, index), 0
        seed_random_sources(loop, context, seed, index)
        if start is not None:
            require(loop, CanStartAnywhere).reset_to(context, rng, start)
        elif goal is None:
            first_step = loop.reset(context, rng)
        elif is_standing:
            require(loop, HasGoals).reset_standing(context, goal, rng)
        else:
            first_step = require(loop, HasGoals).reset(context, rng, goal)
        at_start(context)
        return first_step

    counted = filter(loop.HasOutputPort, ["num_controller_failures"])
    motion = simulate(
        loop,
        begin,
        (*RECORDED, *counted),
        duration_s=scenario.episode_duration_s,
        step_s=scenario.step_s,
        watch_period_s=scenario.watch_period_s,
        may_fail=True,
        index=index,
        who=f"episode {index} of '{scenario.name}' (seed {seed})",
        **({"after_leaving_s": _AFTER_LEAVING_S if until_fall else 0.0} | options),
    )
    if until_fall:
        motion.cause = require(loop, CanFall).fall_name if motion.has_fallen else ""
    return motion.episode()


def run_to_goal(
    loop: ClosedLoop,
    goal: np.ndarray,
    *,
    push: Push | None = None,
    seed: int = 0,
    ports: Iterable[str] = (),
    **options: Any,
) -> Motion:
    """Simulates the motion from the standing posture to a goal, safe or not, until it falls.

    Args:
        goal: In the world, (3,) [m].
        ports: Ports to log besides ``output``, ``margins`` and ``plant_state``.
        **options: Those of :func:`~drake_safety.simulation.motion.simulate`, as ``duration_s``.

    Raises:
        ValueError: The task's plans have no goal, its robot cannot be pushed, or has no such body.
        EpisodeError: A system of the loop raised an error, or the simulation failed.
    """

    def begin(context: Context) -> None:
        require(loop, HasGoals).reset_standing(context, goal, episode_rng(seed, 0))
        if push is not None:
            require(loop, CanBePushed).set_push(context, push)

    options.setdefault("who", f"motion of '{loop.scenario.name}' to a goal (seed {seed})")
    motion = simulate(loop, begin, ("output", "margins", "plant_state", *ports), **options)
    motion.push_time_s = math.inf if push is None else push.time_s
    return motion


def inputs_at(loop: ClosedLoop, start: EpisodeStart) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The assessment's inputs for a hypothetical state and plan; nothing is simulated.

    ``assessment.predict_one(*inputs_at(loop, start))`` is the verdict on them.

    Returns:
        State (n_s,) without noise, desired preview (H*n_z,) and features (n_f,).
    """
    context = loop.CreateDefaultContext()
    require(loop, CanStartAnywhere).reset_to(context, None, start)
    state, preview, features = (
        loop.GetOutputPort(name).Eval(context).copy()
        for name in ("state", "desired_preview", "features")
    )
    return state, preview, features


def run_motions(
    scenario: Scenario,
    duration_s: float,
    *,
    variation: str = "nominal",
    seed: int = MOTION.first,
    until_s: float = math.inf,
    are_episodes: bool = False,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    **loop_options: Any,
) -> Episodes:
    """Simulates undisturbed motion, in worker processes, for a `ChangeDetector`.

    A task that :class:`~drake_safety.simulation.capabilities.MovesUndisturbed` moves for a minute
    at a time; of others these are ordinary episodes. Rows are `scenario.monitor_step_s` apart. A
    motion ends when it leaves the safe set.

    Args:
        duration_s: Duration of all motions together, if none leaves the safe set [s].
        until_s: Time at which each ends, if not sooner [s].
        are_episodes: Whether they are ordinary episodes of any task.
        path, **loop_options: As for `run_episodes`.

    Raises:
        ValueError: The folder holds another set or one that is not the same any more.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    check_times("run_motions", duration_s=duration_s)
    make = worker_loop(scenario, variation, **loop_options)
    loop = make()
    piece_s = min(motion_piece_s(loop, are_episodes), until_s)
    kind = "episodes_s" if are_episodes else "undisturbed_s"
    info = episodes_info(loop, seed, {**loop_options, kind: piece_s})
    step_s = scenario.monitor_step_s
    return collect_episodes(
        replace(info, step_s=step_s, num_steps=round(piece_s / step_s)),
        range(math.ceil(duration_s / piece_s - 1e-6)),
        make,
        partial(run_motion, seed=seed, until_s=until_s, is_episode=are_episodes),
        num_workers=num_workers,
        path=path,
        progress=progress,
        extra=extra,
        batch_size=1 if piece_s > scenario.episode_duration_s else BATCH_SIZE,
    )


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
    start: Callable[[Context], None] | None = None,
) -> Episode:
    """Simulates one undisturbed motion; see `run_motions`.

    Args:
        start: Sets state and plan of the root Context, in place of random ones.
        until_s: Time at which it ends, if not sooner [s].
        with_features: Whether to record features that the monitor does not read, too.
        is_episode: Whether it is an ordinary episode, with the monitor's rows.
    """
    scenario, piece_s = loop.scenario, motion_piece_s(loop, is_episode)
    step_s = scenario.monitor_step_s

    def begin(context: Context) -> int | None:
        seed_random_sources(loop, context, seed, index)
        if start is not None:
            return start(context)
        rng = episode_rng(seed, index)
        if isinstance(loop, MovesUndisturbed) and not is_episode:
            return loop.reset_undisturbed(context, rng, piece_s)
        return math.ceil(loop.reset(context, rng) * scenario.step_s / step_s)

    # Features may cost more than the simulation.
    left_out = "features" if loop.monitored.get("features") == [] and not with_features else ""
    return simulate(
        loop,
        begin,
        [name for name in RECORDED if name != left_out],
        duration_s=min(piece_s, until_s),
        step_s=step_s,
        watch_period_s=scenario.watch_period_s,
        after_leaving_s=0.0,
        may_fail=True,
        index=index,
        who=f"motion {index} of '{scenario.name}' (seed {seed})",
    ).episode(len(loop.feature_names))


def run_episodes(
    scenario: Scenario,
    num_episodes: int,
    *,
    variation: str = "nominal",
    seed: int = 0,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    goals: np.ndarray | None = None,
    is_standing: bool = False,
    until_fall: bool = False,
    **loop_options: Any,
) -> Episodes:
    """Simulates a set of episodes, in worker processes.

    Episode i depends on the scenario, the variation, the seed and i alone: the arrays are
    identical for any number of workers.

    Args:
        num_workers: Number of processes; that of cores by default. 1 runs in this process.
        path: Folder for the episodes; those of the same set that it already holds are kept, if one
            of them, simulated again, is the same to the last bit.
        goals: Goal of each episode in place of random ones, (num_episodes, n_goal); such episodes
            cannot be stored.
        is_standing: Whether episodes begin in the standing posture; requires goals.
        until_fall: As of `run_episode`.
        **loop_options: Options of the task; part of the set's hash.

    Raises:
        ValueError: The folder holds another set or one that is not the same any more, the task
            takes no goals, there is not one finite goal per episode, both goals and a folder are
            given, or one of many episodes, simulated again, differs.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    if path is not None and goals is not None:
        # The hash of a folder's set does not cover goals.
        raise ValueError("run_episodes: episodes with goals are not kept; leave out 'path'")
    make = worker_loop(scenario, variation, **loop_options)
    if goals is not None:
        goals = _checked_goals(make(), goals, num_episodes)

    def run(loop: ClosedLoop, index: int, **options: Any) -> Episode:
        goal = None if goals is None else goals[index]
        return run_episode(
            loop,
            index,
            seed=seed,
            goal=goal,
            is_standing=is_standing,
            until_fall=until_fall,
            **options,
        )

    kind = {"until_fall": True} if until_fall else {}
    info = episodes_info(make(), seed, loop_options | kind)
    if until_fall:
        info.until = require(make(), CanFall).fall_name
    return collect_episodes(
        info,
        range(num_episodes),
        make,
        run,
        num_workers=num_workers,
        path=path,
        progress=progress,
        extra=extra,
        is_repeated=num_episodes >= _MANY,
    )


def collect_episodes(
    info: EpisodesInfo,
    indices: Sequence[int],
    make: MadeOnce[Any],
    function: Callable[..., Episode],
    *,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    extra: dict[str, Any] | None = None,
    batch_size: int = BATCH_SIZE,
    is_repeated: bool = False,
) -> Episodes:
    """Simulates the episodes of a set that a folder does not hold yet, in worker processes.

    Args:
        indices: Of the episodes, in the order in which they begin.
        make: Makes the diagram.
        function: Returns the episode of a diagram and an index.
        is_repeated: Whether the first episode is simulated again after the next, by a new diagram,
            and must be the same; ``function`` then takes a ``monitor``.
    """
    wanted = set(indices)
    with nullcontext() if path is None else EpisodeWriter(path, info, extra) as writer:
        episodes: list[Episode] = []
        if writer is not None:
            episodes += (e for e in load_episodes(writer.path) if e.index in wanted)
            if episodes:
                check_kept(writer.path, episodes, partial(make.run, function))
                _LOGGER.warning(
                    "%d of %d episodes are kept from %s", len(episodes), len(indices), path
                )
        kept = {episode.index for episode in episodes}
        pending = [index for index in indices if index not in kept]

        def run(index: int) -> Episode:
            found = make.run(function, index)
            is_tried = is_repeated and index == pending[0]
            if is_tried and (text := difference(found, make.make, function)):
                who = f"episode {index} of '{info.scenario}', simulated a second time"
                raise ValueError(f"{who}, {text}")
            return found

        results = map_items(
            run,
            pending,
            num_workers=num_workers,
            progress=progress,
            num_done=len(kept),
            stage=f"episodes of '{info.scenario}'",
            batch_size=batch_size,
        )
        with closing(results):
            for episode in results:
                episodes.append(episode)
                if writer is not None:
                    writer.append(episode)
    collected = Episodes(info, sorted(episodes, key=lambda episode: episode.index))
    for problem, which in {
        "diverged and have no safety label": [e.index for e in collected if e.cause == DIVERGED],
        "held the last action, where the controller found none": [
            episode.index for episode in collected if episode.num_controller_failures
        ],
    }.items():
        if which:
            _LOGGER.warning(
                "%d of %d simulations of '%s' %s: episodes %s",
                len(which),
                len(indices),
                info.scenario,
                problem,
                ", ".join(map(str, which[:10])) + (", ..." if len(which) > 10 else ""),
            )
    return collected


def check_kept(path: Path, kept: Sequence[Episode], run: Callable[[int], Episode]) -> None:
    """Simulates one of a folder's episodes again, a long unsafe one if there is one."""
    one = min(kept, key=lambda episode: (episode.is_safe, -episode.num_steps, episode.index))
    with ONE_BLAS_THREAD:
        again = run(one.index)
    if not is_same(one, again):
        raise ValueError(
            f"{path} holds {len(kept)} episodes of this set that are not the same any more: "
            f"episode {one.index}, simulated again, differs. The diagram, the code, a package or "
            "the kind of machine has changed; choose another folder, or remove this one "
            "(`load_episodes` reads it as it is)"
        )


def _checked_goals(loop: ClosedLoop, goals: np.ndarray, num_episodes: int) -> np.ndarray:
    require(loop, HasGoals)
    goals = floats(goals)
    if goals.ndim != 2 or len(goals) != num_episodes:
        raise ValueError(
            f"run_episodes: goals must have one row per episode, {num_episodes} in all; got shape "
            f"{goals.shape}"
        )
    if len(wrong := np.flatnonzero(~np.isfinite(goals).all(axis=1))):
        raise ValueError(
            f"run_episodes: goals must be finite; goal {wrong[0]} is {goals[wrong[0]]}"
        )
    return goals
