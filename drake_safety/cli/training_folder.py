"""The folder written by ``train``, with episodes and an assessment for each mode."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from drake_safety.assessments import assessed_scenarios, shipped_folder
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress


class AssessmentFolder(NamedTuple):
    """Folders of the assessments of a scenario.

    Attributes:
        path: Folder of the assessments.
        out: Folder of results: the same, unless the assessments are shipped with the package.
    """

    path: Path
    out: Path

    @property
    def is_shipped(self) -> bool:
        """Whether the assessments are shipped with the package."""
        return self.path != self.out


class GoalThreshold(NamedTuple):
    """Thresholds of verdicts on goals.

    Attributes:
        threshold: Lowest probability of an accepted goal.
        unsafe_below: Probability below which a goal is unsafe; in between the verdict is "don't
            know".
        origin: Where they come from.
    """

    threshold: float
    unsafe_below: float
    origin: str


MODES = ("sharpened", "paper")
"""Modes, the default first."""
DEFAULT_THRESHOLD = 0.5
"""Lowest probability of an accepted goal where no promise has chosen one."""


def episodes_folder(folder: Path, mode: str = MODES[0]) -> Path:
    """Folder of the training episodes of a mode.

    The paper's mode has a folder of its own if its task has other episodes for it, see
    `training_options`.
    """
    own = folder / f"episodes_{mode}"
    return own if own.is_dir() else folder / "episodes"


def training_options(scenario: Scenario, mode: str) -> dict[str, Any]:
    """Options of the diagram for a mode's training episodes, besides the defaults."""
    return {} if mode == MODES[0] else scenario.options_for("paper")


def fresh_episodes_folder(
    folder: Path, scenario_hash: str, seed: int, loop_options: dict[str, str]
) -> Path:
    """Folder of fresh episodes of ``evaluate``.

    Args:
        folder: Folder of the training.
        scenario_hash: Hash of the simulation.
        seed: Seed of the set.
        loop_options: Options of the diagram.
    """
    options = [f"{name}-{value}" for name, value in sorted(loop_options.items())]
    return folder / "fresh" / "-".join([scenario_hash[:12], f"{seed}", *options])


def run_fresh_episodes(
    scenario: Scenario,
    folder: Path,
    num_episodes: int,
    seed: int,
    progress: Progress,
    num_workers: int | None = None,
    variation: str = "nominal",
    **loop_options: str,
) -> Episodes:
    """Simulates fresh episodes, and keeps them; existing ones are reused.

    Args:
        scenario: The scenario.
        folder: Folder of the training.
        num_episodes: Number of episodes.
        seed: Seed of the set.
        progress: Called with the number done and the number wanted.
        num_workers: Number of worker processes; one a core by default.
        variation: The plant.
        **loop_options: Options of the diagram, besides those of evaluations.
    """
    options = {**scenario.options_for("evaluation"), **loop_options}
    return run_episodes(
        scenario,
        num_episodes,
        variation=variation,
        seed=seed,
        num_workers=num_workers,
        path=fresh_episodes_folder(folder, scenario.simulation_hash(variation), seed, options),
        progress=progress,
        **options,
    )


def feedback_folder(folder: Path, scenario_hash: str, seed: int) -> Path:
    """Folder of pairs of actual episodes and nominal twins of ``adapt``.

    Args:
        folder: Folder of the training.
        scenario_hash: Hash of the simulation of the actual plant.
        seed: Seed of the set.
    """
    return folder / "feedback" / f"{scenario_hash[:12]}-{seed}"


def adapted_folder(folder: Path, variation: str) -> Path:
    """Folder of adapted assessments, which other commands accept as that of a training.

    Args:
        folder: Folder of the training.
        variation: Variation of the actual plant.
    """
    return folder / f"adapted-{variation}"


def assessment_file(folder: Path, mode: str) -> Path:
    """File of the assessment of a mode."""
    return folder / f"{mode}.safetensors"


