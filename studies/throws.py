"""Thresholds of triggers, chosen on other throws, and the trigger rules of baselines."""

from collections.abc import Sequence

import numpy as np

from drake_safety.diagrams.balancing.throw_study import TriggerRule, log_probability
from drake_safety.evaluation.scorers import Scorer
from drake_safety.simulation.motion import Motion


def choose_threshold(
    logs: Sequence[Motion],
    scorer: Scorer,
    persistence_s: float = 0.0,
    *,
    max_false_share: float = 0.015,
) -> float:
    """The highest threshold whose share of false triggers stays within a bound.

    A higher threshold triggers earlier and misses fewer falls, but has more false triggers.
    """
    # A throw that stays safe has a false trigger if its lowest probability is below Γ_thre.
    lowest = np.array(
        [
            np.nan_to_num(log_probability(log, scorer, persistence_s), nan=0.0).min()
            for log in logs
            if not log.has_left
        ]
    )
    if len(lowest) == 0:
        raise ValueError("choose_threshold: no calibration throw stays in the safe set")
    candidates = np.linspace(0.01, 0.99, 99)
    false_share = np.array([(lowest < threshold).mean() for threshold in candidates])
    allowed = candidates[false_share <= max_false_share]
    return float(allowed[-1]) if len(allowed) else float(candidates[0])


def classifier_rules(
    classifiers: Sequence[Scorer], logs: Sequence[Motion], persistence_s: float
) -> list[TriggerRule]:
    """The classifiers as triggers, with thresholds chosen on calibration throws."""
    return [
        TriggerRule(scorer=one, threshold=choose_threshold(logs, one, persistence_s))
        for one in classifiers
    ]
