"""What ``evaluate`` does for tasks whose plans have a goal: verdicts before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from drake_safety.cli.console import interval, new_table
from drake_safety.cli.findings import Findings, Judged
from drake_safety.cli.training_folder import episodes_folder

if TYPE_CHECKING:
    from drake_safety.evaluation.metrics import Figure
    from drake_safety.evaluation.plan_study import PlanRule, Plans, PlanStudy
    from drake_safety.evaluation.reachable_region import ReachableRegion
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.closed_loop import ClosedLoop

_DEFAULT_OTHER_HAND = 400
_SETS = {
    "plans": "all targets",
    "plans.fair": "the fair set",
    "plans.other_hand": "the other hand, all targets",
    "plans.other_hand.fair": "the other hand, the fair set",
}
_COLUMNS = {
    "safe_recall": "safe recall",
    "unsafe_recall": "unsafe recall",
    "auc": "AUC",
    "brier": "Brier",
}


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """What the command line may ask for beyond verdicts on fresh targets.

    Attributes:
        other_hand: Number of targets that are mirrored to the other hand; None for the default.
        learning_curve: Numbers of training episodes.
        plane_x: Where the plane of the reachable region is [m]; None for the task's own.
        plane_step: Between two of its simulated targets [m]; 0 leaves it out.
    """

    other_hand: int | None = None
    learning_curve: Sequence[int] = ()
    plane_x: float | None = None
    plane_step: float = 0.1


def parse_sizes(text: str) -> tuple[int, ...]:
    """The numbers of episodes in '512,1024'.

    Raises:
        ValueError: Something else stands there.
    """
    try:
        return tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise ValueError(
            f"--learning-curve '{text}': give numbers of episodes, such as 512,1024,2048"
        ) from None


def check_options(loop: ClosedLoop, options: PlanOptions, num_training: int) -> None:
    """Refuses what cannot be, before anything is simulated for it.

    Args:
        loop: The task's nominal diagram.
        options: What is asked for.
        num_training: Number of training episodes.

    Raises:
        ValueError: It cannot be.
    """
    from drake_safety.evaluation.learning_curve import check_sizes
    from drake_safety.evaluation.reachable_region import plane_of
    from drake_safety.simulation.capabilities import HasGoals, require

    if not isinstance(loop, HasGoals):
        if options != PlanOptions():
            require(
                loop,
                HasGoals,
                "evaluate: leave out --other-hand, --learning-curve, --plane-x and --plane-step",
            )
        return
    if options.other_hand and not _mirror_options(loop):
        raise ValueError(f"evaluate: {loop.scenario.task} has no other hand: pass --other-hand 0")
    check_sizes(num_training, options.learning_curve)
    if options.plane_step:
        plane_of(loop, options.plane_x, options.plane_step)


def _mirror_options(loop: ClosedLoop) -> dict[str, Any]:
    from drake_safety.simulation.capabilities import HasMirrorImage

    return loop.mirror_options if isinstance(loop, HasMirrorImage) else {}


def evaluate_plans(
    judged: Judged, options: PlanOptions, run_set: Callable[..., Episodes]
) -> Findings:
    """Judges Γ and its rivals at k = 0 on fresh targets, for either hand.

    Args:
        judged: What is judged.
        options: What is asked for.
        run_set: Simulates the episodes of the other hand: takes what they are, their number and
            options of the task's diagram.
    """
    from drake_safety.evaluation.learning_curve import learning_curve
    from drake_safety.evaluation.plan_study import evaluate_plans, plans_of
    from drake_safety.evaluation.reachable_region import reachable_region
    from drake_safety.simulation.capabilities import judging_options

    scenario, sharpened = judged.scenario, judged.sharpened
    loop = scenario.make_loop()
    mirror = _mirror_options(loop)
    test = plans_of(loop, judged.test_set)
    calibration = plans_of(loop, judged.calibration_set)
    sets = {"plans": test}
    num_other = options.other_hand
    if num_other is None:
        num_other = min(len(judged.test_set), _DEFAULT_OTHER_HAND)
    if mirror and num_other:
        # The same draws: what this hand is asked for is the mirror image of what that one was.
        episodes = run_set("fresh targets, other hand", num_other, **mirror)
        sets["plans.other_hand"] = plans_of(
            scenario.make_loop(**judging_options(type(loop)), **mirror), episodes
        )
    rules = _rules(judged, loop, [plans.hand for plans in sets.values()])
    twins = [key for key in sets if key != "plans"]
    study = evaluate_plans(rules, sharpened, calibration, sets, twins)
    figures = dict(study.figures)
    pictures = _pictures(study, test, judged.folder)
    if options.plane_step:
        region = reachable_region(
            scenario,
            sharpened,
            threshold=1.0 - study.thresholds["sharpened"],
            x_m=options.plane_x,
            step_m=options.plane_step,
            num_workers=judged.workers,
            progress=judged.stages,
        )
        figures |= {f"plans.plane.{key}": figure for key, figure in region.figures().items()}
        pictures += _region_picture(region, test.constraint_names, judged.folder)
    curve = {}
    if options.learning_curve:
        curve = learning_curve(
            episodes_folder(judged.run_folder),
            options.learning_curve,
            sharpened.parameters,
            calibration,
            test,
            known={len(judged.train_set): sharpened},
            num_workers=judged.workers,
            progress=judged.stages,
        )
        figures |= {f"plans.learning_curve.{key}": figure for key, figure in curve.items()}
        pictures += _curve_picture(curve, judged.folder)
    keys = {
        key: title
        for key, title in _SETS.items()
        if f"{key}.outcomes.safe" in figures and figures[f"{key}.outcomes.safe"].n
    }
    tables = [_verdict_table(figures, key, [rule.name for rule in rules]) for key in keys]
    tables += [_loss_table(figures, key, [rule.name for rule in rules]) for key in twins]
    tables.append(_outcome_table(figures, keys, test.constraint_names))
    tables.append(_cause_table(figures, keys, test.constraint_names))
    if curve:
        tables.append(_curve_table(curve, sorted(set(options.learning_curve))))
    return Findings(
        figures=figures,
        entries={"calibration_episodes": len(judged.calibration_set)},
        pictures=pictures,
        tables=tables,
    )


def _rules(judged: Judged, loop: ClosedLoop, hands: Sequence[str | None]) -> list[PlanRule]:
    from drake_safety.evaluation.plan_study import reachability_rule, scorer_rule
    from drake_safety.evaluation.reachability import Reachability
    from drake_safety.evaluation.scorers import assessment_scorer

    rules = [
        scorer_rule(assessment_scorer(mode, gamma, "calibrated"), gamma.calibrations_.get("plan"))
        for mode, gamma in {"sharpened": judged.sharpened, "paper": judged.paper}.items()
    ]
    rules += [
        *(scorer_rule(scorer) for scorer in judged.classifiers),
    ]
    known = [hand for hand in hands if hand is not None]
    if known:
        rules.append(reachability_rule({hand: Reachability(loop.robot, hand) for hand in known}))
    return rules


def _pictures(study: PlanStudy, test: Plans, folder: Path) -> list[Path]:
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.plans_figure import plans_figure
    from drake_safety.evaluation.roc_figure import roc_figure

    scores = study.unsafe_score["plans"]
    score = np.where(np.isnan(scores["sharpened"]), np.inf, scores["sharpened"])
    is_refused = score > study.thresholds["sharpened"]
    return [
        *save(plans_figure(test.goals, test.is_unsafe, is_refused), folder / "plans"),
        *save(
            roc_figure(
                {name: (score, test.is_unsafe) for name, score in scores.items()},
                thresholds=study.thresholds,
            ),
            folder / "plans_roc",
        ),
    ]


def _region_picture(
    region: ReachableRegion, constraint_names: list[str], folder: Path
) -> list[Path]:
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.region_figure import region_figure

    return save(region_figure(region, constraint_names), folder / "reachable_region")


def _curve_picture(curve: dict[str, Figure], folder: Path) -> list[Path]:
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.learning_curve_figure import learning_curve_figure

    return save(learning_curve_figure(curve), folder / "learning_curve")


def _verdict_table(figures: dict[str, Figure], key: str, names: list[str]) -> Table:
    n = figures[f"{key}.outcomes.safe"].n
    title = f"{n} fresh targets judged at k = 0: {_SETS[key]}"
    table = new_table("scorer", *_COLUMNS.values(), "Γ_thre", title=title)
    for name in names:
        prefix = f"{key}.{name}."
        table.add_row(
            name,
            *(interval(figures[prefix + what]) for what in _COLUMNS),
            f"{figures[f'{prefix}threshold'].value:.3f}",
        )
    return table


def _loss_table(figures: dict[str, Figure], key: str, names: list[str]) -> Table:
    columns = {"safe_recall_loss": "safe recall", "unsafe_recall_loss": "unsafe recall"}
    n = figures[f"{key}.{names[0]}.safe_recall_loss"].n
    title = f"Lost on the same {n} targets mirrored, {_SETS[key]} [points]"
    table = new_table("scorer", *columns.values(), title=title)
    for name in names:
        found = [figures[f"{key}.{name}.{what}"] for what in columns]
        table.add_row(name, *(interval(figure, 100, 1) for figure in found))
    return table


def _outcome_table(
    figures: dict[str, Figure], keys: Mapping[str, str], constraints: Sequence[str]
) -> Table:
    outcomes = ["safe", *constraints, "diverged"]
    columns = [name.replace("_", " ") for name in outcomes]
    title = "What came of them [%]"
    table = new_table("set", "targets", *columns, "controller failures", title=title)
    for key, name in keys.items():
        shares = [figures[f"{key}.outcomes.{outcome}"] for outcome in outcomes]
        failed = figures[f"{key}.episodes_with_controller_failures"]
        table.add_row(
            name,
            f"{shares[0].n}",
            *(f"{100 * share.value:.1f}" for share in shares),
            f"{figures[f'{key}.controller_failures'].value:.0f} in "
            f"{round(failed.value * failed.n) if failed.n else 0} episodes",
        )
    return table


def _cause_table(
    figures: dict[str, Figure], keys: Mapping[str, str], constraints: Sequence[str]
) -> Table:
    """Of the correctly refused, all of them and by their cause."""
    seen = [name for name in constraints if any(f"{key}.causes.{name}" in figures for key in keys)]
    columns = [name.replace("_", " ") for name in seen]
    columns.append("all, by mass alone")
    title = "Right cause of the correctly refused [%]"
    table = new_table("set", "refused", "all", *columns, title=title)
    for key, name in keys.items():
        wanted = ("right_cause", *seen, "by_cause_probability")
        found = [figures.get(f"{key}.causes.{cause}") for cause in wanted]
        table.add_row(
            name,
            f"{figures[f'{key}.causes.right_cause'].n}",
            *("-" if figure is None else interval(figure, 100, 1) for figure in found),
        )
    return table


def _curve_table(curve: dict[str, Figure], sizes: Sequence[int]) -> Table:
    columns = {
        "safe_recall": "safe recall",
        "unsafe_recall": "unsafe recall",
        "auc": "AUC",
        "fair.safe_recall": "fair set: safe recall",
        "fair.unsafe_recall": "unsafe recall",
    }
    table = new_table("training episodes", *columns.values(), title="Learning curve")
    for size in sizes:
        table.add_row(f"{size}", *(interval(curve[f"{size}.{what}"]) for what in columns))
    return table
