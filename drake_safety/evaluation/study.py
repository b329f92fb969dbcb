"""The study behind ``drake-safety evaluate``: fresh episodes, fresh throws, every scorer alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.baselines import KINDS, DirectClassifier
from drake_safety.evaluation.metrics import (
    Figure,
    auc_difference,
    episode_figures,
    median,
    proportion,
    segment_figures,
    threshold_at,
)
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episodes, split
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.throws import ThrowLog, run_throws, trigger_time

MAX_TRIGGER_DELAY_S = 0.05
Figures = dict[str, Figure]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class Scorer:
    """Something that says how probable safety is.

    Attributes:
        name: Its key in tables.
        probability: Safety probability of states, previews and features, (N,); NaN where it does
            not know.
        uses_true_state: Whether nominal episodes show it the state without noise.
    """

    name: str
    probability: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    uses_true_state: bool = False


def assessment_scorer(name: str, assessment: SafetyAssessment, *, is_normalized: bool) -> Scorer:
    """Γ as a scorer, normalised or literal."""

    def probability(
        state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray
    ) -> np.ndarray:
        result = assessment.predict(
            state, desired_preview, features if assessment.uses_features else None
        )
        return result.normalized if is_normalized else result.safety_probability

    return Scorer(
        name=name,
        probability=probability,
        uses_true_state=not assessment.parameters.is_sharpened,
    )


def baseline_scorers(episodes: Episodes, progress: Progress | None = None) -> list[Scorer]:
    """The direct classifiers, trained on the assessment's own training episodes."""
    scorers = []
    for i, kind in enumerate(KINDS):
        if progress is not None:
            progress("direct classifiers", i, len(KINDS))
        classifier = DirectClassifier(kind).fit(episodes)

        def probability(
            state: np.ndarray,
            desired_preview: np.ndarray,
            features: np.ndarray,
            classifier: DirectClassifier = classifier,
        ) -> np.ndarray:
            return 1.0 - classifier.predict_unsafe(state, desired_preview, features)

        scorers.append(Scorer(name=kind, probability=probability))
    if progress is not None:
        progress("direct classifiers", len(KINDS), len(KINDS))
    return scorers


def evaluate_episodes(
    scorers: Sequence[Scorer], calibration: Episodes, test: Episodes
) -> tuple[Figures, dict[str, np.ndarray], np.ndarray]:
    """Every scorer on fresh episodes, per segment and at k = 0.

    The threshold of the recalls is the one of best balanced accuracy on the calibration set, of
    its segments and of its first steps; the test set decides nothing.

    Args:
        scorers: Who is judged.
        calibration: Other fresh episodes, for thresholds.
        test: Fresh episodes.

    Returns:
        The figures by dotted key, the unsafe score of every test segment by scorer, and the
        segments' labels.
    """
    segments = split(test, stride=1, discount=1.0)
    seen = split(calibration, stride=1, discount=1.0)
    figures: Figures = {}
    scores = {}
    for scorer in scorers:
        name = scorer.name
        unsafe, seen_unsafe = (
            1.0
            - scorer.probability(
                part.true_state if scorer.uses_true_state else part.state,
                part.desired_preview,
                part.features,
            )
            for part in (segments, seen)
        )
        scores[name] = unsafe
        threshold = threshold_at(seen_unsafe, seen.is_unsafe)
        at_start = seen.is_first
        start_threshold = threshold_at(seen_unsafe[at_start], seen.is_unsafe[at_start])
        for key, value in segment_figures(segments, unsafe, threshold=threshold).items():
            figures[f"segments.{name}.{key}"] = value
        for key, value in episode_figures(segments, unsafe, threshold=start_threshold).items():
            figures[f"episodes.{name}.{key}"] = value
    names = [scorer.name for scorer in scorers]
    if "sharpened" in names:
        first = segments.is_first
        for key, rows in (("segments", slice(None)), ("episodes", first)):
            others = [name for name in names if name in KINDS]
            if others:
                best = max(others, key=lambda name: figures[f"{key}.{name}.auc"].value)
                figures[f"{key}.sharpened_minus_best_classifier.auc"] = auc_difference(
                    scores["sharpened"][rows],
                    scores[best][rows],
                    segments.is_unsafe[rows],
                    segments.episode[rows],
                )
    figures["episodes.share_unsafe"] = proportion(test.num_unsafe, test.num_unsafe + test.num_safe)
    figures["episodes.share_diverged"] = proportion(test.num_diverged, len(test))
    return figures, scores, segments.is_unsafe


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


