"""Two closed loops in the same episodes, pair by pair, until a verdict is known."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from contextlib import ExitStack, closing
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.evaluation.paired_test import ConfidenceSequence, betting_log_e
from drake_safety.files.reading import did_you_mean, is_number
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import GATE
from drake_safety.learning.segments import DIVERGED, Episode
from drake_safety.simulation.capabilities import CanFall, CanStartAnywhere, IsDisturbed, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from drake_safety.simulation.rollouts import check_kept, episode_rng, episodes_info, run_episode
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import MadeOnce, Progress, map_items

WORSE, BETTER, NOT_WORSE, UNDECIDED = "worse", "better", "not worse", "undecided"
UNSAFE = "unsafe"
_LOOK = 16  # Pairs between two looks.
_BATCH = 2  # Pairs sent to a worker at a time.
_SAME = 1e-9  # Largest difference of two starts, by the rounding of two engines.
_LARGEST_LOG = 700.0  # Of an e-value.

Metric = str | Callable[[Episode], float]
"""How bad an episode is, in [0, 1]: ``unsafe``, ``fall``, a constraint, ``tracking=BOUND``, or a
function of an episode. Episodes of the first and the last end where they leave the safe set; others
go on until a fall."""


class Loop(NamedTuple):
    """A closed loop: a scenario and its plant."""

    scenario: Scenario
    variation: str = "nominal"


@dataclass(frozen=True)
class Change:
    """An episode that ends differently in the candidate.

    Attributes:
        newly_fails: Whether the candidate is the one that fails, or does worse.
        cause: The constraint that it violated first; "" for none.
        time_s: When it failed [s].
        probability: Γ's probability that the baseline stays safe, in the first undisturbed row;
            None without Γ.
    """

    episode: int
    newly_fails: bool
    cause: str
    time_s: float
    probability: float | None


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is known of a candidate after a number of pairs.

    Attributes:
        verdict: "worse", "better", "not worse" (by `worse_by`), or "undecided". Each is wrong with
            a probability of at most alpha, whenever one looks.
        neither, both, only_baseline, only_candidate: Numbers of pairs in which these fail; of a
            function as metric, the last two are those in which one does worse.
        difference: Mean outcome of the candidate minus that of the baseline, and its alpha.
        survival_s: The same of the time until the failure, or the end [s].
        e_worse, e_better: E-values for either verdict, which is known from 1 / alpha on.
        changes: The episodes that end differently: first those that newly fail, by time.
    """

    verdict: str
    neither: int
    both: int
    only_baseline: int
    only_candidate: int
    difference: ConfidenceSequence
    survival_s: ConfidenceSequence
    e_worse: float
    e_better: float
    changes: list[Change]
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
    **loop_options: Any,
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
        **loop_options: Options of the task, for both.

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
    pairing = _Pairing((one, two), metric, seed, loop_options, assessment)
    difference = ConfidenceSequence(alpha)
    survival_s = ConfidenceSequence(alpha, one.scenario.episode_duration_s)
    runs: tuple[dict[int, _Run], ...] = ({}, {})
    with ExitStack() as stack:
        writers = []
        for side, info in enumerate(pairing.infos if path is not None else ()):
            folder = Path(path or "") / f"{info.scenario_hash[:12]}-{seed}"
            writers.append(stack.enter_context(EpisodeWriter(folder, info)))
            if kept := [episode for episode in load_episodes(folder) if episode.index < max_pairs]:
                check_kept(folder, kept, partial(pairing.run_one, side))
            runs[side].update({episode.index: pairing.read(side, episode) for episode in kept})
        is_missing = ((index, [index not in each for each in runs]) for index in range(max_pairs))
        items = [item for item in is_missing if any(item[1])]
        found = map_items(
            pairing.run,
            items,
            num_workers=num_workers,
            batch_size=_BATCH,
            progress=progress,
            num_done=max_pairs - len(items),
            stage="pairs",
        )
        results = stack.enter_context(closing(found))
        for index in range(max_pairs):
            while not all(index in each for each in runs):
                for side, episode in enumerate(next(results)):
                    if episode is not None:
                        runs[side][episode.index] = pairing.read(side, episode)
                        if writers:
                            writers[side].append(episode)
            if (index + 1) % _LOOK == 0 or index + 1 == max_pairs:
                pairs = [(runs[0][i], runs[1][i]) for i in range(index + 1)]
                verdict = _look(pairs, difference, survival_s, worse_by)
                each_look(verdict)
                if verdict.verdict != UNDECIDED:
                    break
    return verdict


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


