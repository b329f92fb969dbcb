"""Two closed loops in the same episodes, pair by pair, until a verdict is known."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from itertools import zip_longest
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.outcomes import UNSAFE, Metric, Outcome, OutcomeReader
from drake_safety.evaluation.paired_test import interim_estimate
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import GATE
from drake_safety.learning.segments import Episode, EpisodeError
from drake_safety.simulation.capabilities import CanStartAnywhere
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from drake_safety.simulation.rollouts import check_kept, episodes_info, run_episode
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import MadeOnce, Progress, map_items

WORSE, BETTER, NOT_WORSE, UNDECIDED = "worse", "better", "not worse", "undecided"
_LOOK = 16  # Pairs between two looks.
_BATCH = 2  # Pairs sent to a worker at a time.
_SAME = 1e-9  # Largest difference of two starts, by the rounding of two engines.


class ComparedPlant(NamedTuple):
    """A scenario, and the plant that is simulated."""

    scenario: Scenario
    variation: str = "nominal"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Estimates for a candidate after a number of pairs, in some of which both fail alike."""

    verdict: str
    pairs: int
    both: int
    difference: list[Estimate]  # Mean outcome of the candidate minus the baseline's at each look.
    newly_failing: list[Outcome]
    """Episodes in which the candidate does worse, by time, with Γ's belief of the baseline's."""
    no_longer_failing: list[Outcome]
    worse_by: float
    outcomes: list[tuple[Outcome, Outcome]]  # All pairs, the baseline's outcome first.
    is_paired: bool = True  # Whether both outcomes of a pair belong to the same episode.


def compare_loops(
    baseline: ComparedPlant | Scenario,
    candidate: ComparedPlant | Scenario,
    *,
    metric: Metric = UNSAFE,
    worse_by: float = 0.02,
    alpha: float = 0.05,
    max_pairs: int = 2000,
    seed: int = GATE.first,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    assessment: SafetyAssessment | None = None,
    each_look: Callable[[Verdict], object] = lambda verdict: None,
) -> Verdict:
    """Simulates two closed loops in the same episodes until it is known which one fails more.

    Every 16 pairs it looks at a confidence sequence of the difference of their failure rates:
    *worse* means that it is above 0, *better* below 0, *not worse* below `worse_by`.

    Args:
        metric: A `Metric`: unsafe, fall, a constraint, tracking=BOUND [m], or a function.
        alpha: Probability that a verdict of each kind is wrong; with k candidates pass alpha / k.
        path: Folder in which episodes are kept.
        assessment: Γ of the baseline's scenario, which says whether a change was foreseen.
        each_look: Called with the verdict so far.

    Example: ``verdict = compare_loops(scenario, heavier_scenario, max_pairs=4, num_workers=1)``
    """
    check_levels(worse_by, alpha)
    first, second = (
        ComparedPlant(one) if isinstance(one, Scenario) else one for one in (baseline, candidate)
    )
    check_pair(pair := (first, second), metric=metric, seed=seed)
    hashes = [scenario.simulation_hash(variation) for scenario, variation in pair]
    # The texts say what the hashes leave out.
    texts = (scenario.to_yaml() for scenario, _ in pair)
    make = MadeOnce((*hashes, *texts), lambda: [make_paired(pair, side) for side in (0, 1)])
    loops = make()
    readers = [OutcomeReader(loops[0], metric, gamma) for gamma in (assessment, None)]
    simulated = {"seed": seed} | readers[0].simulated
    runs: list[dict[int, Outcome]] = [{}, {}]
    with ExitStack() as stack:
        writers = []
        for side, outcomes in enumerate(runs if path is not None else []):
            options = _pair_options(pair, side) | readers[0].simulated
            if "starts_of" in options:
                options["starts_of"] = hashes[0]
            info = episodes_info(loops[side], seed, options)
            folder = Path(path or "") / f"{info.scenario_hash[:12]}-{seed}"
            writers.append(stack.enter_context(EpisodeWriter(folder, info)))
            if kept := [episode for episode in load_episodes(folder) if episode.index < max_pairs]:
                check_kept(folder, kept, partial(run_episode, loops[side], **simulated))
            outcomes.update({episode.index: readers[side].read(episode) for episode in kept})
        missing = ((index, [index not in known for known in runs]) for index in range(max_pairs))
        items = [item for item in missing if any(item[1])]
        results = map_items(
            partial(_run_pair, **simulated),
            items,
            make=make,
            num_workers=num_workers,
            batch_size=_BATCH,
            progress=progress,
            num_done=max_pairs - len(items),
            stage="pairs",
        )
        stack.enter_context(closing(results))
        looks: list[Estimate] = []
        for number in sorted({*range(_LOOK, max_pairs, _LOOK), max_pairs}):
            while not all(index in known for known in runs for index in range(number)):
                for side, episode in enumerate(next(results)):
                    if episode is not None:
                        runs[side][episode.index] = readers[side].read(episode)
                        if writers:
                            writers[side].append(episode)
            pairs = [(runs[0][index], runs[1][index]) for index in range(number)]
            apart = [after.value - before.value for before, after in pairs]
            looks.append(interim_estimate(apart, looks, alpha))
            verdict = verdict_of(pairs, looks, worse_by)
            each_look(verdict)
            if verdict.verdict != UNDECIDED:
                break
    return verdict


def check_levels(worse_by: float, alpha: float) -> None:
    """Checks the difference that matters and the probability of an error."""
    if not (0.0 < worse_by < 1.0 and 0.0 < alpha < 1.0):
        raise ValueError(f"worse_by and alpha must be in (0, 1); got {worse_by} and {alpha}")


