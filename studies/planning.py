"""``python -m studies plan-study``: the gain of choosing plans by Γ."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    WorkersOption,
    say,
)
from drake_safety.cli.training_folder import assessment_folder, goal_threshold
from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import PLANNING
from drake_safety.simulation.capabilities import OffersPlans, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import episode_rng, run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.worker_processes import Progress
from studies.harness import Arrays, ReleaseOption, kept, open_study

_MAX_TRIES = 100
_CANDIDATES = 1  # Second spawn key of the generator of an episode's candidates.


def plan_study(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    episodes: Annotated[int, typer.Option(help="Fresh starts to plan from.", min=1)] = 200,
    candidates: Annotated[
        int, typer.Option(help="Plans of each start, all of them simulated.", min=2)
    ] = 9,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = PLANNING.first,
    release: ReleaseOption = False,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results; by default ASSESSMENT, or else runs/SCENARIO-shipped."
        ),
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Compare the default plan, the plan with the highest Γ, and the best in hindsight.

    Simulates every candidate plan of every start. Motions are kept in ASSESSMENT/planning: a
    stopped study continues. Writes planning.json and its plot.
    """
    learned = assessment_folder(load_scenario(scenario), assessment)
    with open_study(
        "planning",
        scenario,
        learned.path,
        seed=seed,
        release=release,
        workers=workers,
        out=out or learned.out,
        plotted=lambda row: row.metric == "safe",
    ) as study:
        gamma = study.load(mode, [study.seed])
        rule = goal_threshold(learned.path, gamma)
        say(f"threshold {rule.threshold:.3f}, {rule.origin}")
        trials = run_trials(
            study.scenario,
            episodes,
            num_plans=candidates,
            seed=study.seed,
            num_workers=workers,
            path=learned.out / "planning",
            progress=partial(study.stages, "starts"),
        )
        study.entries |= {"mode": mode, "candidates": candidates, "threshold": rule.threshold}
        study.add("planning", planning_estimates(gamma, trials, threshold=rule.threshold))


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanTrial:
    """Executed candidate plans of a start, with the inputs of Γ at k = 0.

    Attributes:
        state: States, (M, n_s).
        desired_preview: Previews, (M, H n_z).
        features: Features, (M, n_f).
        is_safe: Whether each motion stays safe, (M,); the first is the default plan.
    """

    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_safe: np.ndarray


def run_trials(
    scenario: Scenario,
    num_trials: int,
    *,
    num_plans: int,
    seed: int,
    path: Path,
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> dict[int, PlanTrial]:
    """Simulates every candidate plan from fresh starts; returns them by number of the episode.

    Starts with a disturbance are left out, since plans cannot account for it.

    Args:
        scenario: The scenario.
        num_trials: Number of starts.
        num_plans: Candidates of each, the default plan among them.
        seed: Seed of the starts.
        path: Folder of the motions, which are kept by start. They do not depend on Γ.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number of starts done and wanted.

    Raises:
        ValueError: The task offers no plans or only one, or too few starts are undisturbed.
    """
    make = worker_loop(scenario, **scenario.options_for("evaluation"))
    loop = make()
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
    found = kept(
        path / f"{scenario.simulation_hash()[:12]}-{seed}-of-{num_plans}",
        {f"{index}": (make, seed, num_plans, index) for index in indices},
        _run_candidates,
        workers=num_workers,
        progress=progress,
    )
    return {int(name): PlanTrial(**arrays) for name, arrays in found.items()}


def _candidates(loop: ClosedLoop, context: Any, seed: int, index: int, num_plans: int) -> list[Any]:
    """The plans of a start, to which the Context is reset."""
    loop.reset(context, episode_rng(seed, index))
    sequence = np.random.SeedSequence(seed, spawn_key=(index, _CANDIDATES))
    return require(loop, OffersPlans).candidate_plans(
        context, np.random.default_rng(sequence), num_plans
    )


def _run_candidates(
    make: Callable[[], ClosedLoop], seed: int, num_plans: int, index: int
) -> Arrays:
    loop = make()
    plans = _candidates(loop, loop.CreateDefaultContext(), seed, index, num_plans)
    motions = [run_episode(loop, index, seed=seed, plan=plan) for plan in plans]
    first = {
        name: np.array([getattr(motion, name)[0] for motion in motions])
        for name in ("state", "desired_preview", "features")
    }
    return {**first, "is_safe": np.array([motion.is_safe for motion in motions])}


def planning_estimates(
    assessment: SafetyAssessment, trials: Mapping[int, PlanTrial], *, threshold: float
) -> dict[str, Estimate]:
    """Chooses the plan of each start by Γ and evaluates its outcome.

    Args:
        assessment: Γ.
        trials: Fresh starts with all candidates simulated.
        threshold: Lowest Γ of an accepted plan.

    Returns:
        Shares of safe motions as "METHOD.safe" of the default plan, any candidate, the chosen plan,
        the chosen one where Γ accepts it, and the best in hindsight; "chosen.gain", the share of
        the way from the default plan to the best one; "chosen.accepted", of the starts.

    Raises:
        ValueError: There is no start.
    """
    if not trials:
        raise ValueError("planning study: there is no start to plan from")
    outcomes, gamma = [], []
    for trial in trials.values():
        found = assessment.predict(trial.state, trial.desired_preview, trial.features)
        gamma.append(found.probability)
        outcomes.append(trial.is_safe)
    best = [int(np.argmax(values)) for values in gamma]
    default = np.array([is_safe[0] for is_safe in outcomes])
    chosen = np.array([is_safe[i] for is_safe, i in zip(outcomes, best, strict=True)])
    hindsight = np.array([is_safe.any() for is_safe in outcomes])
    accepted = np.array([values.max() >= threshold for values in gamma])
    mean = np.array([is_safe.mean() for is_safe in outcomes])
    start, bootstrap = np.arange(len(trials)), Bootstrap()

    def gain(weight: np.ndarray) -> float:
        possible = float(weight @ (hindsight.astype(float) - default))
        return float(weight @ (chosen.astype(float) - default)) / possible if possible else math.nan

    def share(is_safe: np.ndarray) -> Estimate:
        return proportion(int(is_safe.sum()), len(is_safe))

    return {
        "default plan.safe": share(default),
        "any candidate.safe": bootstrap.over_episodes(
            lambda weight: float(weight @ mean / weight.sum()), start
        ),
        "chosen.safe": share(chosen),
        "chosen and accepted.safe": share(chosen[accepted]),
        "best in hindsight.safe": share(hindsight),
        "chosen.gain": bootstrap.over_episodes(gain, start),
        "chosen.accepted": share(accepted),
    }