def _make_both(pair: tuple[Loop, Loop], options: dict[str, Any]) -> tuple[ClosedLoop, ClosedLoop]:
    return make_paired(pair, 0, **options), make_paired(pair, 1, **options)


class _Run(NamedTuple):
    """What is kept of an episode: its outcome in [0, 1], when and why it failed, and Γ."""

    outcome: float
    time_s: float
    cause: str
    probability: float | None


def _look(
    runs: list[tuple[_Run, _Run]],
    difference: ConfidenceSequence,
    survival_s: ConfidenceSequence,
    worse_by: float,
) -> Verdict:
    """Looks at all pairs so far; later looks do not change what is returned."""
    outcomes = np.array([[run.outcome for run in pair] for pair in runs])
    apart = outcomes[:, 1] - outcomes[:, 0]
    difference.look(apart)
    survival_s.look(np.array([two.time_s - one.time_s for one, two in runs]))
    is_known = {
        WORSE: difference.low[-1] > 0.0,
        BETTER: difference.high[-1] < 0.0,
        NOT_WORSE: difference.high[-1] < worse_by,
        UNDECIDED: True,
    }
    changes = []
    for index in np.flatnonzero(apart).tolist():
        failed = runs[index][int(apart[index] > 0)]
        known = (failed.cause, failed.time_s, runs[index][0].probability)
        changes.append(Change(index, bool(apart[index] > 0), *known))
    values = np.unique(apart, return_counts=True)
    log_e = [float(betting_log_e(*values, 0.0, is_above=is_above)) for is_above in (True, False)]
    return Verdict(
        verdict=next(name for name, is_so in is_known.items() if is_so),
        neither=int((outcomes == 0).all(axis=1).sum()),
        both=int(((outcomes > 0).all(axis=1) & (apart == 0)).sum()),
        only_baseline=int((apart < 0).sum()),
        only_candidate=int((apart > 0).sum()),
        difference=deepcopy(difference),
        survival_s=deepcopy(survival_s),
        e_worse=math.exp(min(log_e[0], _LARGEST_LOG)),
        e_better=math.exp(min(log_e[1], _LARGEST_LOG)),
        changes=sorted(changes, key=lambda one: (not one.newly_fails, one.time_s)),
        worse_by=worse_by,
    )


