"""Balls thrown at the actual plant: when each rule triggers recovery, and the outcome."""

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

PAPER_THRESHOLD = 0.6  # Γ_thre, on b_safe, the probability in the paper's mode.


@dataclass(frozen=True, kw_only=True)
class TriggerRule:
    """A scorer with a threshold that triggers recovery."""

    scorer: Scorer
    threshold: float


def log_probability(log: Motion, scorer: Scorer, persistence_s: float = 0.0) -> np.ndarray:
    """Safety probability of a scorer at every row as a `RecoveryTrigger` takes it, (N,)."""
    probability = scorer.probability(*(log[name] for name in SEEN))
    if len(probability) < 2 or not persistence_s:
        return probability
    # Where nothing is known, the highest within the persistence counts; before it has passed, 1.
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
    """Compares the triggers of rules and their outcomes; also returns throws without recovery."""
    # The motion before a recovery does not depend on the trigger: a throw is logged once without
    # recovery, rules are evaluated on the log, and recovery is triggered at the times found.
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
    num_falls = sum(log.has_fallen for log in logs)
    estimates = {("throws", "", "falls_without_recovery"): proportion(num_falls, len(logs))}
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
    times = np.where(np.isnan(times), np.inf, times)
    impact = np.array([log.push_time_s for log in logs])
    fall = np.array([log.fall_time_s for log in logs])
    falls = np.isfinite(fall)
    in_time = falls & (times < fall)
    after_impact = in_time & ~(times < impact - 1e-9)
    stays = np.array([not log.has_left for log in logs])
    fallen = [recovered.get(i, log).has_fallen for i, log in enumerate(logs)]
    successes = [log for log in recovered.values() if not log.has_fallen]

    def share(counted: np.ndarray, among: np.ndarray) -> Estimate:
        return proportion(int(counted.sum()), int(among.sum()))

    estimates = {
        "falls_with_recovery": proportion(sum(fallen), len(logs)),
        "false_triggers": share(stays & np.isfinite(times), stays),
        "falls_missed": share(falls & ~in_time, falls),
        "trigger_after_impact_s": median(times[after_impact] - impact[after_impact]),
        "trigger_before_fall_s": median(fall[in_time] - times[in_time]),
    }
    for kind in sorted(VIOLATIONS) if recovered else ():
        column = VIOLATIONS.index(kind)
        violated = sum(bool(log["violations"][:, column].any()) for log in successes)
        estimates[f"recoveries_with_{kind}"] = proportion(violated, len(successes))
    return estimates