def assessment_folder(scenario: Scenario, given: Path | None) -> AssessmentFolder:
    """The given folder, or by default that of the shipped assessments.

    Args:
        scenario: The scenario.
        given: Value of ``--assessment``.

    Raises:
        ValueError: Nothing is given, and the package has no assessment of this scenario, or one of
            another scenario of this name.
    """
    if given is not None:
        return AssessmentFolder(given, given)

    advice = "`drake-safety train` learns one, in a folder to be passed as --assessment"
    if scenario.name not in assessed_scenarios():
        raise ValueError(
            f"no assessment of scenario '{scenario.name}' comes with the package, which has those "
            f"of {assessed_scenarios()}: {advice}"
        )
    shipped = shipped_folder(scenario.name)
    learned = load_assessment(shipped, MODES[0]).info_.scenario_hash
    if learned != scenario.simulation_hash():
        raise ValueError(
            f"the assessment of '{scenario.name}' that comes with the package was learned from a "
            f"scenario with hash {learned[:12]}, this one has {scenario.simulation_hash()[:12]}: "
            f"{advice}"
        )
    # A separate folder, so that no training is overwritten.
    return AssessmentFolder(shipped, Path("runs") / f"{scenario.name}-shipped")


def load_assessment(folder: Path, mode: str) -> SafetyAssessment:
    """Loads the assessment of a mode.

    Raises:
        ValueError: The folder does not hold it.
    """
    path = assessment_file(folder, mode)
    if not path.is_file():
        there = sorted(file.stem for file in folder.glob("*.safetensors"))
        raise ValueError(
            f"{folder} holds no '{mode}' assessment; it holds {there}: "
            "run `drake-safety train` first"
        )
    return SafetyAssessment.load(path)


def check_fresh(
    assessment: SafetyAssessment, scenario: Scenario, seeds: Iterable[int] = ()
) -> None:
    """Checks that an assessment can be evaluated on fresh episodes.

    Args:
        assessment: The assessment.
        scenario: Scenario of the fresh episodes.
        seeds: Seeds of the fresh episodes.

    Raises:
        ValueError: The scenario has changed since the training, or the assessment has used one of
            the seeds.
    """
    trained = assessment.info_
    scenario_hash = scenario.simulation_hash()
    if trained.scenario_hash != scenario_hash:
        raise ValueError(
            f"the assessment was trained on scenario '{trained.scenario}' with hash "
            f"{trained.scenario_hash[:12]}; '{scenario.name}' now has hash {scenario_hash[:12]}, "
            "as its file, its robot or its task has changed: train again"
        )
    assessment.check_unused(*seeds)


def check_writable(*folders: Path) -> None:
    """Checks that files can be written into folders, before hours of simulations.

    Nothing is left behind; folders that do not exist are not made.

    Args:
        *folders: Folders of results.

    Raises:
        ValueError: A folder cannot be written; the message says what is in the way.
    """
    for folder in folders:
        nearest = folder.absolute()
        while not nearest.exists() and nearest != nearest.parent:
            nearest = nearest.parent
        try:
            with tempfile.TemporaryFile(dir=nearest):
                pass
        except OSError as error:
            where = "" if nearest == folder.absolute() else f" in '{nearest}'"
            raise ValueError(
                f"folder '{folder}' cannot be written{where}: {error.strerror}; choose another"
            ) from error


def goal_threshold(folder: Path, assessment: SafetyAssessment) -> GoalThreshold:
    """Thresholds of verdicts on goals.

    Args:
        folder: Folder of a training.
        assessment: The assessment.

    Returns:
        The assessment's thresholds, which `calibrate` chooses; else the default.
    """
    calibration = assessment.calibrations_.get("plan")
    if calibration is not None:
        return GoalThreshold(calibration.threshold, calibration.unsafe_below, calibration.origin)
    return GoalThreshold(
        DEFAULT_THRESHOLD,
        DEFAULT_THRESHOLD,
        "the default, which promises nothing: `drake-safety calibrate` chooses one with a promised "
        f"miss rate and keeps it in {folder}",
    )
