"""What planning with Γ is worth: the default plan, the chosen one, and the best in hindsight."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Figure, proportion
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.plan_choice import plan_inputs
from drake_safety.simulation.rollouts import (
    batches,
    episode_rng,
    parallel_map,
    run_episode,
    worker_loop,
)
from drake_safety.simulation.scenario import Scenario

_MAX_TRIES = 100
_CANDIDATES = 1  # Spawn key beside an episode's own: its candidates have a generator of their own.


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanTrial:
    """All candidate plans of one start, judged and executed.

    Attributes:
        index: Number of the episode that begins so.
        state: What Γ sees of the start, (M, n_s), the same M times.
        desired_preview: And of each plan, (M, H n_z).
        features: (M, n_f).
        is_safe: What came of each, (M,); the first is the default plan.
    """

    index: int
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_safe: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanningStudy:
    """What :func:`planning_study` found.

    Attributes:
        figures: `default`, `chosen`, `best_in_hindsight` and `any_candidate` are safe shares of the
            executed motions; `gain` is how far `chosen` comes from the first to the third, 1 for
            all the way; `accepted` is the share of starts with a plan that Γ accepts, and
            `chosen_if_accepted` the safe share of these.
        safety_probability: Γ of every start's candidates.
        trials: The starts.
    """

    figures: dict[str, Figure]
    safety_probability: list[np.ndarray]
    trials: list[PlanTrial]


def run_trials(
    scenario: Scenario,
    num_trials: int,
    *,
    num_plans: int,
    seed: int,
    num_workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[PlanTrial]:
    """Simulates every candidate plan from fresh starts.

    Starts that begin with a disturbance are left out: no plan of theirs could know of it.

    Args:
        scenario: The scenario.
        num_trials: Number of starts.
        num_plans: Candidates of each, the default plan among them.
        seed: Seed of the starts.
        num_workers: Processes; as many as there are cores by default.
        progress: Called with the number done and the number wanted.

    Raises:
        ValueError: The task's plans cannot be chosen, there is but one, or hardly any start is
            undisturbed.
    """
    loop = scenario.make_loop(**_judging_options(scenario))
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
    if len(loop.candidate_plans(context, np.random.default_rng(0), num_plans)) < 2:
        raise ValueError(
            f"planning: scenario '{scenario.name}' has one plan from a start, and none to choose; "
            f"{loop.plan_variety}"
        )
    trials: list[PlanTrial] = []
    arguments = [(scenario, seed, num_plans, batch) for batch in batches(indices)]
    for batch in parallel_map(_trial_batch, arguments, num_workers):
        trials += batch
        if progress is not None:
            progress(len(trials), num_trials)
    return sorted(trials, key=lambda trial: trial.index)


def _judging_options(scenario: Scenario) -> dict[str, Any]:
    return dict(scenario.task_class().judging_options)


def _trial_batch(
    scenario: Scenario, seed: int, num_plans: int, indices: list[int]
) -> list[PlanTrial]:
    loop = worker_loop(scenario, "nominal", _judging_options(scenario))
    trials = []
    for index in indices:
        context = loop.CreateDefaultContext()
        loop.reset(context, episode_rng(seed, index))
        sequence = np.random.SeedSequence(seed, spawn_key=(index, _CANDIDATES))
        plans = loop.candidate_plans(context, np.random.default_rng(sequence), num_plans)
        state, preview, features = plan_inputs(loop, context, plans)
        episodes = [run_episode(loop, index, seed=seed, plan=plan) for plan in plans]
        trials.append(
            PlanTrial(
                index=index,
                state=state,
                desired_preview=preview,
                features=features,
                is_safe=np.array([episode.is_safe for episode in episodes]),
            )
        )
    return trials


def planning_study(
    assessment: SafetyAssessment, trials: list[PlanTrial], *, threshold: float
) -> PlanningStudy:
    """Chooses each start's plan by Γ and looks up what came of it.

    Args:
        assessment: Γ.
        trials: Fresh starts, all candidates of which were simulated.
        threshold: From which Γ on a plan is accepted.

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
        ).calibrated
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

    def share(is_safe: np.ndarray) -> Figure:
        return proportion(int(is_safe.sum()), len(is_safe))

    return PlanningStudy(
        figures={
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
