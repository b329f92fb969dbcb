"""The folder that ``train`` writes and the other commands read: episodes, an assessment a mode."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episodes
    from drake_safety.simulation.rollouts import Progress
    from drake_safety.simulation.scenario import Scenario


class AssessmentFolder(NamedTuple):
    """Where a command finds the assessments of a scenario, and where it writes.

    Attributes:
        path: Holds an assessment a mode.
        out: Where what is made of them goes: the same folder, unless they came with the package.
    """

    path: Path
    out: Path

    @property
    def is_shipped(self) -> bool:
        """Whether the assessments came with the package."""
        return self.path != self.out


class GoalThreshold(NamedTuple):
    """What a verdict on a goal is read from.

    Attributes:
        threshold: From which Γ, calibrated, on it is accepted.
        unsafe_below: Below which it is unsafe; between the two the answer is "don't know".
        remark: Where they come from, if that is worth saying.
    """

    threshold: float
    unsafe_below: float
    remark: str = ""


MODES = ("sharpened", "paper")
"""Modes that are trained and compared, the default first."""
DEFAULT_THRESHOLD = 0.5
"""From which Γ on a goal is accepted where no threshold was calibrated."""


def episodes_folder(folder: Path) -> Path:
    """Where ``train`` keeps the nominal episodes."""
    return folder / "episodes"


def fresh_episodes_folder(
    folder: Path, scenario_hash: str, seed: int, loop_options: dict[str, str]
) -> Path:
    """Where ``evaluate`` keeps the nominal episodes it judges by, so that it can go on with them.

    Args:
        folder: The folder of the training.
        scenario_hash: Of what was simulated: another simulation is another set.
        seed: Of the set.
        loop_options: Options of the task's diagram.
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
    **loop_options: str,
) -> Episodes:
    """Simulates nominal episodes to judge by, and keeps them; goes on with those that are there.

    Args:
        scenario: The scenario.
        folder: The folder of the training.
        num_episodes: How many.
        seed: Of the set.
        progress: Called with the number done and the number wanted.
        num_workers: Processes; as many as there are cores by default.
        **loop_options: Of the task's diagram, besides those that it is judged with.
    """
    from drake_safety.simulation.capabilities import judging_options
    from drake_safety.simulation.rollouts import run_episodes

    options = {**judging_options(scenario.task_class()), **loop_options}
    return run_episodes(
        scenario,
        num_episodes,
        seed=seed,
        num_workers=num_workers,
        path=fresh_episodes_folder(folder, scenario.simulation_hash(), seed, options),
        progress=progress,
        **options,
    )


def feedback_folder(folder: Path, scenario_hash: str, seed: int) -> Path:
    """Where ``adapt`` keeps pairs of actual episodes and their twins, a folder a plant.

    Args:
        folder: The folder of the training.
        scenario_hash: Of the actual plant's simulation: another simulation is another set.
        seed: Of the set.
    """
    return folder / "feedback" / f"{scenario_hash[:12]}-{seed}"


def adapted_folder(folder: Path, variation: str) -> Path:
    """Where ``adapt`` writes the adapted assessments; other commands take it for a training's.

    Args:
        folder: The folder of the training.
        variation: What they are adapted to.
    """
    return folder / f"adapted-{variation}"


def assessment_file(folder: Path, mode: str) -> Path:
    """Where ``train`` keeps the assessment of a mode."""
    return folder / f"{mode}.safetensors"


def assessment_folder(scenario: Scenario, given: Path | None) -> AssessmentFolder:
    """The folder that was asked for; else the one that comes with the package, which is told.

    Args:
        scenario: The scenario.
        given: What ``--assessment`` says.

    Raises:
        ValueError: Nothing is given, and no assessment of this scenario comes with the package, or
            one of another scenario of this name.
    """
    if given is not None:
        return AssessmentFolder(given, given)
    from drake_safety.assessments import assessed_scenarios, shipped_folder

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
    # A folder of its own: nobody's training is written over.
    return AssessmentFolder(shipped, Path("runs") / f"{scenario.name}-shipped")


def load_assessment(folder: Path, mode: str) -> SafetyAssessment:
    """Loads what ``train`` wrote.

    Raises:
        ValueError: The folder does not hold it.
    """
    from drake_safety.learning.assessment import SafetyAssessment

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
    """Refuses what an assessment cannot be judged by.

    Args:
        assessment: The assessment.
        scenario: That fresh episodes are simulated of.
        seeds: Of the fresh sets.

    Raises:
        ValueError: The scenario is no longer the one that was learned from, or the assessment has
            used one of the seeds.
    """
    trained = assessment.info_
    scenario_hash = scenario.simulation_hash()
    if trained.scenario_hash != scenario_hash:
        raise ValueError(
            f"scenario '{trained.scenario}' was learned from with hash "
            f"{trained.scenario_hash[:12]}, but '{scenario.name}' now has hash "
            f"{scenario_hash[:12]}: train again"
        )
    assessment.check_unused(*seeds)


def goal_threshold(folder: Path, mode: str, assessment: SafetyAssessment) -> GoalThreshold:
    """What a verdict on a goal is read from.

    Args:
        folder: The folder of a training.
        mode: Of the assessment that is asked.
        assessment: The assessment itself.

    Returns:
        What ``calibrate`` stored with the assessment; else the threshold that ``evaluate`` chose on
        its calibration episodes; else the default, and a remark that says so.
    """
    calibration = assessment.calibrations_.get("plan")
    if calibration is not None:
        return GoalThreshold(calibration.threshold, calibration.unsafe_below, calibration.promise)
    file = folder / "evaluation.json"
    estimates = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    estimate = estimates.get(f"plans.{mode}.threshold")
    if estimate is not None:
        return GoalThreshold(float(estimate["value"]), float(estimate["value"]))
    return GoalThreshold(
        DEFAULT_THRESHOLD,
        DEFAULT_THRESHOLD,
        f"the threshold {DEFAULT_THRESHOLD:g} is not calibrated: `drake-safety calibrate` chooses "
        f"one with a promised miss rate and keeps it in {folder}",
    )
