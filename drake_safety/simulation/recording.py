"""Episodes of any diagram with the contract's output ports."""

import hashlib
import logging
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, PortDataType

from drake_safety.files.schema import check_times
from drake_safety.learning.segments import (
    Episode,
    EpisodeError,
    Episodes,
    EpisodesInfo,
    installed_versions,
)
from drake_safety.robots.family import FAMILY, plant_rng
from drake_safety.simulation.closed_loop import REQUIRED_PORTS, port_sizes
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import collect_episodes, loops_by_plant, seed_random_sources
from drake_safety.simulation.worker_processes import CloudPickled, MadeOnce, Progress
from drake_safety.systems.monitored_assessor import warn_of_sampled_ports

_LOGGER = logging.getLogger("drake_safety")
_OPTIONAL_PORTS = ("true_state", "desired_output", "features", "safe")

_MOST_ROWS = 50  # Rows between two samples of a preview, of which a wrong stride is searched for.

Reset = Callable[[Diagram, Context, np.random.Generator], int | None]


def record_episodes(
    make_diagram: Callable[..., Diagram],
    num_episodes: int,
    *,
    reset: Reset,
    duration_s: float,
    step_s: float,
    preview_stride: int = 1,
    parameters: Mapping[str, Any] | None = None,
    draw_plant: Callable[[np.random.Generator], Any] | None = None,
    plants: int = 64,
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

    The diagram exports the ports of a :class:`ClosedLoop`: ``state`` (n_s), ``output`` (n_z),
    ``desired_preview`` (H n_z; its size determines H) and ``margins`` (n_c). Optional ports are
    ``true_state``; ``desired_output``, by default the preview's first sample; ``features``; and
    ``safe``, below 1 once the state is unsafe, by default where a margin is negative.

    Episode i depends on the diagram, the seed and i alone; the first is simulated again after the
    second, and must be the same.

    Args:
        make_diagram: Builds the diagram in each worker; called with ``parameters``, after the plant
            if there is ``draw_plant``.
        reset: Called with diagram, root Context and generator; samples a start into the Context,
            the diagram's default one with seeded random sources of Drake; rows count from its time.
            It may return the first row whose future is undisturbed, if that is not 0.
        step_s: Time between two rows [s].
        preview_stride: Rows between two of the preview's H samples; `AssessmentParameters` needs
            the same ``horizon`` and ``preview_stride``.
        draw_plant: Draws a random plant by a generator; the set is of a family then, for the
            argument ``family`` of `SafetyAssessment.fit`.
        plants: Number of the family's plants; the episodes take turns on them.
        ports: Port names of the diagram by the names above, where they differ.
        state_names: Names of the n_s entries of ``state``; numbered by default.
        monitor_period_s: Sampling period of ``safe`` [s]; a tenth of ``step_s`` by default.
        num_workers, path, progress: As of `run_episodes`.

    Example: ``recorded = record_episodes(scenario.make_loop, 8, reset=type(loop).reset, **times)``
    """
    options: dict[str, Any] = {"num_workers": num_workers, "path": path, "progress": progress}
    info, make, run = prepare_recording(
        make_diagram,
        reset=reset,
        duration_s=duration_s,
        step_s=step_s,
        preview_stride=preview_stride,
        parameters=parameters,
        draw_plant=draw_plant,
        plants=plants,
        ports=ports,
        state_names=state_names,
        output_names=output_names,
        feature_names=feature_names,
        constraint_names=constraint_names,
        name=name,
        monitor_period_s=monitor_period_s,
        seed=seed,
    )
    episodes = collect_episodes(info, range(num_episodes), make, run, is_repeated=True, **options)
    episodes.warn()
    if stride := _better_stride(episodes):
        _LOGGER.warning(
            "the preview's second sample of '%s' is the first one %d rows later: pass "
            "preview_stride=%d; got %d",
            *(info.scenario, stride, stride, preview_stride),
        )
    if ended := [e.index for e in episodes if e.is_safe and e.num_steps < info.num_steps]:
        _LOGGER.warning(
            "a system of '%s' ended %d of %d episodes early, as episode %d, and they count as safe",
            *(info.scenario, len(ended), len(episodes), ended[0]),
        )
    return episodes


def prepare_recording(
    make_diagram: Callable[..., Diagram],
    *,
    reset: Reset,
    duration_s: float,
    step_s: float,
    preview_stride: int = 1,
    parameters: Mapping[str, Any] | None = None,
    draw_plant: Callable[[np.random.Generator], Any] | None = None,
    plants: int = 64,
    ports: Mapping[str, str] | None = None,
    state_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    feature_names: Sequence[str] | None = None,
    constraint_names: Sequence[str] | None = None,
    name: str | None = None,
    monitor_period_s: float | None = None,
    seed: int = 0,
) -> tuple[EpisodesInfo, MadeOnce[Any], Callable[..., Episode]]:
    """Prepares `record_episodes`: metadata, the diagram, and its run of an episode.

    The run is called with the diagram, an index and perhaps ``draws``; see `run_episode`.
    """
    name = str(name or getattr(make_diagram, "__name__", type(make_diagram).__name__))
    period_s = step_s / 10 if monitor_period_s is None else monitor_period_s
    check_times("record_episodes", duration_s=duration_s, step_s=step_s, monitor_period_s=period_s)
    num_steps = round(duration_s / step_s)
    if num_steps < 1 or abs(duration_s / step_s - num_steps) > 0.01:
        times = f"got {duration_s} and {step_s}"
        raise ValueError(f"record_episodes: duration_s must be a multiple of step_s; {times}")
    for what, count in {"preview_stride": preview_stride, "plants": plants}.items():
        if count < 1 or int(count) != count:
            raise ValueError(f"record_episodes: {what} must be an integer from 1 on; got {count}")
    # The diagram is built anew for each call: a function does not tell whether its result changed.
    key = uuid.uuid4().hex
    build = partial(make_diagram, **dict(parameters or {}))
    make: MadeOnce[Any] = MadeOnce(key, CloudPickled(build))
    if draw_plant is not None:
        sampler = draw_plant
        make = loops_by_plant(key, lambda number: build(sampler(plant_rng(seed, number))))
    first = make() if draw_plant is None else make()(1)
    if not isinstance(first, Diagram):
        got = type(first).__name__
        raise ValueError(f"record_episodes: make_diagram must return a Diagram; got {got}")
    warn_of_sampled_ports("record_episodes", [first])
    used, sizes = _used_ports(first, dict(ports or {}))
    # As the hash has always been made of it, so that kept sets stay valid.
    timing = f"EpisodeTiming({step_s=}, {num_steps=}, monitor_period_s={period_s!r})"
    identity = f"({name!r}, {timing}, {used}, {sorted((parameters or {}).items())})"
    identity += f", {preview_stride=}" * (preview_stride != 1)
    horizon = sizes["desired_preview"] // sizes["output"]
    info = EpisodesInfo(
        scenario=name,
        scenario_hash=hashlib.sha256(identity.encode()).hexdigest(),
        variation="nominal" if draw_plant is None else FAMILY,
        seed=seed,
        step_s=step_s,
        horizon=horizon,
        preview_stride=preview_stride,
        state_names=_names("state", state_names, sizes["state"]),
        output_names=_names("output", output_names, sizes["output"]),
        feature_names=_names("feature", feature_names, sizes.get("features", 0)),
        constraint_names=_names("constraint", constraint_names, sizes["margins"]),
        versions=installed_versions("drake", "numpy"),
        num_steps=num_steps,
        plants=0 if draw_plant is None else plants,
    )
    start = CloudPickled(reset)

    def run(diagram: Diagram, index: int, draws: np.random.Generator | None = None) -> Episode:
        who = f"episode {index} of '{name}' (seed {seed})"

        def begin(context: Context) -> int | None:
            rng = seed_random_sources(diagram, context, seed, index, draws)
            try:
                row = start(diagram, context, rng)
                if row is not None and not (int(row) == row and 0 <= row <= num_steps):
                    raise ValueError(f"expected the first row, 0 to {num_steps}; got {row!r}")
                return row
            except Exception as error:
                raise EpisodeError(f"{who}, reset: {type(error).__name__}: {error}") from error

        return simulate(
            diagram,
            begin,
            used,
            End(duration_s=num_steps * step_s, after_leaving_s=0.0),
            step_s=step_s,
            watch_period_s=period_s,
            constraint_names=info.constraint_names,
            may_fail=True,
            index=index,
            who=who,
        ).episode()

    return info, make, run


def _better_stride(episodes: Episodes) -> int:
    """Rows after which the preview's second sample is its first one; 0 if the stated ones fit."""
    n_z, stated = len(episodes.info.output_names), episodes.info.preview_stride

    def agreement(stride: int) -> float:
        """Share of the rows with a moving plan on which it is so."""
        fits: list[bool] = []
        for preview in (episode.desired_preview for episode in episodes[:8]):
            ahead, later = preview[:-stride, n_z : 2 * n_z], preview[stride:, :n_z]
            moves = ~np.isclose(ahead, preview[:-stride, :n_z]).all(axis=1)
            fits += np.isclose(ahead, later).all(axis=1)[moves].tolist()
        return float(np.mean(fits)) if fits else 0.0

    if episodes.info.horizon < 2 or agreement(stated) > 0.5:
        return 0
    best = max(range(1, _MOST_ROWS), key=agreement)
    return best if agreement(best) > 0.9 else 0


def _used_ports(diagram: Diagram, given: dict[str, str]) -> tuple[dict[str, str], dict[str, int]]:
    if unknown := set(given) - set(REQUIRED_PORTS):
        raise ValueError(f"record_episodes: no ports {sorted(unknown)} in {REQUIRED_PORTS}")
    there = port_sizes(diagram)
    used = {
        name: given.get(name, name)
        for name in REQUIRED_PORTS
        if name in given or name in there or name not in _OPTIONAL_PORTS
    }
    if missing := {name: port for name, port in used.items() if port not in there}:
        named, ports = sorted(missing), sorted(missing.values())
        text = f"no port {ports} for {named}; it exports {sorted(there)}"
        raise ValueError(f"record_episodes: the diagram exports {text}")
    sizes = {name: there[port] for name, port in used.items()}
    types = {port: diagram.GetOutputPort(port).get_data_type() for port in used.values()}
    if abstract := [port for port, one in types.items() if one == PortDataType.kAbstractValued]:
        raise ValueError(f"record_episodes: ports {abstract} must have vectors")
    if min(sizes["state"], sizes["margins"]) < 1 or sizes.get("safe", 1) != 1:
        text = f"state and margins need entries, and safe has one; got {sizes}"
        raise ValueError(f"record_episodes: {text}")
    n_z, n_preview = sizes["output"], sizes["desired_preview"]
    if n_z < 1 or n_preview < 1 or n_preview % n_z:
        raise ValueError(f"record_episodes: size {n_preview} of desired_preview is not H * {n_z}")
    return used, sizes


def _names(what: str, given: Sequence[str] | None, size: int) -> list[str]:
    names = [f"{what}_{i}" for i in range(size)] if given is None else list(given)
    if len(names) != size:
        raise ValueError(f"record_episodes: {what}_names has {len(names)} names; expected {size}")
    return names
