"""Rollouts: closed loops simulated to episodes, on one core or many, the same bits either way."""

from __future__ import annotations

import copyreg
import hashlib
import importlib
import logging
import sys
import warnings
from collections.abc import Callable, Generator
from os import PathLike
from types import BuiltinFunctionType, ModuleType
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from drake_safety.learning.segments import (
    DIVERGED,
    Episode,
    Episodes,
    EpisodesInfo,
    installed_versions,
)
from drake_safety.simulation.capabilities import (
    CanStartAnywhere,
    CountsFailures,
    HasGoals,
    OffersPlans,
    monitor_period_s,
    require,
)
from drake_safety.simulation.closed_loop import REQUIRED_PORTS, ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, completed, load_episodes
from drake_safety.simulation.episode_recorder import EpisodeTiming, record_episode
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.scenario import Scenario

_LOGGER = logging.getLogger("drake_safety")
_BATCH = 4  # Episodes, or throws, that a worker takes at a time.

Progress = Callable[[int, int], None]
"""Called with the number done and the number wanted."""


def episode_rng(seed: int, index: int) -> np.random.Generator:
    """The generator of an episode: independent of who runs it, and when.

    Args:
        seed: Seed of the set.
        index: Number of the episode in its set.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))


def episodes_info(
    loop: ClosedLoop, seed: int, loop_options: dict[str, Any] | None = None
) -> EpisodesInfo:
    """What all episodes of a loop share.

    Args:
        loop: The closed loop.
        seed: Seed of the set.
        loop_options: Options that the loop was made with; as they decide what is simulated, they
            are part of the set's hash.
    """
    scenario = loop.scenario
    scenario_hash = scenario.simulation_hash(loop.variation_name)
    if loop_options:
        text = f"{scenario_hash} {sorted(loop_options.items())}"
        scenario_hash = hashlib.sha256(text.encode()).hexdigest()
    return EpisodesInfo(
        scenario=scenario.name,
        scenario_hash=scenario_hash,
        variation=loop.variation_name,
        seed=seed,
        step_s=scenario.step_s,
        horizon=scenario.assessment.horizon,
        constraint_names=list(loop.constraint_names),
        state_names=list(loop.state_names),
        output_names=list(loop.output_names),
        feature_names=list(loop.feature_names),
        versions=installed_versions("drake", "numpy", loop.variation.engine),
        num_steps=scenario.num_steps,
        code=scenario.code_digest(),
    )


def run_episode(
    loop: ClosedLoop,
    index: int = 0,
    *,
    seed: int = 0,
    goal: np.ndarray | None = None,
    is_standing: bool = False,
    start: EpisodeStart | None = None,
    plan: Any = None,
) -> Episode:
    """Simulates one episode: until it leaves the safe set, or its time is over.

    Args:
        loop: The closed loop; it keeps no state, and can be used again.
        index: Number of the episode in its set.
        seed: Seed of the set.
        goal: Where the task's plan shall lead, in place of a random goal; only for tasks whose
            ``reset`` takes one.
        is_standing: Whether it begins in the robot's own posture instead of a random one; takes a
            goal.
        start: What it begins with, in place of a random state and plan: the twin of an episode
            that began so. The noise is that of the set and the index.
        plan: Replaces the plan that it begins with: one of the loop's ``candidate_plans``.

    Returns:
        The episode. When the simulation fails, its cause is ``diverged`` and its rows are those
        that were finite.

    Raises:
        ValueError: The task takes no goal or start, or not this one, or both are given.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    if start is not None and (goal is not None or is_standing):
        raise ValueError("run_episode: a start has a plan of its own; leave out the goal")
    if is_standing and goal is None:
        raise ValueError("run_episode: an episode from the standing posture takes a goal")
    scenario = loop.scenario
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    rng = episode_rng(seed, index)
    first_step = 0
    if start is not None:
        require(loop, CanStartAnywhere).reset_to(context, rng, start)
    elif goal is None:
        first_step = loop.reset(context, rng)
    elif is_standing:
        require(loop, HasGoals).reset_standing(context, goal, rng)
    else:
        first_step = require(loop, HasGoals).reset(context, rng, goal)
    if plan is not None:
        require(loop, OffersPlans).set_plan(context, plan)
    episode = record_episode(
        simulator,
        {name: name for name in REQUIRED_PORTS},
        EpisodeTiming(
            step_s=scenario.step_s,
            num_steps=scenario.num_steps,
            monitor_period_s=monitor_period_s(loop),
        ),
        constraint_names=loop.constraint_names,
        who=f"episode {index} of '{scenario.name}' (seed {seed})",
        index=index,
        first_step=first_step,
    )
    if isinstance(loop, CountsFailures):
        episode.num_controller_failures = loop.num_controller_failures(context)
    return episode


