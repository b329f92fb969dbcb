"""What ``evaluate`` says of Γ as a probability, and of a calibration that is stored with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drake_safety.cli.console import interval, new_table
from drake_safety.cli.findings import Findings, Judged

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Figure

_COLUMNS = {
    "miss_rate": "unsafe called safe",
    "unsafe_unknown": "don't know",
    "safe_recall": "safe called safe",
    "safe_unknown": "don't know",
    "false_alarm_rate": "called unsafe",
}


def evaluate_calibration(judged: Judged) -> Findings:
    """Reliability of either mode at k = 0, and whether stored promises are kept.

    Args:
        judged: What is judged.
    """
    from drake_safety.evaluation.calibration_study import reliability, verdict_shares
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.metrics import Bootstrap
    from drake_safety.evaluation.reliability_figure import reliability_figure
    from drake_safety.evaluation.scorers import assessment_scorer
    from drake_safety.learning.calibration import PLAN, episode_scores
    from drake_safety.learning.segments import split

    segments = split(judged.test_set, stride=1, discount=1.0, shortest=1)
    figures: dict[str, Figure] = {}
    curves = {}
    table = new_table(
        "mode",
        "judged by",
        "promised",
        *_COLUMNS.values(),
        title="Stored calibrations on fresh episodes [%]",
    )
    for mode, gamma in {"sharpened": judged.sharpened, "paper": judged.paper}.items():
        score = assessment_scorer(mode, gamma, "calibrated").unsafe_score(segments)
        expected, is_unsafe = episode_scores(segments, score, PLAN)
        curves[mode] = reliability(expected, is_unsafe)

        def error(
            weight: np.ndarray, p: np.ndarray = expected, label: np.ndarray = is_unsafe
        ) -> float:
            drawn = np.repeat(np.arange(len(p)), weight.astype(int))
            return reliability(p[drawn], label[drawn]).calibration_error

        figures[f"calibration.{mode}.expected_calibration_error"] = Bootstrap(
            num_resamples=100
        ).over_episodes(error, np.arange(len(expected)))
        for kind, one in gamma.calibrations_.items():
            shares = verdict_shares(one, *episode_scores(segments, score, kind))
            figures |= {f"calibration.{mode}.{kind}.{key}": value for key, value in shares.items()}
            table.add_row(
                mode,
                {"plan": "first row", "motion": "worst row"}[kind],
                f"{100 * one.miss_rate:g}",
                *(interval(shares[key], 100, 1) for key in _COLUMNS),
            )
    return Findings(
        figures=figures,
        pictures=save(reliability_figure(curves), judged.folder / "reliability"),
        tables=[table] if table.row_count else [],
    )
