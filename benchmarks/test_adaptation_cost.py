"""Cost of an update from feedback, and of adopting it in a running diagram."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from drake_safety.learning.adaptation import TrainingScores, paper_beliefs
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.feedback import FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import BaseLogit, Correction, hidden_sum
from drake_safety.learning.recalibration import (
    Outcomes,
    cell_means,
    fitted_change,
    guarded_cells,
    recalibrated_beliefs,
    row_weights,
)
from drake_safety.systems.safety_assessor import SafetyAssessor

NUM_TRAINING, NUM_FEEDBACK, NUM_CAUSES = 20_000, 1_000, 2
MAX_UPDATE_S, MAX_ADOPT_MS = 2.0, 1.0


def training(num_members: int) -> TrainingScores:
    rng = np.random.default_rng(0)
    score = np.where(rng.random(NUM_TRAINING) < 0.4, rng.uniform(0.6, 1.0, NUM_TRAINING), 0.0)
    return TrainingScores(
        points=rng.uniform(-65.0, 65.0, (num_members, NUM_TRAINING, 2)).astype(np.float32),
        score=score,
        cause=np.where(score > 0.0, 0, -1),
        heads=rng.normal(0.0, 3.0, (NUM_TRAINING, 2)),
        nearest=np.zeros(NUM_TRAINING, dtype=int),
    )


def feedback() -> FeedbackSegments:
    rng = np.random.default_rng(1)
    nominal = rng.random(NUM_FEEDBACK) < 0.4
    actual = nominal ^ (rng.random(NUM_FEEDBACK) < 0.15)
    empty = np.zeros((NUM_FEEDBACK, 0))
    return FeedbackSegments(
        set_index=np.arange(NUM_FEEDBACK) // 5,
        state=empty,
        desired_preview=empty,
        features=empty,
        score=np.where(actual, 0.8, 0.0),
        nominal_score=np.where(nominal, 0.8, 0.0),
        is_unsafe=actual,
        nominal_is_unsafe=nominal,
        cause=np.where(actual, 0, -1),
    )


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("method", ["paper", "recalibration"])
def test_one_update(benchmark: Any, report: Callable[..., None], method: str) -> None:
    mode, num_members = ("paper", 1) if method == "paper" else ("sharpened", 3)
    parameters = AssessmentParameters(mode=mode)
    grid = Grid(resolution=parameters.resolution, cell_length=parameters.cell_length)
    scores, segments = training(num_members), feedback()
    rng = np.random.default_rng(2)
    points = rng.uniform(-65.0, 65.0, (num_members, NUM_FEEDBACK, 2))
    base_logit = BaseLogit(margin_unit=0.02, margin_range=(-0.03, 0.1))
    heads = rng.normal(0.0, 3.0, (NUM_FEEDBACK, 2))
    activations = np.maximum(rng.normal(size=(num_members, NUM_FEEDBACK, 128)), 0.0)
    num_rows = np.bincount(segments.set_index)
    weight = row_weights(num_rows)
    actual = Outcomes(
        heads=heads, activations=activations, is_unsafe=segments.is_unsafe, weight=weight
    )
    first = weight > 1.0
    twins = Outcomes(
        heads=heads[first],
        activations=activations[:, first],
        is_unsafe=segments.nominal_is_unsafe[first],
        weight=np.ones(len(num_rows)),
    )

    def update() -> float:
        started = time.process_time()
        if method == "paper":
            paper_beliefs(scores, segments, points, grid, parameters, NUM_CAUSES)
        else:
            change, hidden, hidden_range = fitted_change(
                actual, twins, base_logit, parameters.adaptation
            )
            guard = guarded_cells(segments, points, grid)
            correction = Correction(
                change=change, hidden=hidden, hidden_range=hidden_range, guard=guard
            )
            residual = cell_means(hidden_sum(activations, hidden), points, grid)
            recalibrated_beliefs(
                scores,
                base_logit,
                correction,
                segments,
                points,
                residual,
                grid,
                parameters,
                NUM_CAUSES,
            )
        return time.process_time() - started

    with threadpool_limits(1):
        update()
        costs = [update() for _ in range(3)]
        benchmark.pedantic(update, rounds=1)
    report(
        f"one update by '{method}'",
        statistics.median(costs),
        "s CPU",
        at_most=MAX_UPDATE_S,
        note=f"{NUM_FEEDBACK} feedback segments, {NUM_TRAINING} training segments",
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_adopting_beliefs(benchmark: Any, report: Callable[..., None], scenario: Any) -> None:
    from drake_safety import SafetyAssessment, run_episodes

    settings = dataclasses.replace(scenario.assessment, epochs=1)
    assessment = SafetyAssessment(settings).fit(run_episodes(scenario, 64))
    assessor = SafetyAssessor(assessment, period_s=0.02)
    context = assessor.CreateDefaultContext()

    def adopt() -> float:
        started = time.process_time()
        for _ in range(100):
            assessor.adopt(context, assessment)
        return 10.0 * (time.process_time() - started)

    costs = [adopt() for _ in range(5)]
    benchmark.pedantic(adopt, rounds=1)
    report(
        "beliefs and correction into a Context",
        statistics.median(costs),
        "ms",
        at_most=MAX_ADOPT_MS,
    )
