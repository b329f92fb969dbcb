"""Evaluation of verdicts on plans with a goal by ``evaluate``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.cli.findings import Findings, Judged

if TYPE_CHECKING:
    from drake_safety.evaluation.plan_study import PlanRule, Plans, PlanStudy
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.capabilities import GoalWords
    from drake_safety.simulation.closed_loop import ClosedLoop

_DEFAULT_OTHER_HAND = 400


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Options of the command line.

    Attributes:
        other_hand: Number of targets mirrored to the other hand; None for the default.
        plane_x: Position of the plane of the reachable region [m]; None for that of the task.
        plane_step: Spacing of its simulated targets [m]; 0 to leave it out.
    """

    other_hand: int | None = None
    plane_x: float | None = None
    plane_step: float = 0.1


def check_options(loop: ClosedLoop, options: PlanOptions) -> None:
    """Checks options before the simulations.

    Args:
        loop: The nominal diagram of the task.
        options: The options.

    Raises:
        ValueError: The task does not support an option.
    """
    from drake_safety.evaluation.reachable_region import plane_of
    from drake_safety.simulation.capabilities import HasGoals, goal_words, require

    if not isinstance(loop, HasGoals):
        if options != PlanOptions():
            require(
                loop,
                HasGoals,
                "evaluate: leave out --other-hand, --plane-x and --plane-step",
            )
        return
    if options.other_hand and not loop.mirror_options:
        raise ValueError(f"evaluate: {loop.scenario.task} has no other hand: pass --other-hand 0")
    if options.plane_step and goal_words(loop).is_point:
        plane_of(loop, options.plane_x, options.plane_step)


def evaluate_plans(
    judged: Judged, options: PlanOptions, run_set: Callable[..., Episodes]
) -> Findings:
    """Evaluates Γ and baselines at k = 0 on fresh targets, for both hands.

    Args:
        judged: The evaluated assessments.
        options: The options.
        run_set: Simulates the episodes of the other hand, given the name of the stage, their number
            and options of the diagram.
    """
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.plan_study import evaluate_plans, plans_of
    from drake_safety.evaluation.reachable_region import reachable_region
    from drake_safety.evaluation.region_figure import region_figure
    from drake_safety.simulation.capabilities import (
        HasGoals,
        goal_words,
        require,
    )

    scenario, sharpened = judged.scenario, judged.sharpened
    loop = scenario.make_loop()
    words = goal_words(require(loop, HasGoals))
    mirror = loop.mirror_options
    test = plans_of(loop, judged.test_set)
    calibration = plans_of(loop, judged.calibration_set)
    sets = {"plans": test}
    num_other = options.other_hand
    if num_other is None:
        num_other = min(len(judged.test_set), _DEFAULT_OTHER_HAND)
    if mirror and num_other:
        # The same random draws, mirrored.
        episodes = run_set("fresh targets, other hand", num_other, **mirror)
        sets["plans.other_hand"] = plans_of(
            scenario.make_loop(**type(loop).judging_options, **mirror), episodes
        )
    rules = _rules(judged, loop, [plans.hand for plans in sets.values()])
    twins = [key for key in sets if key != "plans"]
    study = evaluate_plans(rules, sharpened, calibration, sets, twins)
    estimates = dict(study.estimates)
    pictures = _pictures(study, test, words, judged.folder)
    if options.plane_step and words.is_point:
        region = reachable_region(
            scenario,
            sharpened,
            threshold=1.0 - study.thresholds["sharpened"],
            x_m=options.plane_x,
            step_m=options.plane_step,
            num_workers=judged.workers,
            progress=judged.stages,
        )
        estimates |= {
            f"plans.plane.{key}": estimate for key, estimate in region.estimates().items()
        }
        picture = region_figure(region, test.constraint_names)
        pictures += save(picture, judged.folder / "reachable_region")
    return Findings(
        estimates=estimates,
        entries={"calibration_episodes": len(judged.calibration_set)},
        pictures=pictures,
    )


def _rules(judged: Judged, loop: ClosedLoop, hands: Sequence[str | None]) -> list[PlanRule]:
    from drake_safety.evaluation.plan_study import reachability_rule, scorer_rule
    from drake_safety.evaluation.reachability import BASELINES, Reachability
    from drake_safety.evaluation.scorers import assessment_scorer

    rules = [
        scorer_rule(assessment_scorer(mode, gamma), gamma.calibrations_.get("plan"))
        for mode, gamma in {"sharpened": judged.sharpened, "paper": judged.paper}.items()
    ]
    rules += [scorer_rule(scorer) for scorer in judged.classifiers]
    known = [hand for hand in hands if hand is not None]
    if known:
        for name, is_free in BASELINES.items():
            reach = {hand: Reachability(loop.robot, hand, is_base_free=is_free) for hand in known}
            rules.append(reachability_rule(reach, name))
    return rules


def _pictures(study: PlanStudy, test: Plans, words: GoalWords, folder: Path) -> list[Path]:
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.plans_figure import plans_figure
    from drake_safety.evaluation.roc_figure import roc_figure

    scores = study.unsafe_score["plans"]
    score = np.where(np.isnan(scores["sharpened"]), np.inf, scores["sharpened"])
    is_refused = score > study.thresholds["sharpened"]
    return [
        *save(plans_figure(test.goals, test.is_unsafe, is_refused, words), folder / "plans"),
        *save(
            roc_figure(
                {name: (score, test.is_unsafe) for name, score in scores.items()},
                thresholds=study.thresholds,
            ),
            folder / "plans_roc",
        ),
    ]
