"""Episodes of any diagram with the contract's output ports."""

from __future__ import annotations

import hashlib
import logging
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_safety.files.schema import check_times
from drake_safety.learning.segments import (
    Episode,
    EpisodeError,
    Episodes,
    EpisodesInfo,
    installed_versions,
)
from drake_safety.simulation.closed_loop import REQUIRED_PORTS, port_sizes
from drake_safety.simulation.motion import simulate
from drake_safety.simulation.rollouts import collect_episodes, episode_rng, seed_random_sources
from drake_safety.simulation.worker_processes import MadeOnce, Progress, Sent
from drake_safety.systems.monitored_assessor import warn_of_sampled_ports

_LOGGER = logging.getLogger("drake_safety")
_OPTIONAL_PORTS = ("true_state", "desired_output", "features", "safe")

Reset = Callable[[Diagram, Context, np.random.Generator], int | None]
"""Samples a start into the root Context; see :func:`record_episodes`."""


def record_episodes(
    make_diagram: Callable[..., Diagram],
    num_episodes: int,
    *,
    reset: Reset,
    duration_s: float,
    step_s: float,
    parameters: Mapping[str, Any] | None = None,
    ports: Mapping[str, str] | None = None,
    state_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    feature_names: Sequence[str] | None = None,
    constraint_names: Sequence[str] | None = None,
    name: str | None = None,
    monitor_period_s: float | None = None,
    seed: int = 0,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
) -> Episodes:
    """Simulates a set of episodes of any diagram, in worker processes.

    The diagram exports, under these names or those of ``ports``, the ports ``state`` (n_s),
    ``output`` (n_z), ``desired_preview`` (H n_z; its size determines H) and ``margins`` (n_c), as a
    :class:`ClosedLoop` does. Optional are ``true_state``, by default ``state``, ``desired_output``,
    by default the first sample of the preview, ``features`` of the assessor, by default none, and
    ``safe``, below 1 once the state is unsafe, by default where a margin is negative.

    A row has the values of the ports at its time; a port that is sampled and held has its last
    sample. Episode i depends on the diagram, the seed and i alone: its arrays are identical for
    any number of workers. The first one is simulated again after the second: an error names the
    system whose output differs first.

    Args:
        make_diagram: Builds the diagram; called with ``parameters``, once in each worker, and once
            more for the repetition of the first episode.
        reset: Called with diagram, root Context and generator; samples a start into the Context,
            the diagram's default one with seeded random sources of Drake; rows count from its time.
            It may return the first row whose future is undisturbed, if that is not 0.
        step_s: Time between two rows, the unit of H [s].
        ports: The diagram's port names, by those above.
        state_names: Names of the n_s entries of ``state``; numbered by default.
        name: Name of the set; that of ``make_diagram`` by default.
        monitor_period_s: Sampling period of ``safe`` [s]; a tenth of ``step_s`` by default.
        num_workers: Number of processes; that of cores by default. 1 runs in this process.
        path: Folder for the episodes; those of the same set that it already holds are kept. A set
            is identified by name, parameters, ports, times and seed, and by one of its episodes,
            which is simulated again and must be the same to the last bit.

    Returns:
        The episodes, for ``SafetyAssessment.fit``. Those whose simulation failed have the cause
        ``diverged`` and are counted in a warning.

    Raises:
        ValueError: A port is missing or its size fits no other, the number of names is not that
            of the entries, a time is out of range, the folder holds another set or one of another
            diagram, or the diagram keeps state outside its Context.
        EpisodeError: A system of the diagram or ``reset`` raised an error, which is its cause.
    """
    name = str(name or getattr(make_diagram, "__name__", type(make_diagram).__name__))
    period_s = step_s / 10 if monitor_period_s is None else monitor_period_s
    check_times("record_episodes", duration_s=duration_s, step_s=step_s, monitor_period_s=period_s)
    if round(duration_s / step_s) < 1:
        raise ValueError(
            f"record_episodes: an episode has at least one step; got duration_s {duration_s} and "
            f"step_s {step_s}"
        )
    num_steps = round(duration_s / step_s)
    # The diagram is built anew for each call: a function does not tell whether its result changed.
    key = uuid.uuid4().hex
    make = MadeOnce(key, Sent(partial(make_diagram, **dict(parameters or {}))))
    warn_of_sampled_ports("record_episodes", [make()])
    used, sizes = _used_ports(make(), dict(ports or {}))
    # As the hash has always been made of it, so that kept sets stay valid.
    timing = f"EpisodeTiming({step_s=}, {num_steps=}, monitor_period_s={period_s!r})"
    identity = f"({name!r}, {timing}, {used}, {sorted((parameters or {}).items())})"
    horizon = sizes["desired_preview"] // sizes["output"]
    if num_steps < horizon:
        _LOGGER.warning(
            "record_episodes: episodes of %d steps are shorter than the preview of %d; fit needs "
            "longer ones, or a `shortest_segment`",
            *(num_steps, horizon),
        )
    info = EpisodesInfo(
        scenario=name,
        scenario_hash=hashlib.sha256(identity.encode()).hexdigest(),
        variation="nominal",
        seed=seed,
        step_s=step_s,
        horizon=horizon,
        state_names=_names("state", state_names, sizes["state"]),
        output_names=_names("output", output_names, sizes["output"]),
        feature_names=_names("feature", feature_names, sizes.get("features", 0)),
        constraint_names=_names("constraint", constraint_names, sizes["margins"]),
        versions=installed_versions("drake", "numpy"),
        num_steps=num_steps,
    )
    episodes = collect_episodes(
        info,
        range(num_episodes),
        make,
        partial(_record, reset=Sent(reset), ports=used, watch_period_s=period_s, info=info),
        num_workers=num_workers,
        path=path,
        progress=progress,
        is_repeated=True,
    )
    episodes.warn()
    if ended := [one.index for one in episodes if one.is_safe and one.num_steps < num_steps]:
        _LOGGER.warning(
            "a system of '%s' ended %d of %d episodes early, as episode %d, and they count as safe",
            *(name, len(ended), len(episodes), ended[0]),
        )
    return episodes


