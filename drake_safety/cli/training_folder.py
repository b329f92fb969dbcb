"""The folder written by ``train``, with episodes and an assessment for each mode."""

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from drake_safety.assessments import assessed_scenarios, shipped_folder
from drake_safety.cli import console
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.worker_processes import Progress

MODES = ("sharpened", "paper")
"""Modes, the default first."""


class AssessmentFolder(NamedTuple):
    """The folder of assessments, and that of results: another one if they are shipped."""

    path: Path
    out: Path


def episodes_folder(folder: Path, mode: str = MODES[0]) -> Path:
    """Folder of the training episodes of a mode: the paper's may have its own."""
    own = folder / f"episodes_{mode}"
    return own if own.is_dir() else folder / "episodes"


def family_folder(folder: Path) -> Path:
    """Folder of the training episodes on the plants of a family."""
    return folder / "episodes_family"


def training_episodes(folder: Path, gamma: SafetyAssessment) -> Episodes:
    """Loads the nominal episodes that Γ has learned from, and the episodes of its family."""
    nominal = load_episodes(episodes_folder(folder, gamma.parameters.mode))
    return nominal.joined(load_episodes(family_folder(folder))) if gamma.knows_family else nominal


def fresh_episodes_folder(
    folder: Path, scenario_hash: str, seed: int, loop_options: dict[str, Any]
) -> Path:
    """Folder of fresh episodes, by the hash and the options of their diagram."""
    options = [f"{name}-{value}" for name, value in sorted(loop_options.items())]
    return folder / "fresh" / "-".join([scenario_hash[:12], f"{seed}", *options])


def run_fresh_episodes(
    scenario: Scenario,
    folder: Path,
    num_episodes: int,
    seed: int,
    progress: Progress | None = None,
    num_workers: int | None = None,
    variation: str = "nominal",
    **loop_options: Any,
) -> Episodes:
    """Simulates fresh episodes in a training's folder, and reuses existing episodes."""
    options: dict[str, Any] = {**scenario.options_for("evaluation"), **loop_options}
    kept = fresh_episodes_folder(folder, scenario.simulation_hash(variation), seed, options)
    options |= {"variation": variation, "seed": seed, "num_workers": num_workers}
    return run_episodes(scenario, num_episodes, path=kept, progress=progress, **options)


def feedback_options(
    scenario: Scenario, folder: Path, variation: str, seed: int, num_workers: int | None
) -> dict[str, Any]:
    """Options of simulations of an actual plant that a training's folder keeps."""
    hash_ = scenario.simulation_hash(variation)
    return scenario.options_for("pairs", variation) | {
        "variation": variation,
        "num_workers": num_workers,
        "path": folder / "feedback" / f"{hash_[:12]}-{seed}",
        "extra": {"command": console.command_line()},
    }


def assessment_file(folder: Path, mode: str) -> Path:
    """File of the assessment of a mode."""
    return folder / f"{mode}.safetensors"


def open_assessment(
    scenario: str, given: Path | None, mode: str = MODES[0]
) -> tuple[Scenario, AssessmentFolder, SafetyAssessment]:
    """Loads a scenario, and the assessment of a mode from the given or the shipped folder."""
    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, given)
    assessment = load_assessment(folder.path, mode)
    check_fresh(assessment, loaded)
    console.say(assessment.detector_.describe())
    return loaded, folder, assessment


def assessment_folder(scenario: Scenario, given: Path | None) -> AssessmentFolder:
    """The given folder, or by default that of the shipped assessments of what is simulated."""
    if given is not None:
        return AssessmentFolder(given, given)
    names = assessed_scenarios()
    # Its own name first: reading an assessment takes half a second.
    for name in sorted(names, key=lambda one: one != scenario.name):
        shipped = shipped_folder(name)
        if scenario.adopt(load_assessment(shipped, MODES[0]).info_):
            break
    else:
        raise ValueError(
            f"the package has no assessment of what '{scenario.name}' simulates, only of {names}: "
            "pass --assessment with a folder of `drake-safety train`"
        )
    console.say("assessment        comes with the package,", shipped)
    # A separate folder, so that no training is overwritten.
    return AssessmentFolder(shipped, Path("runs") / f"{scenario.name}-shipped")


def load_assessment(folder: Path, mode: str) -> SafetyAssessment:
    """Loads the assessment of a mode, if the folder holds it."""
    path = assessment_file(folder, mode)
    if not path.is_file():
        there = sorted(file.stem for file in folder.glob("*.safetensors"))
        raise ValueError(
            f"folder '{folder}' holds no '{mode}' assessment; it holds {there}: run "
            "`drake-safety train` first"
        )
    return SafetyAssessment.load(path)


def load_assessments(folder: Path) -> dict[str, SafetyAssessment]:
    """Loads the assessments of a folder by mode; that of `paper` may be missing."""
    wanted = [mode for mode in MODES if mode == MODES[0] or assessment_file(folder, mode).is_file()]
    return {mode: load_assessment(folder, mode) for mode in wanted}


def check_fresh(
    assessment: SafetyAssessment, scenario: Scenario, seeds: Iterable[int] = ()
) -> None:
    """Checks that the scenario is that of the training, and that no seed has been used."""
    trained = assessment.info_
    if not scenario.adopt(trained):
        own = scenario.simulation_hash()
        raise ValueError(
            f"the assessment is of scenario '{trained.scenario}' with hash "
            f"{trained.scenario_hash[:12]}; '{scenario.name}' has {own[:12]}"
        )
    assessment.check_unused(*seeds)


def check_writable(*folders: Path) -> None:
    """Checks that files can be written into folders, and makes nothing."""
    for folder in folders:
        path = folder.absolute()
        nearest = next(one for one in (path, *path.parents) if one.exists())
        try:
            with tempfile.TemporaryFile(dir=nearest):
                pass
        except OSError as error:
            raise ValueError(f"folder '{folder}' cannot be written: {error.strerror}") from error