def check_pair(
    pair: tuple[ComparedPlant, ComparedPlant], *, metric: Metric = UNSAFE, seed: int = GATE.first
) -> None:
    """Builds two loops and begins their first episode, before hours of simulations."""
    hashes = [scenario.simulation_hash(variation) for scenario, variation in pair]
    if hashes[0] == hashes[1]:
        what = f"scenario '{pair[0].scenario.name}', variation '{pair[0].variation}'"
        raise ValueError(f"the candidate is the baseline: {what}")
    starts = []
    for side, who in enumerate(("baseline", "candidate")):
        loop = make_paired(pair, side)
        OutcomeReader(loop, metric)

        def after_one_step(context: Context, loop: ClosedLoop = loop) -> EventStatus:
            is_over = context.get_time() > 0.0
            return EventStatus.ReachedTermination(loop, "") if is_over else EventStatus.DidNothing()

        try:
            starts.append(_run_with_start(loop, 0, seed=seed, monitor=after_one_step)[1])
        except EpisodeError as error:
            raise ValueError(f"the {who}: {error}") from error
    _check_alike(0, loop, *starts)


def verdict_of(
    pairs: Sequence[tuple[Outcome, Outcome]], looks: Sequence[Estimate], worse_by: float
) -> Verdict:
    """Judges all pairs so far, the baseline's outcomes first."""
    low, high = looks[-1].low, looks[-1].high
    known = WORSE if low > 0.0 else BETTER if high < 0.0 else NOT_WORSE
    newly = [replace(two, belief=one.belief) for one, two in pairs if two.value > one.value]
    no_longer = [one for one, two in pairs if two.value < one.value]
    return Verdict(
        verdict=known if high < worse_by or known == WORSE else UNDECIDED,
        pairs=len(pairs),
        both=sum(one.value == two.value > 0.0 for one, two in pairs),
        difference=[*looks],  # Later looks do not change it.
        newly_failing=sorted(newly, key=lambda one: one.time_s),
        no_longer_failing=sorted(no_longer, key=lambda one: one.time_s),
        worse_by=worse_by,
        outcomes=[*pairs],
    )


def make_paired(pair: tuple[ComparedPlant, ComparedPlant], side: int, **options: Any) -> ClosedLoop:
    """Makes the baseline, side 0, or the candidate, side 1, whose starts are the baseline's."""
    scenario, variation = pair[side]
    return scenario.make_loop(variation, **(_pair_options(pair, side) | options))


def _pair_options(pair: tuple[ComparedPlant, ComparedPlant], side: int) -> dict[str, Any]:
    """Options of one of two loops; the candidate may take the baseline's starts."""
    one, two = (scenario.options_for("pairs", variation) for scenario, variation in pair)
    # Whether a task's starts depend on its controller, and can be another's.
    takes_starts = "starts_of" in signature(pair[side].scenario.task_class()).parameters
    return one | two | ({"starts_of": pair[0].scenario} if side and takes_starts else {})


def _run_pair(
    loops: Sequence[ClosedLoop], item: tuple[int, list[bool]], **options: Any
) -> list[Episode | None]:
    """The episodes of a pair that are missing; the starts of both are compared."""
    index, is_missing = item
    starts, episodes = [], []
    for loop, is_wanted in zip(loops, is_missing, strict=True):
        short: dict[str, Any] = {} if is_wanted else {"until_first_row": True}
        episode, start = _run_with_start(loop, index, **options, **short)
        episodes.append(episode if is_wanted else None)
        starts.append(start)
    _check_alike(index, loops[0], *starts)
    return episodes


def _run_with_start(
    loop: ClosedLoop, index: int, **options: Any
) -> tuple[Episode, dict[str, np.ndarray]]:
    start: dict[str, np.ndarray] = {}
    episode = run_episode(
        loop, index, at_start=lambda context: start.update(_start_of(loop, context)), **options
    )
    return episode, start


def _start_of(loop: ClosedLoop, context: Context) -> dict[str, np.ndarray]:
    """State, plan and disturbances at the start of an episode."""
    ports = {"state": "true_state", "plan": "desired_preview", "margin": "margins"}
    start = {name: np.array(loop.GetOutputPort(port).Eval(context)) for name, port in ports.items()}
    if isinstance(loop, CanStartAnywhere):
        plan, scenario = loop.start_of(context).plan, loop.scenario
        times_s = scenario.step_s * np.arange(scenario.num_steps + 1)
        start["plan"] = np.concatenate([plan.value(time_s).ravel() for time_s in times_s])
    return start | loop.disturbances(context)


def _check_alike(
    index: int, loop: ClosedLoop, baseline: dict[str, np.ndarray], other: dict[str, np.ndarray]
) -> None:
    """Raises an error that names the first difference of two starts."""
    names = {"state": loop.state_names, "margin": loop.constraint_names}
    for what in dict.fromkeys([*baseline, *other]):
        arrays: list[Any] = [start.get(what, []) for start in (baseline, other)]
        for k, (one, two) in enumerate(zip_longest(*arrays, fillvalue=math.nan)):
            if not abs(one - two) <= _SAME:
                name = f" ({names[what][k]})" if what in names else ""
                raise ValueError(
                    f"pair {index} does not start alike in both loops: entry {k}{name} of '{what}' "
                    f"is {one:.6g} in the baseline and {two:.6g} in the candidate"
                )
