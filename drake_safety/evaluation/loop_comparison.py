"""Two closed loops in the same episodes, pair by pair, until a verdict is known."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.evaluation.outcomes import UNSAFE, Metric, Outcome, Outcomes
from drake_safety.evaluation.paired_test import ConfidenceSequence
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import GATE
from drake_safety.learning.segments import Episode
from drake_safety.simulation.capabilities import CanStartAnywhere, HasDisturbances
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from drake_safety.simulation.rollouts import check_kept, episode_rng, episodes_info, run_episode
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import MadeOnce, Progress, map_items

WORSE, BETTER, NOT_WORSE, UNDECIDED = "worse", "better", "not worse", "undecided"
_LOOK = 16  # Pairs between two looks.
_BATCH = 2  # Pairs sent to a worker at a time.
_SAME = 1e-9  # Largest difference of two starts, by the rounding of two engines.


class Loop(NamedTuple):
    """A closed loop: a scenario and its plant."""

    scenario: Scenario
    variation: str = "nominal"


class Commanded(NamedTuple):
    """The pairs in which an entry of the desired output is in a range, a third of all."""

    output: str
    low: float
    high: float
    pairs: int
    newly_failing: int
    no_longer_failing: int


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is known of a candidate after a number of pairs.

    Attributes:
        verdict: "worse", "better", "not worse" (by `worse_by`), or "undecided". Each is wrong with
            a probability of at most alpha, whenever one looks.
        neither, both: Numbers of pairs in which neither fails, and both alike.
        difference: Mean outcome of the candidate minus that of the baseline, and its alpha.
        survival_s: The same of the time until the failure, or the end [s].
        newly_failing: The candidate's episodes that fail, or do worse than the baseline's, by time,
            with Γ's belief at the baseline's start.
        no_longer_failing: The baseline's that do worse.
        by_command: The same by what was commanded.
    """

    verdict: str
    neither: int
    both: int
    difference: ConfidenceSequence
    survival_s: ConfidenceSequence
    newly_failing: list[Outcome]
    no_longer_failing: list[Outcome]
    by_command: list[Commanded]
    worse_by: float

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return self.difference.pairs[-1]


