"""Shipping of trained assessments with their evaluation.

A shipped folder holds the files of a run and `evaluation.json`: results, commands, seeds and
versions of the evaluation, the SHA-256 of every evaluated file, and the verdicts on the first fresh
episodes of its seed, which can be simulated again for comparison; and the card, `README.md`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.calibration import PLAN
from drake_safety.learning.segments import split
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario
from studies.cards import write_card
from studies.stored_results import EVALUATION_FILE, store_results

NUM_EPISODES = 6
"""Number of fresh episodes whose verdicts are stored."""
_HASHES, _VERDICTS = "assessment_sha256", "first_episodes"
_TOLERANCE = 1e-3  # Of Γ; above differences between processors, below those of assessments.


def ship(
    results: Results,
    files: Mapping[str, Path],
    into: Path,
    scenario: Scenario,
    *,
    train_command: str,
    num_workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Copies trained assessments into a folder, with their evaluation and their card.

    Args:
        results: Results of the evaluation.
        files: Files of the assessments by mode.
        into: Parent of the folder, which is named after the scenario.
        scenario: The scenario.
        train_command: Command of the training.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number of episodes done and the number wanted.

    Returns:
        The folder, whose previous contents are deleted.

    Raises:
        ValueError: A file is missing, differs from the evaluated one, is not calibrated, or the
            scenario has changed since. Nothing is written then.
    """
    assessments = {}
    for mode, file in files.items():
        if not file.is_file():
            raise ValueError(f"ship: there is no '{mode}' assessment at {file}: train both modes")
        assessments[mode] = SafetyAssessment.load(file)
        if PLAN not in assessments[mode].calibrations_:
            raise ValueError(
                f"ship: {file} holds no calibrated threshold: `drake-safety calibrate` chooses one;"
                " evaluate after that"
            )
    hashes = {mode: file_hash(file) for mode, file in files.items()}
    judged = results.entries.get(_HASHES)
    if judged != hashes:
        raise ValueError(
            f"ship: the evaluation judged assessments with the SHA-256 {judged}, the files have "
            f"{hashes}: `drake-safety evaluate` them as they are now"
        )
    _check_simulation(results, assessments, scenario)
    stored = {
        "calibrations": {
            mode: [one.to_json() for one in assessment.calibrations_.values()]
            for mode, assessment in assessments.items()
        },
        _VERDICTS: first_verdicts(
            scenario,
            assessments,
            seed=int(results.entries["seed"]),
            num_workers=num_workers,
            progress=progress,
        ),
    }
    folder = into / scenario.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in files.values():
        shutil.copyfile(file, folder / file.name)
    store_results(
        Results(results, results.entries | stored),
        folder / EVALUATION_FILE,
        train_command=train_command,
    )
    write_card(folder, scenario)
    return folder


def check_shipped(folder: Path, scenario: Scenario, *, num_workers: int | None = None) -> Results:
    """Checks that shipped assessments match their stored evaluation.

    Simulates the first fresh episodes of the evaluation again.

    Args:
        folder: Folder written by `ship`.
        scenario: The scenario.
        num_workers: Number of worker processes; one a core by default.

    Returns:
        Results of the evaluation.

    Raises:
        ValueError: A file or the scenario has changed, or outcomes or verdicts of the first
            episodes differ from the stored ones.
    """
    results = Results.read(folder / EVALUATION_FILE)
    stored = results.entries
    missing = [key for key in (_HASHES, _VERDICTS, "seed", "scenario_hash") if key not in stored]
    if missing:
        raise ValueError(f"{folder / EVALUATION_FILE} is of no shipped assessment: no {missing}")
    files = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    hashes = {mode: file_hash(file) for mode, file in files.items()}
    if hashes != stored[_HASHES]:
        raise ValueError(
            f"{folder}: the files have the SHA-256 {hashes}, what was evaluated had "
            f"{stored[_HASHES]}"
        )
    assessments = {mode: SafetyAssessment.load(file) for mode, file in files.items()}
    _check_simulation(results, assessments, scenario)
    again = first_verdicts(
        scenario,
        assessments,
        seed=int(stored["seed"]),
        num_episodes=len(stored[_VERDICTS]),
        num_workers=num_workers,
    )
    for before, now in zip(stored[_VERDICTS], again, strict=True):
        if not _agree(before, now):
            raise ValueError(
                f"{folder}: fresh episode {now['episode']} of seed {stored['seed']} was "
                f"{before}, and is now {now}"
            )
    return results


def first_verdicts(
    scenario: Scenario,
    assessments: Mapping[str, SafetyAssessment],
    *,
    seed: int,
    num_episodes: int = NUM_EPISODES,
    num_workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Simulates the first fresh episodes of a seed, with their verdicts at k = 0.

    Args:
        scenario: The scenario.
        assessments: Calibrated assessments, by mode.
        seed: Seed of the episodes.
        num_episodes: Number of episodes.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number done and the number wanted.

    Returns:
        An entry for each episode: "episode", its index; "cause" of its end, "" if it stayed safe;
        and by mode "verdict" and "safety_probability" at k = 0. Diverged episodes
        have no modes.
    """
    episodes = run_episodes(
        scenario,
        num_episodes,
        seed=seed,
        num_workers=num_workers,
        progress=progress,
        **scenario.task_class().judging_options,
    )
    entries: list[dict[str, Any]] = [
        {"episode": episode.index, "cause": episode.cause} for episode in episodes
    ]
    segments = split(episodes, stride=1, discount=1.0, shortest=1)
    first = segments.take(np.flatnonzero(segments.is_first))
    for mode, assessment in assessments.items():
        scorer = assessment_scorer(mode, assessment)
        gamma = 1.0 - scorer.unsafe_score(first)
        verdicts = assessment.calibrations_[PLAN].verdicts(gamma)
        for position, verdict, value in zip(first.episode, verdicts, gamma, strict=True):
            entries[position][mode] = {
                "verdict": str(verdict),
                "safety_probability": round(float(value), 6),
            }
    return entries


def _check_simulation(
    results: Results, assessments: Mapping[str, SafetyAssessment], scenario: Scenario
) -> None:
    now = scenario.simulation_hash()
    hashes = {mode: one.info_.scenario_hash for mode, one in assessments.items()}
    hashes["evaluation"] = str(results.entries.get("scenario_hash"))
    for what, hash_ in hashes.items():
        if hash_ != now:
            raise ValueError(
                f"scenario '{scenario.name}' has the hash {now[:12]}, '{what}' is of "
                f"{hash_[:12]}: train, calibrate and evaluate again"
            )


def _agree(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    if before.keys() != now.keys():
        return False
    for key, value in now.items():
        if not isinstance(value, Mapping):
            if before[key] != value:
                return False
        elif before[key]["verdict"] != value["verdict"]:
            return False
        elif abs(before[key]["safety_probability"] - value["safety_probability"]) > _TOLERANCE:
            return False
    return True