def run_episodes(
    scenario: Scenario,
    num_episodes: int,
    *,
    variation: str = "nominal",
    seed: int = 0,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | None = None,
    extra: dict[str, Any] | None = None,
    goals: np.ndarray | None = None,
    is_standing: bool = False,
    accept_code_change: bool = False,
    **loop_options: Any,
) -> Episodes:
    """Simulates a set of episodes, in worker processes.

    Episode i depends on the scenario, the variation, the seed and i alone: the arrays are the
    same to the last bit for any number of workers.

    Args:
        scenario: The scenario.
        num_episodes: Size of the set.
        variation: Which plant.
        seed: Seed of the set.
        num_workers: Processes; as many as there are cores by default. 1 runs in this process.
        path: Folder where episodes are kept as they finish; those of the same set that it
            already holds are not simulated again.
        progress: Called with the number done and the number wanted.
        extra: Stored beside the episodes' info.
        goals: Goal of each episode in place of random ones, (num_episodes, n_goal); such episodes
            are not kept.
        is_standing: Whether episodes begin in the robot's own posture; takes goals.
        accept_code_change: Whether a folder's set goes on although other source code began it.
        **loop_options: For the task; part of what a folder's set is known by.

    Raises:
        ValueError: The folder holds another set or one of other source code, the task takes no
            goals, there is not one finite goal an episode, or a folder was given for what is not
            kept.
        EpisodeError: A system of the loop raised an error, which is its cause.
    """
    if path is not None and goals is not None:
        # What a folder holds is known by scenario, variation, options and seed alone.
        raise ValueError("run_episodes: episodes with goals are not kept; leave out 'path'")
    loop = scenario.make_loop(variation, **loop_options)
    if goals is not None:
        goals = _checked_goals(loop, goals, num_episodes)
    return collect_episodes(
        episodes_info(loop, seed, loop_options),
        num_episodes,
        lambda batch: (
            _episode_batch,
            scenario,
            variation,
            loop_options,
            seed,
            batch,
            None if goals is None else goals[batch],
            is_standing,
        ),
        num_workers=num_workers,
        path=path,
        progress=progress,
        extra=extra,
        accept_code_change=accept_code_change,
    )


def collect_episodes(
    info: EpisodesInfo,
    num_episodes: int,
    task: Callable[[list[int]], tuple],
    *,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | None = None,
    extra: dict[str, Any] | None = None,
    accept_code_change: bool = False,
) -> Episodes:
    """Has a set of episodes simulated in worker processes, but for those that a folder holds.

    Args:
        info: What the set shares.
        num_episodes: Size of the set.
        task: Gives, for the numbers of a few episodes, a function at module level and its
            arguments; it returns those episodes.
        num_workers: As :func:`run_episodes`, and so are all that follow.
        path: The folder.
        progress: What is called.
        extra: What is stored beside the info.
        accept_code_change: Whether other source code may have begun the set.
    """
    done = completed(path) & set(range(num_episodes)) if path is not None else set()
    remaining = [index for index in range(num_episodes) if index not in done]
    if progress is not None:
        progress(len(done), num_episodes)
    episodes: list[Episode] = []
    writer = None
    if path is not None:
        writer = EpisodeWriter(path, info, extra, accept_code_change=accept_code_change)
        episodes += (e for e in load_episodes(path) if e.index in done) if done else ()
    results = parallel_map(_call, [task(batch) for batch in batches(remaining)], num_workers)
    try:
        for batch in results:
            for episode in batch:
                episodes.append(episode)
                if writer is not None:
                    writer.append(episode)
            if progress is not None:
                progress(len(episodes), num_episodes)
    finally:
        results.close()
        if writer is not None:
            writer.close()
    collected = Episodes(info, sorted(episodes, key=lambda episode: episode.index))
    if collected.num_diverged:
        which = [episode.index for episode in collected if episode.cause == DIVERGED]
        _LOGGER.warning(
            "%d of %d simulations of '%s' diverged and say nothing about safety: episodes %s",
            len(which),
            num_episodes,
            info.scenario,
            ", ".join(map(str, which[:10])) + (", ..." if len(which) > 10 else ""),
        )
    return collected


