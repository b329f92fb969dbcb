"""Balls at the actual plant: when each scorer would have the robot step, and what becomes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from drake_safety.evaluation.metrics import Estimate, median, proportion
from drake_safety.evaluation.scorers import Scorer, StageProgress, assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.throws import ThrowLog, run_throws, trigger_time

PAPER_THRESHOLD = 0.6
"""Γ_thre of the paper, on b_safe."""


@dataclass(frozen=True, kw_only=True)
class TriggerRule:
    """A scorer with a threshold: when would it have the robot step.

    Attributes:
        name: Its key in tables.
        scorer: Who scores.
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
    is_normalized: bool,
) -> list[TriggerRule]:
    """Those compared: Γ as the scenario triggers on it, Γ as the paper does, and the classifiers.

    Args:
        sharpened: An assessment in the sharpened mode.
        paper: One in the paper's mode.
        classifiers: Direct classifiers; their thresholds are left open.
        threshold: The scenario's Γ_thre.
        is_normalized: Whether that is on b_safe / (1 - μ) or, literally, on b_safe.

    Returns:
        The rules, the scenario's own first, named "sharpened".
    """
    own = assessment_scorer(
        "sharpened", sharpened, "normalized" if is_normalized else "safety_probability"
    )
    literal = assessment_scorer("literal", sharpened, "safety_probability")
    paper_literal = assessment_scorer("paper_literal", paper, "safety_probability")
    return [
        TriggerRule(name="sharpened", scorer=own, threshold=threshold),
        TriggerRule(
            name=f"sharpened_literal_{PAPER_THRESHOLD}", scorer=literal, threshold=PAPER_THRESHOLD
        ),
        TriggerRule(
            name=f"paper_literal_{PAPER_THRESHOLD}",
            scorer=paper_literal,
            threshold=PAPER_THRESHOLD,
        ),
        *(TriggerRule(name=scorer.name, scorer=scorer) for scorer in classifiers),
    ]


@dataclass(frozen=True, kw_only=True)
class ThrowStudy:
    """What :func:`evaluate_throws` found.

    Attributes:
        estimates: By dotted key.
        logs: The throws without recovery.
        trigger_times_s: Per rule, when it triggered in each throw [s], (N,); NaN for never.
        recovered: Per rule, the logs with recovery by index of the throw, triggered ones only.
        thresholds: Per rule.
        calibration_logs: The other throws, on which thresholds were chosen, if any were left open.
    """

    estimates: dict[str, Estimate]
    logs: list[ThrowLog]
    trigger_times_s: dict[str, np.ndarray]
    recovered: dict[str, dict[int, ThrowLog]]
    thresholds: dict[str, float]
    calibration_logs: list[ThrowLog] = field(default_factory=list)

    def outcomes(self, rule: str | None = None) -> list[str]:
        """What became of each throw, in the words of the throws figure.

        Args:
            rule: Who triggers recovery; nobody by default.
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


def log_probability(log: ThrowLog, scorer: Scorer) -> np.ndarray:
    """The scorer's safety probability at every row of a log, (N,)."""
    return scorer.probability(log.state, log.desired_preview, log.features)


def choose_threshold(
    logs: Sequence[ThrowLog],
    probabilities: Sequence[np.ndarray],
    *,
    max_false_share: float = 0.025,
) -> float:
    """The highest threshold whose share of false triggers stays within a bound.

    A high threshold triggers early and misses nothing; false triggers are what limits it.

    Args:
        logs: Calibration throws without recovery.
        probabilities: Of each log's rows.
        max_false_share: Bound on the share of false triggers among the throws that balancing
            survives inside the safe set.

    Returns:
        Γ_thre.
    """
    # A calm throw triggers falsely below its lowest probability.
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
    variation: str = "actual",
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> ThrowStudy:
    """Throws balls at the actual plant and compares when rules trigger, and what becomes of it.

    Args:
        scenario: The scenario.
        rules: Who triggers.
        num_throws: Fresh throws that are reported.
        num_calibration: Other throws, on which thresholds left open are chosen.
        seed: Of the reported throws.
        calibration_seed: Of the others.
        variation: Which plant.
        num_workers: Processes.
        progress: Called with a stage, the number done and the number wanted.

    Raises:
        ValueError: Both seeds are the same, or there is no threshold to choose: every calibration
            throw leaves the safe set.
    """
    if seed == calibration_seed:
        raise ValueError(f"throws: seed and calibration seed are both {seed}; they must differ")
    report = progress or _report_to_nobody
    throw = partial(run_throws, scenario, variation=variation, num_workers=num_workers)
    thresholds = {rule.name: rule.threshold for rule in rules if rule.threshold is not None}
    calibration: list[ThrowLog] = []
    if len(thresholds) < len(rules):
        calibration = throw(
            list(range(num_calibration)),
            seed=calibration_seed,
            progress=partial(report, "calibration throws"),
        )
        for rule in rules:
            if rule.threshold is None:
                probabilities = [log_probability(log, rule.scorer) for log in calibration]
                thresholds[rule.name] = choose_threshold(calibration, probabilities)
    logs = throw(
        list(range(num_throws)), seed=seed, progress=partial(report, "throws, balancing alone")
    )
    triggers = {
        rule.name: np.array(
            [
                trigger_time(log, log_probability(log, rule.scorer), thresholds[rule.name])
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
    # Rules often agree on the instant: each distinct recovery is simulated once.
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
        found["threshold"] = Estimate(threshold, threshold, threshold, len(logs))
        estimates |= {f"throws.{rule.name}.{key}": estimate for key, estimate in found.items()}
    return ThrowStudy(
        estimates=estimates,
        logs=logs,
        trigger_times_s=triggers,
        recovered=recovered,
        thresholds=thresholds,
        calibration_logs=calibration,
    )


def _report_to_nobody(stage: str, done: int, total: int) -> None:
    """Stands in for a progress that was not asked for."""


def _simulate_recoveries(
    throw: Callable[..., list[ThrowLog]],
    wanted: Collection[tuple[int, float]],
    report: StageProgress,
) -> dict[tuple[int, float], ThrowLog]:
    """Simulates throws with recovery.

    Args:
        throw: `run_throws` but for indices, trigger times and progress.
        wanted: Pairs of index and trigger time [s].
        report: Progress.

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
    """Shares pairs of index and trigger time out among rounds in which no index stands twice."""
    rounds: list[dict[int, float]] = []
    for index, time_s in sorted(wanted):
        free = next((one for one in rounds if index not in one), None)
        if free is None:
            rounds.append(free := {})
        free[index] = time_s
    return rounds


def _balancing_estimates(logs: Sequence[ThrowLog]) -> dict[str, Estimate]:
    """What becomes of the throws when the robot never steps."""
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
    """What becomes of the throws when a rule has the robot step.

    Args:
        logs: The N throws without recovery.
        times: When the rule triggered in each [s], (N,); NaN for never.
        recovered: By index of the throw, the logs with recovery of those it triggered in.
    """
    n = len(logs)
    calm = [i for i, log in enumerate(logs) if not log.has_left]
    fell = [i for i, log in enumerate(logs) if log.has_fallen]
    touch = np.array([log.throw.time_s for log in logs])
    fall = np.array([log.fall_time_s for log in logs])
    is_triggered = ~np.isnan(times)
    # Without a trigger the log itself says how the throw ends; with one, the recovery does.
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
