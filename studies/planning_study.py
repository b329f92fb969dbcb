"""Evaluation of planning with Γ: the default plan, the chosen one, and the best in hindsight."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episode
from drake_safety.simulation.capabilities import OffersPlans, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from drake_safety.simulation.rollouts import episode_rng, episodes_info, run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import batches, parallel_map

PLANS = {
    "default": "default plan",
    "any_candidate": "any candidate",
    "chosen": "chosen by Γ",
    "chosen_if_accepted": "chosen by Γ, if Γ accepts it",
    "best_in_hindsight": "best in hindsight",
}
"""Choices of the plan, by the key of the share of safe motions."""

_MAX_TRIES = 100
_FLUSH_S = 30.0
_CANDIDATES = 1  # Second spawn key of the generator of an episode's candidates.


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanTrial:
    """Executed candidate plans of a start, with the inputs of Γ at k = 0.

    Attributes:
        index: Number of the episode with this start.
        state: States, (M, n_s).
        desired_preview: Previews, (M, H n_z).
        features: Features, (M, n_f).
        is_safe: Whether each motion stays safe, (M,); the first is the default plan.
    """

    index: int
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_safe: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanningStudy:
    """The result of :func:`planning_study`.

    Attributes:
        estimates: `default`, `chosen`, `best_in_hindsight` and `any_candidate` are safe shares of
            the executed motions; `gain` is the share of the way from the first to the third that
            `chosen` covers; `accepted` is the share of starts with a plan that Γ accepts, and
            `chosen_if_accepted` the safe share of these.
        safety_probability: Γ of every start's candidates.
        trials: The starts.
    """

    estimates: dict[str, Estimate]
    safety_probability: list[np.ndarray]
    trials: list[PlanTrial]


def run_trials(
    scenario: Scenario,
    num_trials: int,
    *,
    num_plans: int,
    seed: int,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[PlanTrial]:
    """Simulates every candidate plan from fresh starts.

    Starts with a disturbance are left out, since plans cannot account for it.

    Args:
        scenario: The scenario.
        num_trials: Number of starts.
        num_plans: Candidates of each, the default plan among them.
        seed: Seed of the starts.
        num_workers: Number of worker processes; one a core by default.
        path: Folder of the motions, stored as episodes by the number of the start, with a folder
            for each candidate; ``plan-0`` holds the default plans. Existing motions are reused.
            They do not depend on Γ.
        progress: Called with the number of motions done and wanted.

    Raises:
        ValueError: The task offers no plans or only one, too few starts are undisturbed, or the
            folder holds other motions.
    """
    options = scenario.task_class().judging_options
    loop = scenario.make_loop(**options)
    context = loop.CreateDefaultContext()
    indices: list[int] = []
    index = 0
    while len(indices) < num_trials:
        if loop.reset(context, episode_rng(seed, index)) == 0:
            indices.append(index)
        index += 1
        if index == _MAX_TRIES * num_trials and len(indices) < num_trials:
            raise ValueError(
                f"planning: of {index} starts of scenario '{scenario.name}' {len(indices)} begin "
                f"undisturbed; it takes {num_trials}"
            )
    if len(_candidates(loop, context, seed, indices[-1], num_plans)) < 2:
        raise ValueError(
            f"planning: scenario '{scenario.name}' has one plan from a start, and none to choose; "
            f"{require(loop, OffersPlans).plan_variety}"
        )
    found: dict[tuple[int, int], _Motion] = {}
    with ExitStack() as stack:
        writers: list[EpisodeWriter] = []
        if path is not None:
            for i in range(num_plans):
                folder = Path(path) / f"plan-{i}"
                info = episodes_info(loop, seed, {**options, "plan": f"{i} of {num_plans}"})
                # With one writer per candidate, each writes shards less often.
                writer = EpisodeWriter(folder, info, flush_seconds=_FLUSH_S)
                writers.append(stack.enter_context(writer))
                kept = load_episodes(folder)
                found |= {(one.index, i): _Motion.of(one) for one in kept if one.index in indices}
        missing = {
            index: [i for i in range(num_plans) if (index, i) not in found] for index in indices
        }
        done, total = len(found), num_trials * num_plans
        if progress is not None:
            progress(done, total)
        results = parallel_map(
            _motion_batch,
            [
                (scenario, seed, num_plans, index, batch)
                for index, candidates in missing.items()
                for batch in batches(candidates)
            ],
            num_workers,
        )
        stack.callback(results.close)
        for num_asked, episodes in results:
            for candidate, episode in episodes:
                found[episode.index, candidate] = _Motion.of(episode)
                if writers:
                    writers[candidate].append(episode)
            done += num_asked
            if progress is not None:
                progress(done, total)
    return [
        _trial(index, [found[index, i] for i in range(num_plans) if (index, i) in found])
        for index in indices
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Motion:
    """First row and outcome of an executed plan."""

    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_safe: bool

    @classmethod
    def of(cls, episode: Episode) -> _Motion:
        return cls(
            state=episode.state[0].copy(),
            desired_preview=episode.desired_preview[0].copy(),
            features=episode.features[0].copy(),
            is_safe=episode.is_safe,
        )


def _trial(index: int, motions: list[_Motion]) -> PlanTrial:
    return PlanTrial(
        index=index,
        state=np.array([motion.state for motion in motions]),
        desired_preview=np.array([motion.desired_preview for motion in motions]),
        features=np.array([motion.features for motion in motions]),
        is_safe=np.array([motion.is_safe for motion in motions]),
    )


def _candidates(loop: ClosedLoop, context: Any, seed: int, index: int, num_plans: int) -> list[Any]:
    """The plans of a start, to which the Context is reset."""
    loop.reset(context, episode_rng(seed, index))
    sequence = np.random.SeedSequence(seed, spawn_key=(index, _CANDIDATES))
    return require(loop, OffersPlans).candidate_plans(
        context, np.random.default_rng(sequence), num_plans
    )


def _motion_batch(
    scenario: Scenario, seed: int, num_plans: int, index: int, candidates: list[int]
) -> tuple[int, list[tuple[int, Episode]]]:
    """Executes candidates of a start that exist; returns also the number requested."""
    loop = worker_loop(scenario, "nominal", scenario.task_class().judging_options)
    plans = _candidates(loop, loop.CreateDefaultContext(), seed, index, num_plans)
    there = [i for i in candidates if i < len(plans)]
    return len(candidates), [(i, run_episode(loop, index, seed=seed, plan=plans[i])) for i in there]


def planning_study(
    assessment: SafetyAssessment, trials: list[PlanTrial], *, threshold: float
) -> PlanningStudy:
    """Chooses the plan of each start by Γ and evaluates its outcome.

    Args:
        assessment: Γ.
        trials: Fresh starts with all candidates simulated.
        threshold: Lowest Γ of an accepted plan.

    Raises:
        ValueError: There is no start.
    """
    if not trials:
        raise ValueError("planning study: there is no start to plan from")
    gamma = [
        assessment.predict(
            trial.state,
            trial.desired_preview,
            trial.features if assessment.uses_features else None,
        ).probability
        for trial in trials
    ]
    best = [int(np.argmax(values)) for values in gamma]
    default = np.array([trial.is_safe[0] for trial in trials])
    chosen = np.array([trial.is_safe[i] for trial, i in zip(trials, best, strict=True)])
    hindsight = np.array([trial.is_safe.any() for trial in trials])
    accepted = np.array([values[i] >= threshold for values, i in zip(gamma, best, strict=True)])
    mean = np.array([trial.is_safe.mean() for trial in trials])
    start = np.arange(len(trials))
    bootstrap = Bootstrap()

    def gain(weight: np.ndarray) -> float:
        possible = float(weight @ (hindsight.astype(float) - default))
        return float(weight @ (chosen.astype(float) - default)) / possible if possible else math.nan

    def share(is_safe: np.ndarray) -> Estimate:
        return proportion(int(is_safe.sum()), len(is_safe))

    return PlanningStudy(
        estimates={
            "default": share(default),
            "chosen": share(chosen),
            "best_in_hindsight": share(hindsight),
            "any_candidate": bootstrap.over_episodes(
                lambda weight: float(weight @ mean / weight.sum()), start
            ),
            "gain": bootstrap.over_episodes(gain, start),
            "accepted": share(accepted),
            "chosen_if_accepted": share(chosen[accepted]),
        },
        safety_probability=gamma,
        trials=trials,
    )


def planning_verdict(estimates: Mapping[str, Estimate]) -> str:
    """Compares Γ with the default plan in a sentence.

    Args:
        estimates: Those of a `PlanningStudy`.
    """
    default, chosen, gain = (estimates.get(key) for key in ("default", "chosen", "gain"))
    if default is None or chosen is None or gain is None:
        return "The estimates of the study are incomplete: run it again."
    shares = (
        f"{_percent(chosen)} of the starts stay safe with the plan that Γ chooses and "
        f"{_percent(default)} with the default plan"
    )
    if not math.isfinite(gain.value):
        return (
            f"No difference: {shares}, and no candidate is safe from a start at which the default "
            "plan is unsafe."
        )
    way = f"{_percent(gain, 0)} of the way to the best plan in hindsight"
    if gain.low > 0.0:
        return f"Γ is better: {shares}, which is {way}."
    if gain.high < 0.0:
        return f"The default plan is better: {shares}."
    return f"No significant difference: {shares}, {way}, an interval that includes zero."


def _percent(estimate: Estimate, digits: int = 1) -> str:
    value, low, high = (100.0 * x for x in (estimate.value, estimate.low, estimate.high))
    return f"{value:.{digits}f} % ({low:.{digits}f}–{high:.{digits}f})"