def _record(
    diagram: Diagram,
    index: int,
    *,
    reset: Reset,
    ports: dict[str, str],
    watch_period_s: float,
    info: EpisodesInfo,
    monitor: Callable[[Context], None] | None = None,
) -> Episode:
    who = f"episode {index} of '{info.scenario}' (seed {info.seed})"

    def start(context: Context) -> int | None:
        seed_random_sources(diagram, context, info.seed, index)
        try:
            return reset(diagram, context, episode_rng(info.seed, index))
        except Exception as error:
            raise EpisodeError(f"{who}, reset: {type(error).__name__}: {error}") from error

    return simulate(
        diagram,
        start,
        ports,
        duration_s=info.num_steps * info.step_s,
        step_s=info.step_s,
        watch_period_s=watch_period_s,
        after_leaving_s=0.0,
        monitor=monitor,
        constraint_names=info.constraint_names,
        may_fail=True,
        index=index,
        who=who,
    ).episode()


def _used_ports(diagram: Diagram, given: dict[str, str]) -> tuple[dict[str, str], dict[str, int]]:
    """The diagram's names of the contract's ports, and their sizes."""
    if unknown := set(given) - set(REQUIRED_PORTS):
        raise ValueError(
            f"record_episodes: ports has {sorted(unknown)}; expected some of {REQUIRED_PORTS}"
        )
    there = port_sizes(diagram)
    used = {name: given.get(name, name) for name in REQUIRED_PORTS}
    missing = {
        name: port
        for name, port in used.items()
        if port not in there and (name in given or name not in _OPTIONAL_PORTS)
    }
    if missing:
        raise ValueError(
            f"record_episodes: the diagram exports no port {sorted(missing.values())} for "
            f"{sorted(missing)}; it exports {sorted(there)}. Call builder.ExportOutput(port, NAME) "
            "for each, or give its name by 'ports'"
        )
    used = {name: port for name, port in used.items() if port in there}
    sizes = {name: there[port] for name, port in used.items()}
    n_z = sizes["output"]
    expected = {"true_state": sizes["state"], "desired_output": n_z, "safe": 1}
    for name, size in expected.items():
        if sizes.get(name, size) != size:
            raise ValueError(
                f"record_episodes: port '{used[name]}' for {name} has size {sizes[name]}; "
                f"expected {size}"
            )
    if n_z < 1 or sizes["desired_preview"] < 1 or sizes["desired_preview"] % n_z:
        raise ValueError(
            f"record_episodes: port '{used['desired_preview']}' has size "
            f"{sizes['desired_preview']}; expected H times the size {n_z} of the output"
        )
    return used, sizes


def _names(what: str, given: Sequence[str] | None, size: int) -> list[str]:
    if given is None:
        return [f"{what}_{i}" for i in range(size)]
    if len(given) != size:
        raise ValueError(
            f"record_episodes: {what}_names has {len(given)} names, the port has {size} entries"
        )
    return list(given)