@dataclass(frozen=True, kw_only=True)
class ThrowStudy:
    """What :func:`evaluate_throws` found.

    Attributes:
        figures: By dotted key.
        logs: The throws without recovery.
        trigger_times_s: Per rule, when it triggered in each throw, (N,); NaN for never.
        recovered: Per rule, the logs with recovery by index of the throw, triggered ones only.
        thresholds: Per rule.
    """

    figures: Figures
    logs: list[ThrowLog]
    trigger_times_s: dict[str, np.ndarray]
    recovered: dict[str, dict[int, ThrowLog]]
    thresholds: dict[str, float]

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
    progress: Progress | None = None,
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
        ValueError: Both seeds are the same.
    """
    if seed == calibration_seed:
        raise ValueError(f"throws: seed and calibration seed are both {seed}; they must differ")

    def report(stage: str) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, total: progress(stage, done, total)

    thresholds = {rule.name: rule.threshold for rule in rules if rule.threshold is not None}
    if len(thresholds) < len(rules):
        calibration = run_throws(
            scenario,
            list(range(num_calibration)),
            seed=calibration_seed,
            variation=variation,
            num_workers=num_workers,
            progress=report("calibration throws"),
        )
        for rule in rules:
            if rule.threshold is None:
                probabilities = [log_probability(log, rule.scorer) for log in calibration]
                thresholds[rule.name] = choose_threshold(calibration, probabilities)
    logs = run_throws(
        scenario,
        list(range(num_throws)),
        seed=seed,
        variation=variation,
        num_workers=num_workers,
        progress=report("throws, balancing alone"),
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
    # Rules often agree on the instant: each distinct recovery is simulated once.
    wanted: set[tuple[int, float]] = set()
    for times in triggers.values():
        wanted |= {
            (log.index, float(time))
            for log, time in zip(logs, times, strict=True)
            if not math.isnan(time)
        }
    by_round: list[dict[int, float]] = []
    for index, time in sorted(wanted):
        for recoveries in by_round:
            if index not in recoveries:
                recoveries[index] = time
                break
        else:
            by_round.append({index: time})
    results: dict[tuple[int, float], ThrowLog] = {}
    done = 0
    for recoveries in by_round:
        start = done

        def advance(count: int, _: int, start: int = start) -> None:
            if progress is not None:
                progress("throws, with recovery", start + count, len(wanted))

        for log in run_throws(
            scenario,
            sorted(recoveries),
            seed=seed,
            variation=variation,
            trigger_times_s=recoveries,
            num_workers=num_workers,
            progress=advance,
        ):
            results[log.index, recoveries[log.index]] = log
        done += len(recoveries)
    recovered = {
        name: {
            log.index: results[log.index, float(time)]
            for log, time in zip(logs, times, strict=True)
            if not math.isnan(time)
        }
        for name, times in triggers.items()
    }
    figures = _balancing_figures(logs)
    for rule in rules:
        for key, value in _rule_figures(logs, triggers[rule.name], recovered[rule.name]).items():
            figures[f"throws.{rule.name}.{key}"] = value
        figures[f"throws.{rule.name}.threshold"] = Figure(
            thresholds[rule.name], thresholds[rule.name], thresholds[rule.name], len(logs)
        )
    return ThrowStudy(
        figures=figures,
        logs=logs,
        trigger_times_s=triggers,
        recovered=recovered,
        thresholds=thresholds,
    )


def _balancing_figures(logs: Sequence[ThrowLog]) -> Figures:
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


def _rule_figures(
    logs: Sequence[ThrowLog], times: np.ndarray, recovered: Mapping[int, ThrowLog]
) -> Figures:
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
    figures = {
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
        figures[f"recoveries_with_{kind}"] = proportion(
            sum(log.violations[kind] > 0 for log in successes), len(successes)
        )
    return figures
