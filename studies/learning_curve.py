"""``python -m studies learning-curve``: recalls of Γ over the number of training episodes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated

import typer

from drake_safety.cli.console import (
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
    console,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import (
    MODES,
    assessment_file,
    check_fresh,
    episodes_folder,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.plan_study import (
    Plans,
    plans_of,
    promised_miss_rate,
    scorer_rule,
    verdict_estimates,
)
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.evaluation.tables import Table, rows_of
from drake_safety.evaluation.verdict_tables import TARGETS
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.calibration import score_threshold
from drake_safety.learning.seeds import EVALUATION
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.worker_processes import parallel_map
from studies import command_line
from studies.learning_curve_figure import learning_curve_figure

CURVE_FILE = "learning_curve.json"


def train_fewer(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    sizes: Annotated[str, typer.Option(help="Numbers of training episodes, such as '512,1024'.")],
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other ones, for thresholds.", min=20)
    ] = 300,
    seed: Annotated[
        int, typer.Option(help="First seed of the fresh ones: those of `evaluate` by default.")
    ] = EVALUATION.first,
    workers: WorkersOption = None,
) -> None:
    """Train Γ of plans with a goal on fewer episodes, and evaluate it on the same fresh ones.

    Writes ASSESSMENT/learning_curve.json, which `store` includes, and its figure.
    """
    wanted = parse_sizes(sizes)
    loaded = load_scenario(scenario)
    loop = loaded.make_loop()
    require(loop, HasGoals, "learning curve")
    sharpened = load_assessment(assessment, MODES[0])
    info = load_episodes(episodes_folder(assessment)).info
    seeds = EVALUATION.seeds(seed)
    check_fresh(sharpened, loaded, (seeds["evaluation"], seeds["thresholds"]))
    check_sizes(len(completed(episodes_folder(assessment))), wanted)
    with open_stages() as stages:
        test, calibration = (
            plans_of(
                loop,
                run_fresh_episodes(
                    loaded, assessment, count, own_seed, partial(stages, what), workers
                ),
            )
            for what, count, own_seed in (
                ("fresh nominal episodes", episodes, seeds["evaluation"]),
                ("calibration episodes", calibration_episodes, seeds["thresholds"]),
            )
        )
        curve = learning_curve(
            episodes_folder(assessment),
            wanted,
            sharpened.parameters,
            calibration,
            test,
            known={len(completed(episodes_folder(assessment))): sharpened},
            num_workers=workers,
            progress=stages,
        )
    estimates = {f"plans.learning_curve.{key}": estimate for key, estimate in curve.items()}
    entries = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": info.scenario_hash,
        "seed": seed,
        "assessment_sha256": {mode: file_hash(assessment_file(assessment, mode)) for mode in MODES},
        "versions": versions(),
    }
    results = Results(estimates, entries)
    file = assessment / CURVE_FILE
    results.write(file)
    prefixes = {f"plans.learning_curve.{size}": f"{size}" for size in sorted(set(wanted))}
    prefixes |= {f"{key}.fair": f"{name}, fair targets" for key, name in list(prefixes.items())}
    table = Table(
        title="Learning curve",
        meaning="The same test after training on fewer episodes.",
        corner="training episodes",
        columns=TARGETS,
        rows=rows_of(results, prefixes, TARGETS),
    )
    console.print(table.to_rich())
    print_path("figures", file)
    for path in save(learning_curve_figure(curve), assessment / "learning_curve"):
        print_path("picture", path)


def parse_sizes(text: str) -> tuple[int, ...]:
    """The numbers of episodes in '512,1024'.

    Raises:
        ValueError: The text is no list of integers.
    """
    try:
        return tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise ValueError(
            f"--sizes '{text}': give numbers of episodes, such as 512,1024,2048"
        ) from None


def check_sizes(num_episodes: int, sizes: Sequence[int]) -> None:
    """Checks sizes of training sets.

    Args:
        num_episodes: Number of training episodes.
        sizes: Sizes of the training sets.

    Raises:
        ValueError: A size is not positive, or exceeds the number of episodes.
    """
    misfits = [size for size in sizes if not 1 <= size <= num_episodes]
    if misfits:
        raise ValueError(
            f"learning curve: there are {num_episodes} training episodes; got sizes {misfits}"
        )


def learning_curve(
    path: str | os.PathLike[str],
    sizes: Sequence[int],
    parameters: AssessmentParameters,
    calibration: Plans,
    test: Plans,
    *,
    known: Mapping[int, SafetyAssessment] | None = None,
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> dict[str, Estimate]:
    """Trains on the first n episodes, for several n, and evaluates on the same plans.

    Args:
        path: Folder of the training episodes.
        sizes: The n.
        parameters: Parameters of Γ.
        calibration: Plans on which thresholds are chosen.
        test: Fresh plans.
        known: Assessments that are already trained, by n.
        num_workers: Number of worker processes.
        progress: Called with a stage, the number done and the number wanted.

    Returns:
        "N.auc", "N.safe_recall", "N.unsafe_recall", "N.brier" and "N.threshold" (Γ_thre), and the
        same as "N.fair.…" for the fair set.

    Raises:
        ValueError: A size is not positive, or exceeds the number of episodes.
    """
    check_sizes(len(completed(path)), sizes)
    learned, wanted = dict(known or {}), sorted(set(sizes))
    missing = [size for size in wanted if size not in learned]
    done = len(wanted) - len(missing)
    if progress is not None:
        progress("learning curve", done, len(wanted))
    # The largest first, so that no worker is left with it at the end.
    arguments = [(os.fspath(path), size, parameters) for size in reversed(missing)]
    for size, assessment in parallel_map(_learn, arguments, num_workers):
        learned[size] = assessment
        done += 1
        if progress is not None:
            progress("learning curve", done, len(wanted))
    estimates: dict[str, Estimate] = {}
    miss_rate = promised_miss_rate(calibration)
    for size in wanted:
        rule = scorer_rule(assessment_scorer("sharpened", learned[size]))
        threshold = score_threshold(
            rule.unsafe_score(calibration), calibration.is_unsafe, miss_rate
        )
        score = rule.unsafe_score(test)
        for key, plans, chosen in (
            (f"{size}", test, score),
            (f"{size}.fair", test.fair(), score[test.is_fair]),
        ):
            found = verdict_estimates(plans, chosen, threshold)
            limit = 1.0 - threshold
            found["threshold"] = Estimate.exact(limit, len(calibration))
            estimates |= {f"{key}.{what}": estimate for what, estimate in found.items()}
    return estimates


def _learn(path: str, size: int, parameters: AssessmentParameters) -> tuple[int, SafetyAssessment]:
    return size, SafetyAssessment(parameters).fit(load_episodes(path)[:size])
