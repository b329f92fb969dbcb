"""What ``evaluate`` does with pushed motions: Γ as an alarm, beside what one watches instead."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from rich.table import Table

from drake_safety.cli.console import new_table
from drake_safety.cli.findings import Findings, Judged

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Figure
    from drake_safety.simulation.pushed_motions import WatchedMotion


def evaluate_pushes(
    judged: Judged, num_motions: int, num_calibration: int, *, seed: int, calibration_seed: int
) -> Findings:
    """Pushes a robot on its way to goals that it reaches safely by itself.

    Args:
        judged: What is judged.
        num_motions: Fresh motions, each undisturbed and pushed.
        num_calibration: Other motions, for thresholds.
        seed: Of the motions.
        calibration_seed: Of the others.
    """
    from drake_safety.simulation.pushed_motions import run_pushed_motions

    run = partial(run_pushed_motions, judged.scenario, num_workers=judged.workers)
    stages = judged.stages
    test = run(num_motions, seed=seed, progress=partial(stages, "pushes"))
    calibration = run(
        num_calibration, seed=calibration_seed, progress=partial(stages, "calibration pushes")
    )
    return evaluate_monitoring(judged, calibration, test)


def evaluate_monitoring(
    judged: Judged, calibration: Sequence[WatchedMotion], test: Sequence[WatchedMotion]
) -> Findings:
    """Judges everyone who could watch these motions.

    Args:
        judged: What is judged.
        calibration: Motions on which thresholds are chosen.
        test: Fresh motions.
    """
    from drake_safety.evaluation.alarms import assessment_alarms, scorer_alarm, threshold_alarms
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.monitoring_figure import monitoring_figure
    from drake_safety.evaluation.monitoring_study import evaluate_alarms

    if all(motion.has_left for motion in calibration):
        # Nobody could be allowed the same share of false alarms.
        return Findings()
    loop = judged.scenario.make_loop()
    alarms = [
        *assessment_alarms("sharpened", judged.sharpened),
        *assessment_alarms("paper", judged.paper),
        *(scorer_alarm(scorer) for scorer in judged.classifiers),
        *threshold_alarms(loop.state_names, loop.feature_names, loop.watched_features),
    ]
    study = evaluate_alarms(alarms, calibration, test)
    return Findings(
        figures=study.figures,
        pictures=save(monitoring_figure(study), judged.folder / "monitoring"),
        tables=[_table(study.figures)],
    )


def _table(figures: dict[str, Figure]) -> Table:
    """The report's own table on the console, and below it where others are ahead."""
    from drake_safety.evaluation.report.results import Results
    from drake_safety.evaluation.report.verdicts import alarm_table

    found = alarm_table(Results(figures=figures))
    table = new_table(found.corner, *(column.title for column in found.columns), title=found.title)
    for row in found.rows:
        cells = [
            f"{column.value_text(figure)} {column.interval_text(figure)}".strip()
            for column, figure in zip(found.columns, row.figures, strict=True)
        ]
        table.add_row(row.label, *cells)
    ahead = found.rivals_ahead()
    table.caption = found.meaning
    if ahead:
        table.caption += "\nAhead of sharpened: " + "; ".join(ahead)
    return table
