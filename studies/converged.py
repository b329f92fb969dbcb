"""``python -m studies converged``: the paper's mode judged as the paper judges."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from drake_safety.cli.adapt import ActualPlant
from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.diagrams.balancing.throw_study import (
    PAPER_THRESHOLD,
    TriggerRule,
    evaluate_throws,
)
from drake_safety.evaluation.episode_study import PROMISED_UNSAFE_RECALL
from drake_safety.evaluation.metrics import Estimate, segment_estimates, threshold_at
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.calibration import score_threshold
from drake_safety.learning.feedback import EpisodePair, pair_episodes
from drake_safety.learning.seeds import ADAPTATION, EVALUATION
from drake_safety.learning.segments import Episodes, split
from drake_safety.simulation.capabilities import HasGoals, is_fair
from studies.harness import CalibrationOption, EpisodesOption, ReleaseOption, SeedOption, open_study


def converged(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    episodes: EpisodesOption = 1000,
    calibration_episodes: CalibrationOption = 300,
    throws: Annotated[int, typer.Option(help="Fresh throws at the actual plant.", min=0)] = 0,
    pairs: Annotated[
        int, typer.Option(help="Pairs of the actual plant, the feedback before throws.", min=0)
    ] = 160,
    seed: SeedOption = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Evaluate the paper's mode at its threshold 0.6, before and after its adaptation.

    Nominal episodes are judged after feedback from other nominal episodes, those for thresholds,
    throws at the actual plant after feedback from it. Writes ASSESSMENT/converged.json.
    """
    with open_study(
        "converged", scenario, assessment, seed=seed, release=release, workers=workers
    ) as study:
        prior = study.load("paper")
        loop, stages = study.scenario.make_loop(), study.stages
        test, other = study.fresh(episodes), study.fresh(calibration_episodes, "thresholds")
        feedback = nominal_feedback(prior, other)
        adapted = prior.adapt(feedback, method="paper")
        rules = judged_rules(prior, adapted)
        prior_alone = without_feedback_beliefs(prior).adapt(feedback, method="paper")
        for name, gamma in {"adapted": adapted, "discrepancy": prior_alone}.items():
            rules[name] = (share_scorer(name, gamma), PAPER_THRESHOLD)
        fair = np.array([isinstance(loop, HasGoals) and is_fair(loop, one) for one in test])
        study.add("converged", recalls(rules, other, test, fair))
        study.entries |= {
            "training_episodes": prior.used_[0].num_episodes,
            "feedback_episodes": calibration_episodes,
            "feedback_pairs": pairs,
        }
        if throws:
            plant = ActualPlant(study.scenario, "actual", assessment, workers, stages)
            run = plant.pairs(pairs, ADAPTATION.first_beside(study.seed))
            literal = {"before": prior, "converged": prior.adapt(run.feedback(), method="paper")}
            thrown, _ = evaluate_throws(
                study.scenario,
                [
                    TriggerRule(scorer=assessment_scorer(name, one), threshold=PAPER_THRESHOLD)
                    for name, one in literal.items()
                ],
                num_throws=throws,
                seed=study.seeds["disturbances"],
                num_workers=workers,
                progress=stages,
            )
            study.add("converged", thrown)


def nominal_feedback(assessment: SafetyAssessment, episodes: Episodes) -> list[EpisodePair]:
    """Feedback of a robot without a reality gap: nominal episodes are their own twins."""
    info = replace(episodes.info, scenario_hash=assessment.info_.scenario_hash)
    twins = Episodes(info, list(episodes))
    return pair_episodes(twins, twins)


def without_feedback_beliefs(prior: SafetyAssessment) -> SafetyAssessment:
    """The assessment with feedback beliefs that stay empty: feedback updates the prior alone."""
    settings = replace(prior.parameters.adaptation, first_uncertainty=1.0, decay_rate=0.0)
    changed = copy.copy(prior)
    changed.parameters = replace(prior.parameters, adaptation=settings)
    return changed


def judged_rules(
    prior: SafetyAssessment, adapted: SafetyAssessment
) -> dict[str, tuple[Scorer, float | str]]:
    """Scorers by name, each with its threshold or the way to choose it.

    Args:
        prior: The assessment before feedback.
        adapted: The same after it.
    """
    return {
        "literal": (assessment_scorer("literal", prior), PAPER_THRESHOLD),
        "converged": (assessment_scorer("converged", adapted), PAPER_THRESHOLD),
        "normalized": (share_scorer("normalized", prior), "balanced"),
        "conformal": (share_scorer("conformal", prior), "promised"),
    }


def share_scorer(name: str, assessment: SafetyAssessment) -> Scorer:
    """The safe share of the belief of a `paper` assessment, b_safe / (1 - μ), as a scorer."""
    return replace(
        assessment_scorer(name, assessment),
        probability=lambda state, preview, features: safe_share(
            assessment.predict(state, preview).belief
        ),
    )


def recalls(
    rules: dict[str, tuple[Scorer, float | str]],
    calibration: Episodes,
    test: Episodes,
    fair: np.ndarray,
) -> dict[str, Estimate]:
    """Recalls and AUC on every segment, on first rows, and on first rows of fair episodes.

    Args:
        rules: See `judged_rules`.
        calibration: Episodes for thresholds.
        test: Other episodes.
        fair: Whether each of these is fair, (N,); no row is judged apart without any.
    """
    segments, seen = (split(one, stride=1, discount=1.0) for one in (test, calibration))
    kinds = {
        "segments": (np.ones(len(segments), dtype=bool), np.ones(len(seen), dtype=bool)),
        "first": (segments.is_first, seen.is_first),
    }
    if fair.any():
        kinds["fair"] = (segments.is_first & fair[segments.episode], seen.is_first)
    estimates: dict[str, Estimate] = {}
    for name, (scorer, way) in rules.items():
        score, seen_score = scorer.unsafe_score(segments), scorer.unsafe_score(seen)
        for kind, (rows, seen_rows) in kinds.items():
            seen_label = seen.is_unsafe[seen_rows]
            if way == "balanced":
                threshold = threshold_at(seen_score[seen_rows], seen_label)
            elif way == "promised":
                miss_rate = 1.0 - PROMISED_UNSAFE_RECALL
                threshold = score_threshold(seen_score[seen_rows], seen_label, miss_rate)
            else:
                threshold = 1.0 - float(way)
            found = segment_estimates(segments.take(rows), score[rows], threshold=threshold)
            found["threshold"] = Estimate.exact(1.0 - threshold, int(seen_rows.sum()))
            estimates |= {f"{kind}.{name}.{key}": estimate for key, estimate in found.items()}
    return estimates
