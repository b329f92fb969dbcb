"""Balls thrown at the actual plant: when each rule triggers recovery, and the outcome."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from drake_safety.diagrams.balancing.throws import VIOLATIONS, run_throws, trigger_time
from drake_safety.evaluation.metrics import Estimate, median, proportion
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer
from drake_safety.evaluation.shift_study import SEEN
from drake_safety.files.progress import StageProgress
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import Scenario

PAPER_THRESHOLD = 0.6
"""Γ_thre of the paper, on b_safe, the probability in the paper's mode."""


@dataclass(frozen=True, kw_only=True)
class TriggerRule:
    """A scorer with a threshold that triggers recovery."""

    scorer: Scorer
    threshold: float


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
    progress: StageProgress,
    persistence_s: float = 0.0,
    num_workers: int | None = None,
) -> tuple[dict[Key, Estimate], list[Motion]]:
    """Throws balls at the actual plant and compares the triggers of rules and their outcomes.

    "Don't know" triggers when it has lasted ``persistence_s``. Returns the estimates by dotted key,
    and the throws without recovery.
    """
    throw = partial(run_throws, scenario, seed=seed, num_workers=num_workers)
    logs = throw(range(num_throws), progress=partial(progress, "throws, balancing alone"))
    triggers = {
        rule.scorer.name: [
            trigger_time(log, log_probability(log, rule.scorer, persistence_s), rule.threshold)
            for log in logs
        ]
        for rule in rules
    }
    # Rules often trigger at the same instant: each distinct recovery is simulated once.
    pairs = {pair for times in triggers.values() for pair in enumerate(times)}
    wanted = sorted(pair for pair in pairs if not math.isnan(pair[1]))
    recoveries = throw(
        [index for index, _ in wanted],
        trigger_times_s=[time_s for _, time_s in wanted],
        progress=partial(progress, "throws, with recovery"),
    )
    simulated = dict(zip(wanted, recoveries, strict=True))
    leave_s = np.array([log.leave_time_s - log.push_time_s for log in logs if log.has_left])
    fall_s = np.array([log.fall_time_s - log.push_time_s for log in logs if log.has_fallen])
    estimates = {
        ("throws", "", "falls_without_recovery"): proportion(len(fall_s), len(logs)),
        ("throws", "", "leaves_safe_set_without_recovery"): proportion(len(leave_s), len(logs)),
        ("throws", "", "impact_to_leaving_s"): median(leave_s),
        ("throws", "", "impact_to_fall_s"): median(fall_s),
    }
    for rule in rules:
        times = triggers[rule.scorer.name]
        recovered = {i: simulated[i, t] for i, t in enumerate(times) if not math.isnan(t)}
        of_rule = _rule_estimates(logs, np.array(times), recovered)
        of_rule["threshold"] = Estimate.exact(rule.threshold, len(logs))
        estimates |= {("throws", rule.scorer.name, key): e for key, e in of_rule.items()}
    return estimates, logs


def _rule_estimates(
    logs: Sequence[Motion], times: np.ndarray, recovered: Mapping[int, Motion]
) -> dict[str, Estimate]:
    """Estimates of a rule from its trigger times (N,), NaN for never, and its recoveries."""
    times = np.where(np.isnan(times), np.inf, times)
    impact = np.array([log.push_time_s for log in logs])
    fall = np.array([log.fall_time_s for log in logs])
    falls, is_early = np.isfinite(fall), times < impact - 1e-9
    in_time = falls & (times < fall)
    after_impact = in_time & ~is_early
    stays = np.array([not log.has_left for log in logs])
    false = stays & np.isfinite(times)
    fallen = [recovered.get(i, log).has_fallen for i, log in enumerate(logs)]
    successes = [log for log in recovered.values() if not log.has_fallen]

    def share(counted: np.ndarray, among: np.ndarray) -> Estimate:
        return proportion(int(counted.sum()), int(among.sum()))

    estimates = {
        "falls_with_recovery": proportion(sum(fallen), len(logs)),
        "false_triggers": share(false, stays),
        "triggers_before_impact": proportion(int(is_early.sum()), len(logs)),
        "falls_missed": share(falls & ~in_time, falls),
        "trigger_after_impact_s": median(times[after_impact] - impact[after_impact]),
        "trigger_before_fall_s": median(fall[in_time] - times[in_time]),
        "false_triggers_that_fall": share(false & fallen, false),
        "settled": proportion(
            sum(log["recovery_active"][-1, 0] == 0 for log in successes), len(successes)
        ),
    }
    for kind in sorted(VIOLATIONS) if recovered else ():
        column = VIOLATIONS.index(kind)
        violated = sum(bool(log["violations"][:, column].any()) for log in successes)
        estimates[f"recoveries_with_{kind}"] = proportion(violated, len(successes))
    return estimates
