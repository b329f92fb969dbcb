"""What ``evaluate`` does with pushed motions: Γ as an alarm, beside what one watches instead."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from drake_safety.cli.findings import Findings, Judged
from drake_safety.cli.training_folder import fresh_episodes_folder

if TYPE_CHECKING:
    from drake_safety.simulation.watched_motion import WatchedMotion

_PLANT = "actual"  # Which is pushed.


def evaluate_pushes(
    judged: Judged,
    num_motions: int,
    num_calibration: int,
    *,
    threshold: float,
    seed: int,
    calibration_seed: int,
) -> Findings:
    """Pushes a robot on its way to goals that it accepts, and reaches safely by itself.

    The motions are kept with the run, as other fresh sets are; those to goals that Γ refuses, too.

    Args:
        judged: What is judged.
        num_motions: Fresh motions, each undisturbed and pushed.
        num_calibration: Other motions, for thresholds.
        threshold: From which the calibrated Γ accepts a goal.
        seed: Of the motions.
        calibration_seed: Of the others.
    """
    from drake_safety.evaluation.metrics import proportion
    from drake_safety.evaluation.monitoring_study import begun
    from drake_safety.evaluation.scorers import assessment_scorer
    from drake_safety.simulation.capabilities import judging_options
    from drake_safety.simulation.pushed_motions import run_pushed_motions

    scenario = judged.scenario
    options = {**judging_options(scenario.task_class()), "pushed": _PLANT}

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

    verdict = assessment_scorer("sharpened", judged.sharpened, "calibrated")
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
    from drake_safety.simulation.capabilities import HasWatchedFeatures

    if all(motion.has_left for motion in calibration):
        # Nobody could be allowed the same share of false alarms: thresholds need calm motions.
        return Findings()
    loop = judged.scenario.make_loop()
    watched = loop.watched_features if isinstance(loop, HasWatchedFeatures) else {}
    alarms = [
        *assessment_alarms("sharpened", judged.sharpened),
        *assessment_alarms("paper", judged.paper),
        *(scorer_alarm(scorer) for scorer in judged.classifiers),
        *threshold_alarms(loop.state_names, loop.feature_names, watched),
    ]
    study = evaluate_alarms(alarms, calibration, test)
    return Findings(
        estimates=study.estimates,
        pictures=save(monitoring_figure(study), judged.folder / "monitoring"),
    )
