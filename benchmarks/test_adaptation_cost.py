"""Cost of adaptation: an update from feedback, and its adoption by a running diagram."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from costs import alternate
from sklearn.linear_model import LogisticRegression
from threadpoolctl import threadpool_limits

from drake_safety import Scenario, load_assessment
from drake_safety.learning.feedback import EpisodePair
from drake_safety.simulation.feedback import run_pairs
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor

NUM_PAIRS = 40
ROUNDS = 3
NUM_ADOPTIONS = 100  # In a round.


@pytest.fixture(scope="module")
def feedback(scenario: Scenario) -> list[EpisodePair]:
    return run_pairs(scenario, NUM_PAIRS).feedback()


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize(("mode", "method"), [("paper", "paper"), ("sharpened", "recalibration")])
def test_one_update(
    benchmark: Any,
    report: Callable[..., None],
    scenario: Scenario,
    feedback: list[EpisodePair],
    mode: str,
    method: str,
) -> None:
    assessment = load_assessment(scenario.name, mode)
    assert any(one.differs for one in feedback)
    rows = [pair.rows for pair in feedback]
    x = np.concatenate([assessment.columns_.of_rows(one, "actual") for one in rows])
    label = np.concatenate([one.is_unsafe for one in rows])
    standardised = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-6)
    with threadpool_limits(1):
        cost_s, peers_s = alternate(
            benchmark,
            lambda: assessment.adapt(feedback, method=method),
            {
                "scikit-learn's LogisticRegression of the same rows": lambda: LogisticRegression(
                    max_iter=1000
                ).fit(standardised, label)
            },
            rounds=ROUNDS,
        )
    report(
        f"adaptation by {method}, {scenario.name}",
        cost_s,
        "s CPU",
        at_most=0.5,
        peers=peers_s,
        note=f"{len(feedback)} pairs, {len(x)} rows, "
        f"{int(assessment.training_.counts(assessment.grid_)[0].sum())} training segments",
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_adopting_beliefs(benchmark: Any, report: Callable[..., None], scenario: Scenario) -> None:
    assessment = load_assessment(scenario.name)
    assessor = MonitoredSafetyAssessor(assessment, period_s=scenario.control_period_s)
    context = assessor.CreateDefaultContext()

    def adopt() -> None:
        for _ in range(NUM_ADOPTIONS):
            assessor.adopt(context, assessment)

    cost_s, _ = alternate(benchmark, adopt, {}, rounds=5)
    report(
        "adopting an adapted assessment in a Context",
        1e3 * cost_s / NUM_ADOPTIONS,
        "ms CPU",
        at_most=1.0,
    )
