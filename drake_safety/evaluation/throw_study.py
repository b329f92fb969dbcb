"""Balls thrown at the actual plant: when each rule triggers recovery, and the outcome."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from drake_safety.evaluation.metrics import Estimate, median, proportion
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.throws import ThrowLog, run_throws, trigger_time

PAPER_THRESHOLD = 0.6
"""Γ_thre of the paper, on b_safe, the probability in the paper's mode."""


@dataclass(frozen=True, kw_only=True)
class TriggerRule:
    """A scorer with a threshold that triggers recovery.

    Attributes:
        name: Its key in tables.
        scorer: The scorer.
        threshold: Γ_thre; None to choose it on the calibration throws.
    """

    name: str
    scorer: Scorer
    threshold: float | None = None


def trigger_rules(
    sharpened: SafetyAssessment,
    paper: SafetyAssessment,
    classifiers: Sequence[Scorer],
    *,
    threshold: float,
) -> list[TriggerRule]:
    """The rules that are compared: the scenario's, the paper's and the baseline classifiers.

    Args:
        sharpened: An assessment in the sharpened mode.
        paper: An assessment in the paper's mode.
        classifiers: Baseline classifiers, whose thresholds are chosen on calibration throws.
        threshold: The scenario's Γ_thre.

    Returns:
        The rules; the scenario's own is the first, named "sharpened".
    """
    own, printed = assessment_scorer("sharpened", sharpened), assessment_scorer("paper", paper)
    return [
        TriggerRule(name="sharpened", scorer=own, threshold=threshold),
        TriggerRule(name="paper", scorer=printed, threshold=PAPER_THRESHOLD),
        *(TriggerRule(name=scorer.name, scorer=scorer) for scorer in classifiers),
    ]


@dataclass(frozen=True, kw_only=True)
class ThrowStudy:
    """The result of :func:`evaluate_throws`.

    Attributes:
        estimates: By dotted key.
        logs: The throws without recovery.
        trigger_times_s: Per rule, the trigger time of each throw [s], (N,); NaN for never.
        recovered: Per rule, the logs with recovery of the triggered throws, by index.
        thresholds: Per rule.
        calibration_logs: The throws on which thresholds were chosen; empty if all were given.
    """

    estimates: dict[str, Estimate]
    logs: list[ThrowLog]
    trigger_times_s: dict[str, np.ndarray]
    recovered: dict[str, dict[int, ThrowLog]]
    thresholds: dict[str, float]
    calibration_logs: list[ThrowLog] = field(default_factory=list)

    def outcomes(self, rule: str | None = None) -> list[str]:
        """The outcome of each throw, a key of `throws_figure.OUTCOMES`.

        Args:
            rule: The rule that triggers recovery; none by default.
        """
        recovered = {} if rule is None else self.recovered[rule]
        outcomes = []
        for log in self.logs:
            final = recovered.get(log.index, log)
            if final.has_fallen:
                outcomes.append("fell")
            elif log.index not in recovered:
                outcomes.append("survived")
            else:
                outcomes.append("recovered" if log.has_left else "false trigger")
        return outcomes


def log_probability(log: ThrowLog, scorer: Scorer, persistence_s: float = 0.0) -> np.ndarray:
    """Safety probability of a scorer at every row of a log as a `RecoveryTrigger` takes it, (N,).

    Args:
        log: The log.
        scorer: The scorer.
        persistence_s: Where nothing is known, the highest probability within this time counts [s];
            before it has passed, 1.
    """
    probability = scorer.probability(log.state, log.desired_preview, log.features)
    if len(probability) < 2 or not persistence_s:
        return probability
    num_waited = math.ceil(persistence_s / (log.time_s[1] - log.time_s[0]) - 1e-6)
    padded = np.concatenate([np.ones(num_waited), np.nan_to_num(probability, nan=0.0)])
    highest = np.lib.stride_tricks.sliding_window_view(padded, num_waited + 1).max(axis=1)
    return np.where(np.isnan(probability), highest, probability)


def choose_threshold(
    logs: Sequence[ThrowLog],
    probabilities: Sequence[np.ndarray],
    *,
    max_false_share: float = 0.015,
) -> float:
    """The highest threshold whose share of false triggers stays within a bound.

    A higher threshold triggers earlier and misses fewer falls, but has more false triggers.

    Args:
        logs: Calibration throws without recovery.
        probabilities: Safety probability of each log's rows.
        max_false_share: Bound on the share of false triggers among the throws that stay in the
            safe set without recovery.

    Returns:
        Γ_thre.
    """
    # A throw that stays safe has a false trigger if its lowest probability is below Γ_thre.
    lowest = np.array(
        [
            np.nan_to_num(p, nan=0.0).min()
            for log, p in zip(logs, probabilities, strict=True)
            if not log.has_left
        ]
    )
    if len(lowest) == 0:
        raise ValueError("choose_threshold: no calibration throw stays in the safe set")
    candidates = np.linspace(0.01, 0.99, 99)
    false_share = np.array([(lowest < threshold).mean() for threshold in candidates])
    allowed = candidates[false_share <= max_false_share]
    return float(allowed[-1]) if len(allowed) else float(candidates[0])