def compare_loops(
    baseline: Loop | Scenario,
    candidate: Loop | Scenario,
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

    The loops of a pair have the same start, plan, disturbances and random generator. Every 16
    pairs it looks at a confidence sequence of the difference of their failure rates: *worse* means
    that it is above 0, *better* below 0, *not worse* below `worse_by`.

    Args:
        metric: What counts as a failure. A diverged simulation does, but for a function.
        worse_by: The difference that would matter, in (0, 1).
        alpha: Probability of a wrong verdict, of each kind. With k candidates pass alpha / k.
        max_pairs: Number of pairs after which it is undecided.
        path: Folder in which episodes are kept; those that it holds are not simulated again.
        assessment: Γ of the baseline's scenario, which says whether a change was foreseen.
        each_look: Called with what is known at each look.

    Raises:
        ValueError: Both are the same, there is no such metric, or the starts, plans or disturbances
            of a pair differ.
        EpisodeError: A system of a loop raised an error, which is its cause.
    """
    for name, value in {"worse_by": worse_by, "alpha": alpha}.items():
        if not 0.0 < value < 1.0:
            raise ValueError(f"compare_loops: {name} must be between 0 and 1; got {value}")
    if max_pairs < 1:
        raise ValueError(f"compare_loops: max_pairs must be at least 1; got {max_pairs}")
    one, two = (Loop(x) if isinstance(x, Scenario) else x for x in (baseline, candidate))
    hashes = [scenario.simulation_hash(variation) for scenario, variation in (one, two)]
    if hashes[0] == hashes[1]:
        raise ValueError(
            f"the candidate is the baseline: scenario '{one.scenario.name}', variation "
            f"'{one.variation}', with hash {hashes[0][:12]}"
        )
    # The texts say what the hashes leave out.
    texts = (scenario.to_yaml() for scenario, _ in (one, two))
    make = MadeOnce((*hashes, *texts), partial(_make_both, (one, two)))
    loops = make()
    readers = Outcomes(loops[0], metric, assessment), Outcomes(loops[0], metric)
    options = readers[0].simulated
    run = partial(make.run, _run_pair, seed=seed, **options)
    starts = {"starts_of": hashes[0]} if _takes_starts(two.scenario) else {}
    runs: tuple[dict[int, Outcome], ...] = ({}, {})

    def again(side: int, index: int) -> Any:
        return run((index, [side == 0, side == 1]))[side]

    with ExitStack() as stack:
        writers = []
        for side in (0, 1) if path is not None else ():
            known = _pair_options((one, two)) | options | (starts if side else {})
            info = episodes_info(loops[side], seed, known)
            folder = Path(path or "") / f"{info.scenario_hash[:12]}-{seed}"
            writers.append(stack.enter_context(EpisodeWriter(folder, info)))
            if kept := [episode for episode in load_episodes(folder) if episode.index < max_pairs]:
                check_kept(folder, kept, partial(again, side))
            runs[side].update({episode.index: readers[side].of(episode) for episode in kept})
        is_missing = ((index, [index not in each for each in runs]) for index in range(max_pairs))
        items = [item for item in is_missing if any(item[1])]
        found = map_items(
            run,
            items,
            num_workers=num_workers,
            batch_size=_BATCH,
            progress=progress,
            num_done=max_pairs - len(items),
            stage="pairs",
        )
        results = stack.enter_context(closing(found))
        difference = ConfidenceSequence(alpha)
        survival_s = ConfidenceSequence(alpha, one.scenario.episode_duration_s)
        for index in range(max_pairs):
            while not all(index in each for each in runs):
                for side, episode in enumerate(next(results)):
                    if episode is not None:
                        runs[side][episode.index] = readers[side].of(episode)
                        if writers:
                            writers[side].append(episode)
            if (index + 1) % _LOOK == 0 or index + 1 == max_pairs:
                pairs = [(runs[0][i], runs[1][i]) for i in range(index + 1)]
                verdict = _look(pairs, difference, survival_s, worse_by, loops[0].output_names)
                each_look(verdict)
                if verdict.verdict != UNDECIDED:
                    break
    return verdict


def _look(
    pairs: Sequence[tuple[Outcome, Outcome]],
    difference: ConfidenceSequence,
    survival_s: ConfidenceSequence,
    worse_by: float,
    output_names: Sequence[str],
) -> Verdict:
    """Looks at all pairs so far; later looks do not change what is returned."""
    outcomes = np.array([[one.value for one in pair] for pair in pairs])
    apart = outcomes[:, 1] - outcomes[:, 0]
    difference.look(apart)
    survival_s.look(np.array([two.time_s - one.time_s for one, two in pairs]))
    is_known = {
        WORSE: difference.low[-1] > 0.0,
        BETTER: difference.high[-1] < 0.0,
        NOT_WORSE: difference.high[-1] < worse_by,
        UNDECIDED: True,
    }
    newly = [replace(two, belief=one.belief) for one, two in pairs if two.value > one.value]
    no_longer = [one for one, two in pairs if two.value < one.value]
    return Verdict(
        verdict=next(name for name, is_so in is_known.items() if is_so),
        neither=int((outcomes == 0).all(axis=1).sum()),
        both=int(((outcomes > 0).all(axis=1) & (apart == 0)).sum()),
        difference=deepcopy(difference),
        survival_s=deepcopy(survival_s),
        newly_failing=sorted(newly, key=lambda one: one.time_s),
        no_longer_failing=sorted(no_longer, key=lambda one: one.time_s),
        by_command=_by_command(output_names, pairs, apart),
        worse_by=worse_by,
    )


def _by_command(
    names: Sequence[str], pairs: Sequence[tuple[Outcome, Outcome]], apart: np.ndarray
) -> list[Commanded]:
    """Changes in each third of what was commanded; fewer parts of a command with few values."""
    found = []
    for name, values in zip(names, np.array([one.commanded for one, _ in pairs]).T, strict=True):
        third = np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values)
        for part in (third == k for k in np.unique(third)):
            ends = float(values[part].min()), float(values[part].max())
            counts = (int((part & is_so).sum()) for is_so in (apart == apart, apart > 0, apart < 0))
            found.append(Commanded(name, *ends, *counts))
    return found


def make_paired(pair: tuple[Loop, Loop], side: int, **options: Any) -> ClosedLoop:
    """Makes the baseline, side 0, or the candidate, side 1, whose starts are the baseline's."""
    scenario, variation = pair[side]
    if side and _takes_starts(scenario):
        options["starts_of"] = pair[0].scenario
    return scenario.make_loop(variation, **(_pair_options(pair) | options))


def _pair_options(pair: tuple[Loop, Loop]) -> dict[str, Any]:
    one, two = (scenario.options_for("pairs", variation) for scenario, variation in pair)
    return one | two


def _takes_starts(scenario: Scenario) -> bool:
    """Whether a task's starts depend on its controller, and can be another's."""
    return "starts_of" in inspect.signature(scenario.task_class()).parameters


def _make_both(pair: tuple[Loop, Loop]) -> tuple[ClosedLoop, ClosedLoop]:
    return make_paired(pair, 0), make_paired(pair, 1)


def _run_pair(
    loops: tuple[ClosedLoop, ClosedLoop], item: tuple[int, list[bool]], **options: Any
) -> list[Episode | None]:
    """The episodes of a pair that are missing; the starts of both are compared."""
    index, is_missing = item
    starts: list[dict[str, np.ndarray]] = []
    episodes: list[Episode | None] = []
    for loop, is_wanted in zip(loops, is_missing, strict=True):

        def at_start(context: Context, loop: ClosedLoop = loop) -> None:
            starts.append(_start_of(loop, context))

        if is_wanted:
            episodes.append(run_episode(loop, index, at_start=at_start, **options))
        else:
            context = loop.CreateDefaultContext()
            loop.reset(context, episode_rng(options["seed"], index))
            at_start(context)
            episodes.append(None)
    _check_alike(index, loops[0], *starts)
    return episodes


def _start_of(loop: ClosedLoop, context: Context) -> dict[str, np.ndarray]:
    """State, plan and disturbances at the start of an episode."""
    ports = {"state": "true_state", "plan": "desired_preview", "margin": "margins"}
    start = {name: np.array(loop.GetOutputPort(port).Eval(context)) for name, port in ports.items()}
    if isinstance(loop, CanStartAnywhere):
        plan, scenario = loop.start_of(context).plan, loop.scenario
        times_s = scenario.step_s * np.arange(scenario.num_steps + 1)
        start["plan"] = np.concatenate([plan.value(time_s).ravel() for time_s in times_s])
    return start | (loop.disturbances(context) if isinstance(loop, HasDisturbances) else {})


def _check_alike(
    index: int, loop: ClosedLoop, baseline: dict[str, np.ndarray], other: dict[str, np.ndarray]
) -> None:
    """Raises an error that names the first difference of two starts."""
    who = f"pair {index} does not start alike in both loops"
    for what in dict.fromkeys([*baseline, *other]):
        one, two = baseline.get(what, np.empty(0)), other.get(what, np.empty(0))
        if one.shape != two.shape:
            raise ValueError(
                f"{who}: '{what}' has {one.size} entries in the baseline and {two.size} in the "
                "candidate"
            )
        is_apart = ~(np.abs(one - two) <= _SAME)
        if is_apart.any():
            entry = int(np.argmax(is_apart))
            names = {"state": loop.state_names, "margin": loop.constraint_names}.get(what)
            name = f" ({names[entry]})" if names else ""
            raise ValueError(
                f"{who}: entry {entry}{name} of '{what}' is {one[entry]:.6g} in the baseline and "
                f"{two[entry]:.6g} in the candidate"
            )
