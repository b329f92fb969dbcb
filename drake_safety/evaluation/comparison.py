"""Comparison of scenarios: recalls of Γ at k = 0, and falls with and without recovery."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from drake_safety.evaluation.episode_study import evaluate_episodes
from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.evaluation.tables import Column, Row, Table
from drake_safety.evaluation.throw_study import TriggerRule, evaluate_throws
from drake_safety.files.atomic import replacing
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import EVALUATION
from drake_safety.models import load_robot
from drake_safety.simulation.capabilities import HasBall
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario

_ESTIMATES = {
    "share_unsafe": "episodes.share_unsafe",
    "auc": "episodes.sharpened.auc",
    "safe_recall": "episodes.sharpened.safe_recall",
    "unsafe_recall": "episodes.sharpened.unsafe_recall",
    "falls_without_recovery": "throws.falls_without_recovery",
    "falls_with_recovery": "throws.sharpened.falls_with_recovery",
    "false_triggers": "throws.sharpened.false_triggers",
    "recoveries_with_legs_collide": "throws.sharpened.recoveries_with_legs_collide",
    "recoveries_with_joint_velocity": "throws.sharpened.recoveries_with_joint_velocity",
}
"""Columns and the keys of their estimates. Recalls and AUC are those of episodes at k = 0."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Numbers of simulations of a row.

    Attributes:
        num_episodes: Training episodes.
        num_fresh: Test episodes; half as many others are for thresholds.
        num_throws: Throws, for robots that can recover.
        seed: Seed.
    """

    num_episodes: int
    num_fresh: int
    num_throws: int
    seed: int


def compare_scenario(
    scenario: Scenario,
    folder: Path,
    effort: Effort,
    *,
    num_workers: int | None = None,
    progress: StageProgress | bool | None = None,
) -> dict[str, Any]:
    """Trains and evaluates Γ of a scenario, and reuses what the folder already holds.

    The row of a task without recovery has no throws. Plans are evaluated without disturbances, as
    in ``evaluate``.

    Args:
        scenario: A scenario.
        folder: Folder of its episodes, its assessment and its row.
        effort: Numbers of simulations.
        num_workers: Number of worker processes.
        progress: Called with a stage, the number done and the number wanted; True shows it.

    Returns:
        The row: names and numbers, and for each estimate its value, interval and n.

    Raises:
        ValueError: The folder holds episodes of another scenario.
    """
    has_ball = isinstance(scenario.make_loop(), HasBall)
    recovery = scenario.parameters.recovery if has_ball else None
    made_by = {
        "scenario": scenario.to_yaml(),
        "simulation_hash": scenario.simulation_hash(),
        "actual_hash": scenario.simulation_hash("actual"),
        **vars(effort),
    }
    file = folder / "row.json"
    if file.is_file():
        stored = json.loads(file.read_text(encoding="utf-8"))
        if stored["made_by"] == made_by:
            return stored["row"]
    run = partial(run_episodes, scenario, num_workers=num_workers)
    seed, robot = effort.seed, scenario.robot
    seeds = EVALUATION.seeds(EVALUATION.first + seed)
    judging = scenario.task_class().judging_options
    with shown(progress, lambda stages: stages) as given:
        report = given or (lambda stage, done, total: None)
        training = run(
            effort.num_episodes,
            seed=seed,
            path=folder / "episodes",
            progress=partial(report, f"{scenario.name}: training"),
        )
        fresh, calibration = (
            run(
                number,
                seed=seeds[purpose],
                path=folder / name,
                progress=partial(report, f"{scenario.name}: {name}"),
                **judging,
            )
            for name, number, purpose in (
                ("fresh", effort.num_fresh, "evaluation"),
                ("calibration", max(effort.num_fresh // 2, 20), "thresholds"),
            )
        )
        assessment = SafetyAssessment(scenario.assessment).fit(
            training,
            lambda stage, done, total: report(f"{scenario.name}: {stage}", done, total),
        )
        assessment.save(folder / "sharpened.safetensors")
        scorer = assessment_scorer("sharpened", assessment)
        estimates, _, _ = evaluate_episodes([scorer], calibration, fresh)
        if recovery is not None:
            study = evaluate_throws(
                scenario,
                [TriggerRule(name="sharpened", scorer=scorer, threshold=recovery.threshold)],
                persistence_s=recovery.persistence_s,
                num_throws=effort.num_throws,
                num_calibration=0,
                seed=seeds["disturbances"],
                calibration_seed=seeds["disturbance thresholds"],
                num_workers=num_workers,
                progress=lambda stage, done, total: report(
                    f"{scenario.name}: {stage}", done, total
                ),
            )
            estimates |= study.estimates
    row = {
        "scenario": scenario.name,
        # A user's scenario may name its robot by the path of its file.
        "robot": load_robot(robot).name if Path(robot).suffix else robot,
        "episodes": effort.num_episodes,
        "throws": effort.num_throws if recovery is not None else 0,
        **{name: estimates[key].to_json() for name, key in _ESTIMATES.items() if key in estimates},
    }
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"made_by": made_by, "row": row}, indent=2)
    part = file.with_suffix(".part")
    with replacing(part) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    part.replace(file)
    return row


def row_estimate(row: Mapping[str, Any], name: str) -> Estimate | None:
    """An estimate of a row; None if the row has none."""
    stored = row.get(name)
    if not isinstance(stored, dict) or stored["value"] is None:
        return None
    return Estimate.from_json(stored)


def comparison_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows as a table, shares in percent."""
    nothing = Estimate.exact(math.nan, 0)
    counts = [Column(name, name, "n") for name in ("episodes", "throws")]
    columns = [
        Column(name, spoken(name)) if name == "auc" else Column(name, spoken(name), "%", digits=1)
        for name in _ESTIMATES
    ]
    return Table(
        corner="scenario",
        columns=[*counts, *columns],
        rows=[
            Row(
                key=row["scenario"],
                label=f"{row['scenario']} ({row['robot']})",
                estimates=[
                    *(Estimate(row[one.key], math.nan, math.nan, row[one.key]) for one in counts),
                    *(row_estimate(row, one.key) or nothing for one in columns),
                ],
            )
            for row in rows
        ],
    )
