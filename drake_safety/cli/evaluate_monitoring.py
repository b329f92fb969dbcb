"""Evaluation of alarms on pushed motions by ``evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from drake_safety.cli.findings import Findings, Judged
from drake_safety.cli.training_folder import fresh_episodes_folder

if TYPE_CHECKING:
    from drake_safety.simulation.watched_motion import WatchedMotion

_NUM_ROWS = 2  # Below the threshold: a blow itself can make one row "don't know".
_PLANT = "actual"


def evaluate_pushes(
    judged: Judged,
    num_motions: int,
    num_calibration: int,
    *,
    threshold: float,
    seed: int,
    calibration_seed: int,
) -> Findings:
    """Evaluates alarms on motions to accepted goals that are safe without a push.

    All motions are kept with the run, as other fresh sets are.

    Args:
        judged: The evaluated assessments.
        num_motions: Number of test motions, each undisturbed and pushed.
        num_calibration: Number of calibration motions.
        threshold: Lowest probability of an accepted goal.
        seed: Seed of the test motions.
        calibration_seed: Seed of the calibration motions.
    """
    from drake_safety.evaluation.metrics import proportion
    from drake_safety.evaluation.monitoring_study import begun
    from drake_safety.evaluation.scorers import assessment_scorer
    from drake_safety.simulation.pushed_motions import run_pushed_motions

    scenario = judged.scenario
    options = {**scenario.task_class().judging_options, "pushed": _PLANT}

    def run(what: str, count: int, own_seed: int) -> list[WatchedMotion]:
        return run_pushed_motions(
            scenario,
            count,
            seed=own_seed,
            variation=_PLANT,
            num_workers=judged.workers,
            path=fresh_episodes_folder(
                judged.run_folder, scenario.simulation_hash(_PLANT), own_seed, options
            ),
            progress=partial(judged.stages, what),
        )

    verdict = assessment_scorer("sharpened", judged.sharpened)
    test = run("pushes", num_motions, seed)
    calibration = run("calibration pushes", num_calibration, calibration_seed)
    accepted = begun(test, verdict, threshold)
    findings = Findings(
        estimates={"monitoring.motions.refused": proportion(len(test) - len(accepted), len(test))}
    )
    findings.add(evaluate_monitoring(judged, begun(calibration, verdict, threshold), accepted))
    return findings


def evaluate_monitoring(
    judged: Judged, calibration: Sequence[WatchedMotion], test: Sequence[WatchedMotion]
) -> Findings:
    """Evaluates all alarms on given motions.

    Args:
        judged: The evaluated assessments.
        calibration: Motions on which thresholds are chosen.
        test: Test motions.
    """
    from drake_safety.evaluation.alarms import scorer_alarm, threshold_alarms
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.monitoring_figure import monitoring_figure
    from drake_safety.evaluation.monitoring_study import evaluate_alarms
    from drake_safety.evaluation.scorers import assessment_scorer
    from drake_safety.simulation.capabilities import CanFall

    if all(motion.has_left for motion in calibration):
        # Thresholds need motions that stay safe.
        return Findings()
    loop = judged.scenario.make_loop()
    watched = loop.watched_features if isinstance(loop, CanFall) else {}
    alarms = [
        scorer_alarm(assessment_scorer("sharpened", judged.sharpened)),
        scorer_alarm(assessment_scorer("paper", judged.paper)),
        *(scorer_alarm(scorer) for scorer in judged.classifiers),
        *threshold_alarms(loop.state_names, loop.feature_names, watched),
    ]
    study = evaluate_alarms(alarms, calibration, test, num_rows=_NUM_ROWS)
    return Findings(
        estimates=study.estimates,
        pictures=save(monitoring_figure(study), judged.folder / "monitoring"),
    )