class _Pairing:
    """How the episodes of a pair are simulated, and what is read of one."""

    def __init__(
        self,
        pair: tuple[Loop, Loop],
        metric: Metric,
        seed: int,
        loop_options: dict[str, Any],
        gamma: SafetyAssessment | None,
    ) -> None:
        hashes = [scenario.simulation_hash(variation) for scenario, variation in pair]
        if hashes[0] == hashes[1]:
            raise ValueError(
                f"the candidate is the baseline: scenario '{pair[0].scenario.name}', variation "
                f"'{pair[0].variation}', with hash {hashes[0][:12]}"
            )
        self._metric, self._gamma = metric, gamma
        self._duration_s = pair[0].scenario.episode_duration_s
        goes_on = isinstance(metric, str) and metric != UNSAFE
        self._options: Any = {"seed": seed, "after_leaving_s": math.inf if goes_on else 0.0}
        # The texts say what the hashes leave out.
        key = (*hashes, *(one.to_yaml() for one, _ in pair), repr(sorted(loop_options.items())))
        self._make = MadeOnce(key, partial(_make_both, pair, loop_options))
        self.run = partial(self._make.run, _run_pair, **self._options)
        loops = self._make()
        known = _pair_options(pair) | loop_options | ({"goes_on": True} if goes_on else {})
        starts = {"starts_of": hashes[0]} if _takes_starts(pair[1].scenario) else {}
        both = zip(loops, (known, known | starts), strict=True)
        self.infos = [episodes_info(loop, seed, options) for loop, options in both]
        self._bad_rows = _bad_rows(loops[0], metric if isinstance(metric, str) else UNSAFE)

    def run_one(self, side: int, index: int) -> Episode:
        """The episode of one loop."""
        return run_episode(self._make()[side], index, **self._options)

    def read(self, side: int, episode: Episode) -> _Run:
        """What is kept of an episode, Γ of the baseline's."""
        is_bad = self._bad_rows(episode) | _last_row(episode, episode.cause == DIVERGED)
        outcome = float(is_bad.any() if isinstance(self._metric, str) else self._metric(episode))
        if not 0.0 <= outcome <= 1.0:
            raise ValueError(f"metric: episode {episode.index} has {outcome}, expected 0 to 1")
        time_s = float(episode.time_s[is_bad.argmax()]) if is_bad.any() else self._duration_s
        probability, row = None, episode.first_step
        if self._gamma is not None and side == 0:
            rows = (episode.state, episode.desired_preview, episode.features)
            probability = float(self._gamma.predict_one(*(one[row] for one in rows)).probability)
        return _Run(outcome, time_s, episode.cause, probability)


def _bad_rows(loop: ClosedLoop, metric: str) -> Callable[[Episode], np.ndarray]:
    """The rows of an episode in which it fails, (N,), by a metric."""
    names, num_steps = loop.constraint_names, loop.scenario.num_steps
    kind, _, bound = metric.partition("=")
    if metric == UNSAFE:
        return lambda one: _last_row(one, not one.is_safe)
    if kind == "tracking" and is_number(bound) and float(bound) > 0:
        # A motion that ends early has fallen.
        return lambda one: (
            (np.linalg.norm(one.output - one.desired_output, axis=1) > float(bound))
            | _last_row(one, one.num_steps < num_steps)
        )
    name = require(loop, CanFall, "metric 'fall'").fall_name if metric == "fall" else metric
    if name not in names:
        known = [UNSAFE, "fall", "tracking=BOUND", *names]
        raise ValueError(
            f"metric '{metric}'{did_you_mean(metric, known)}: expected one of {known}, or in "
            "Python a function of an episode"
        )
    return lambda one: one.margins[:, names.index(name)] < 0.0


def _last_row(episode: Episode, is_bad: bool) -> np.ndarray:
    """Rows that are bad, (N,): the last one or none."""
    return np.arange(len(episode.time_s)) >= episode.num_steps + (not is_bad)


def _run_pair(
    loops: tuple[ClosedLoop, ClosedLoop],
    item: tuple[int, list[bool]],
    *,
    seed: int,
    after_leaving_s: float,
) -> list[Episode | None]:
    """The episodes of a pair that are missing; the starts of both are compared."""
    index, is_missing = item
    starts: list[dict[str, np.ndarray]] = []
    episodes: list[Episode | None] = []
    for loop, is_wanted in zip(loops, is_missing, strict=True):

        def at_start(context: Context, loop: ClosedLoop = loop) -> None:
            starts.append(_start_of(loop, context))

        if is_wanted:
            options: Any = {"seed": seed, "after_leaving_s": after_leaving_s}
            episodes.append(run_episode(loop, index, at_start=at_start, **options))
        else:
            context = loop.CreateDefaultContext()
            loop.reset(context, episode_rng(seed, index))
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
    return start | (loop.disturbances(context) if isinstance(loop, IsDisturbed) else {})


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
