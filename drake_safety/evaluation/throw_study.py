"""Balls thrown at the actual plant: when each rule triggers recovery, and the outcome."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from drake_safety.evaluation.metrics import Estimate, median, proportion
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.evaluation.shift_study import SEEN
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.throws import VIOLATIONS, run_throws, trigger_time

PAPER_THRESHOLD = 0.6
"""Γ_thre of the paper, on b_safe, the probability in the paper's mode."""


@dataclass(frozen=True, kw_only=True)
class TriggerRule:
    """A scorer with a threshold that triggers recovery."""

    name: str
    scorer: Scorer
    threshold: float


def trigger_rules(
    sharpened: SafetyAssessment, paper: SafetyAssessment, *, threshold: float
) -> list[TriggerRule]:
    """The scenario's rule, named "sharpened", and the paper's."""
    own, printed = assessment_scorer("sharpened", sharpened), assessment_scorer("paper", paper)
    return [
        TriggerRule(name="sharpened", scorer=own, threshold=threshold),
        TriggerRule(name="paper", scorer=printed, threshold=PAPER_THRESHOLD),
    ]


def log_probability(log: Motion, scorer: Scorer, persistence_s: float = 0.0) -> np.ndarray:
    """Safety probability of a scorer at every row of a log as a `RecoveryTrigger` takes it, (N,).

    Where nothing is known, the highest within ``persistence_s`` counts; before it has passed, 1.
    """
    probability = scorer.probability(*(log[name] for name in SEEN))
    if len(probability) < 2 or not persistence_s:
        return probability
    num_waited = math.ceil(persistence_s / (log.time_s[1] - log.time_s[0]) - 1e-6)
    padded = np.concatenate([np.ones(num_waited), np.nan_to_num(probability, nan=0.0)])
    highest = np.lib.stride_tricks.sliding_window_view(padded, num_waited + 1).max(axis=1)
    return np.where(np.isnan(probability), highest, probability)


def evaluate_throws(
    scenario: Scenario,
    rules: Sequence[TriggerRule],
    *,
    num_throws: int,
    seed: int,
    persistence_s: float = 0.0,
    variation: str = "actual",
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> tuple[dict[str, Estimate], list[Motion]]:
    """Throws balls at the actual plant and compares the triggers of rules and their outcomes.

    "Don't know" triggers when it has lasted ``persistence_s``. Returns the estimates by dotted key,
    and the throws without recovery.
    """
    report = progress or (lambda stage, done, total: None)
    throw = partial(run_throws, scenario, seed=seed, variation=variation, num_workers=num_workers)
    logs = throw(list(range(num_throws)), progress=partial(report, "throws, balancing alone"))
    triggers = {
        rule.name: np.array(
            [
                trigger_time(log, log_probability(log, rule.scorer, persistence_s), rule.threshold)
                for log in logs
            ]
        )
        for rule in rules
    }
    triggered = {
        name: {
            log.index: float(time)
            for log, time in zip(logs, times, strict=True)
            if not math.isnan(time)
        }
        for name, times in triggers.items()
    }
    # Rules often trigger at the same instant: each distinct recovery is simulated once.
    wanted = sorted({pair for times in triggered.values() for pair in times.items()})
    again = throw(
        [index for index, _ in wanted],
        trigger_times_s=[time_s for _, time_s in wanted],
        progress=partial(report, "throws, with recovery"),
    )
    simulated = dict(zip(wanted, again, strict=True))
    estimates = _estimates_without_recovery(logs)
    for rule in rules:
        recovered = {i: simulated[i, time] for i, time in triggered[rule.name].items()}
        found = _rule_estimates(logs, triggers[rule.name], recovered)
        found["threshold"] = Estimate.exact(rule.threshold, len(logs))
        estimates |= {f"throws.{rule.name}.{key}": estimate for key, estimate in found.items()}
    return estimates, logs


def _estimates_without_recovery(logs: Sequence[Motion]) -> dict[str, Estimate]:
    left = [log for log in logs if log.has_left]
    fell = [log for log in logs if log.has_fallen]
    return {
        "throws.falls_without_recovery": proportion(len(fell), len(logs)),
        "throws.leaves_safe_set_without_recovery": proportion(len(left), len(logs)),
        "throws.impact_to_leaving_s": median(
            np.array([log.leave_time_s - log.push_time_s for log in left])
        ),
        "throws.impact_to_fall_s": median(
            np.array([log.fall_time_s - log.push_time_s for log in fell])
        ),
    }


def _rule_estimates(
    logs: Sequence[Motion], times: np.ndarray, recovered: Mapping[int, Motion]
) -> dict[str, Estimate]:
    """Estimates of a rule from its trigger times (N,), NaN for never, and its recoveries."""
    n = len(logs)
    calm = [i for i, log in enumerate(logs) if not log.has_left]
    fell = [i for i, log in enumerate(logs) if log.has_fallen]
    touch = np.array([log.push_time_s for log in logs])
    fall = np.array([log.fall_time_s for log in logs])
    is_triggered = ~np.isnan(times)
    falls = sum(recovered.get(log.index, log).has_fallen for log in logs)
    in_time = [i for i in fell if is_triggered[i] and times[i] < fall[i]]
    after_touch = [i for i in in_time if times[i] >= touch[i] - 1e-9]
    successes = [log for log in recovered.values() if not log.has_fallen]
    estimates = {
        "falls_with_recovery": proportion(falls, n),
        "false_triggers": proportion(int(is_triggered[calm].sum()), len(calm)),
        "triggers_before_impact": proportion(
            int(np.sum(times[is_triggered] < touch[is_triggered] - 1e-9)), n
        ),
        "falls_missed": proportion(len(fell) - len(in_time), len(fell)),
        "trigger_after_impact_s": median(times[after_touch] - touch[after_touch]),
        "trigger_before_fall_s": median(fall[in_time] - times[in_time]),
        "false_triggers_that_fall": proportion(
            sum(recovered[logs[i].index].has_fallen for i in calm if is_triggered[i]),
            int(is_triggered[calm].sum()),
        ),
        "settled": proportion(
            sum(log["recovery_active"][-1, 0] == 0 for log in successes), len(successes)
        ),
    }
    for kind in sorted(VIOLATIONS) if recovered else ():
        column = VIOLATIONS.index(kind)
        estimates[f"recoveries_with_{kind}"] = proportion(
            sum(bool(log["violations"][:, column].any()) for log in successes), len(successes)
        )
    return estimates