def _call(function: Callable[..., list[Episode]], *arguments: Any) -> list[Episode]:
    return function(*arguments)


def _checked_goals(loop: ClosedLoop, goals: np.ndarray, num_episodes: int) -> np.ndarray:
    require(loop, HasGoals)
    goals = np.asarray(goals, dtype=float)
    if goals.ndim != 2 or len(goals) != num_episodes:
        raise ValueError(
            f"run_episodes: goals must be one row an episode, of {num_episodes} episodes; got "
            f"shape {goals.shape}"
        )
    is_finite = np.isfinite(goals).all(axis=1)
    if not is_finite.all():
        first = int(np.argmin(is_finite))
        raise ValueError(f"run_episodes: goals must be finite; goal {first} is {goals[first]}")
    return goals


def batches(indices: list[int]) -> list[list[int]]:
    """Cuts a list into what a worker takes at a time."""
    return [indices[i : i + _BATCH] for i in range(0, len(indices), _BATCH)]


def parallel_map(
    function: Callable[..., Any], arguments: list[tuple], num_workers: int | None = None
) -> Generator[Any, None, None]:
    """Calls ``function(*arguments[i])`` in worker processes; yields results as they finish.

    Every worker has one BLAS thread, this process too when it does the work, so results do not
    depend on the number of workers. On Ctrl-C or any error the workers end.

    Args:
        function: A function at module level.
        arguments: One tuple a call.
        num_workers: Processes; as many as there are cores by default.
    """
    import joblib
    from threadpoolctl import threadpool_limits

    num_workers = num_workers or joblib.cpu_count()
    if num_workers == 1 or len(arguments) <= 1:
        with threadpool_limits(1):
            for args in arguments:
                yield function(*args)
        return
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(
            n_jobs=num_workers, return_as="generator_unordered", batch_size=1
        )
        results = parallel(joblib.delayed(function)(*args) for args in arguments)
        try:
            for result in results:  # noqa: UP028 (`yield from` would hand Ctrl-C to joblib)
                yield result
        except BaseException:
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings():
                # Joblib says that not all results were consumed: that is what a stop means.
                warnings.simplefilter("ignore")
                results.close()
            raise


def _reduce_builtin(function: Any) -> Any:
    if type(function.__self__).__name__ == "PyCapsule":
        return getattr, (importlib.import_module(function.__module__), function.__name__)
    return function.__reduce__()


# Functions of a notebook or a script are sent to the workers with all that they use. Of pydrake
# two things lack a name that a worker could find them by: functions that it binds, such as
# StabilizingLQRController, and the metaclass of its systems, whose module does not exist.
copyreg.pickle(BuiltinFunctionType, _reduce_builtin)
_METACLASS = type(LeafSystem)
vars(sys.modules.setdefault(_METACLASS.__module__, ModuleType(_METACLASS.__module__))).setdefault(
    _METACLASS.__name__, _METACLASS
)


_LOOPS: dict[tuple, ClosedLoop] = {}


def worker_loop(scenario: Scenario, variation: str, options: dict[str, Any]) -> ClosedLoop:
    """The loop of a worker process, built once per scenario, variation, options and robot.

    The scenario's text does not say what stands in the robot's files; the hash does, but not what
    it leaves out, such as a threshold.
    """
    hash_ = scenario.simulation_hash(variation)
    key = (hash_, scenario.to_yaml(), variation, repr(sorted(options.items())))
    if key not in _LOOPS:
        _LOOPS.clear()
        _LOOPS[key] = scenario.make_loop(variation, **options)
    return _LOOPS[key]


def _episode_batch(
    scenario: Scenario,
    variation: str,
    options: dict[str, Any],
    seed: int,
    indices: list[int],
    goals: np.ndarray | None,
    is_standing: bool,
) -> list[Episode]:
    loop = worker_loop(scenario, variation, options)
    chosen = [None] * len(indices) if goals is None else list(goals)
    return [
        run_episode(loop, index, seed=seed, goal=goal, is_standing=is_standing)
        for index, goal in zip(indices, chosen, strict=True)
    ]