def evaluate_throws(
    scenario: Scenario,
    rules: Sequence[TriggerRule],
    *,
    num_throws: int,
    num_calibration: int,
    seed: int,
    calibration_seed: int,
    persistence_s: float = 0.0,
    variation: str = "actual",
    num_workers: int | None = None,
    progress: StageProgress | bool | None = None,
) -> ThrowStudy:
    """Throws balls at the actual plant and compares the triggers of rules and their outcomes.

    Args:
        scenario: The scenario.
        rules: The rules.
        num_throws: Number of test throws.
        num_calibration: Number of calibration throws, for thresholds that are None.
        seed: Seed of the test throws.
        calibration_seed: Seed of the calibration throws.
        persistence_s: Time for which "don't know" must have lasted to trigger [s].
        variation: Variation of the plant.
        num_workers: Number of worker processes.
        progress: Called with a stage, the number done and the number wanted; True shows it.

    Raises:
        ValueError: The seeds are equal, or no threshold can be chosen because every calibration
            throw leaves the safe set.
    """
    if seed == calibration_seed:
        raise ValueError(f"throws: seed and calibration seed are both {seed}; they must differ")
    throw = partial(run_throws, scenario, variation=variation, num_workers=num_workers)
    thresholds = {rule.name: rule.threshold for rule in rules if rule.threshold is not None}
    with shown(progress, lambda stages: stages) as given:
        report = given or (lambda stage, done, total: None)
        calibration: list[ThrowLog] = []
        if len(thresholds) < len(rules):
            calibration = throw(
                list(range(num_calibration)),
                seed=calibration_seed,
                progress=partial(report, "calibration throws"),
            )
            for rule in rules:
                if rule.threshold is None:
                    probabilities = [
                        log_probability(log, rule.scorer, persistence_s) for log in calibration
                    ]
                    thresholds[rule.name] = choose_threshold(calibration, probabilities)
        logs = throw(
            list(range(num_throws)), seed=seed, progress=partial(report, "throws, balancing alone")
        )
        triggers = {
            rule.name: np.array(
                [
                    trigger_time(
                        log,
                        log_probability(log, rule.scorer, persistence_s),
                        thresholds[rule.name],
                    )
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
        wanted = {pair for times in triggered.values() for pair in times.items()}
        simulated = _simulate_recoveries(partial(throw, seed=seed), wanted, report)
    recovered = {
        name: {index: simulated[index, time] for index, time in times.items()}
        for name, times in triggered.items()
    }
    estimates = _balancing_estimates(logs)
    for rule in rules:
        found = _rule_estimates(logs, triggers[rule.name], recovered[rule.name])
        threshold = thresholds[rule.name]
        found["threshold"] = Estimate.exact(threshold, len(logs))
        estimates |= {f"throws.{rule.name}.{key}": estimate for key, estimate in found.items()}
    return ThrowStudy(
        estimates=estimates,
        logs=logs,
        trigger_times_s=triggers,
        recovered=recovered,
        thresholds=thresholds,
        calibration_logs=calibration,
    )


def _simulate_recoveries(
    throw: Callable[..., list[ThrowLog]],
    wanted: Collection[tuple[int, float]],
    report: StageProgress,
) -> dict[tuple[int, float], ThrowLog]:
    """Simulates throws with recovery.

    Args:
        throw: `run_throws` without indices, trigger times and progress.
        wanted: Pairs of index and trigger time [s].
        report: Called with a stage, the number done and the number wanted.

    Returns:
        The log of each pair.
    """
    logs: dict[tuple[int, float], ThrowLog] = {}

    def report_round(done_before: int, done: int, _: int) -> None:
        report("throws, with recovery", done_before + done, len(wanted))

    for trigger_times_s in _rounds(wanted):
        for log in throw(
            sorted(trigger_times_s),
            trigger_times_s=trigger_times_s,
            progress=partial(report_round, len(logs)),
        ):
            logs[log.index, trigger_times_s[log.index]] = log
    return logs


def _rounds(wanted: Iterable[tuple[int, float]]) -> list[dict[int, float]]:
    """Splits pairs of index and trigger time into rounds in which each index occurs once."""
    rounds: list[dict[int, float]] = []
    for index, time_s in sorted(wanted):
        free = next((one for one in rounds if index not in one), None)
        if free is None:
            rounds.append(free := {})
        free[index] = time_s
    return rounds


def _balancing_estimates(logs: Sequence[ThrowLog]) -> dict[str, Estimate]:
    """Estimates of the throws without recovery."""
    n = len(logs)
    left = [log for log in logs if log.has_left]
    fell = [log for log in logs if log.has_fallen]
    return {
        "throws.falls_without_recovery": proportion(len(fell), n),
        "throws.leaves_safe_set_without_recovery": proportion(len(left), n),
        "throws.impact_to_leaving_s": median(
            np.array([log.leave_time_s - log.throw.time_s for log in left])
        ),
        "throws.impact_to_fall_s": median(
            np.array([log.fall_time_s - log.throw.time_s for log in fell])
        ),
    }


def _rule_estimates(
    logs: Sequence[ThrowLog], times: np.ndarray, recovered: Mapping[int, ThrowLog]
) -> dict[str, Estimate]:
    """Estimates of the throws with the recovery that a rule triggers.

    Args:
        logs: The N throws without recovery.
        times: Trigger times of the rule [s], (N,); NaN for never.
        recovered: By index of the throw, the logs with recovery of triggered throws.
    """
    n = len(logs)
    calm = [i for i, log in enumerate(logs) if not log.has_left]
    fell = [i for i, log in enumerate(logs) if log.has_fallen]
    touch = np.array([log.throw.time_s for log in logs])
    fall = np.array([log.fall_time_s for log in logs])
    is_triggered = ~np.isnan(times)
    falls = sum(
        recovered[log.index].has_fallen if log.index in recovered else log.has_fallen
        for log in logs
    )
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
            sum(log.recovery_active[-1] == 0 for log in successes), len(successes)
        ),
    }
    kinds = sorted({kind for log in recovered.values() for kind in log.violations})
    for kind in kinds:
        estimates[f"recoveries_with_{kind}"] = proportion(
            sum(log.violations[kind] > 0 for log in successes), len(successes)
        )
    return estimates
