"""``python -m studies readings``: what each reading of the paper costs or gains."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.cli.training_folder import episodes_folder
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario
from studies.converged import judged_rules, nominal_feedback, recalls
from studies.harness import (
    CalibrationOption,
    EpisodesOption,
    ReleaseOption,
    SeedOption,
    Study,
    open_study,
    parse_sizes,
)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One way to read the paper: what differs from the package's default reading.

    Attributes:
        name: Its name in tables.
        assessment: Changed parameters of the assessment; those of `paper` have the prefix
            "paper.".
        start: Changed parameters of the start's sampling; the reading has episodes of its own.
        is_exploring: Whether it learns from the sharpened mode's episodes.
        num_episodes: Number of training episodes; 0 for the study's.
    """

    name: str
    assessment: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    is_exploring: bool = False
    num_episodes: int = 0

    def parameters(self, base: AssessmentParameters) -> AssessmentParameters:
        """The parameters of this reading."""
        own = {k: v for k, v in self.assessment.items() if not k.startswith("paper.")}
        paper = {k.removeprefix("paper."): v for k, v in self.assessment.items() if k not in own}
        return replace(copy.deepcopy(base), mode="paper", paper=replace(base.paper, **paper), **own)

    def has_own_episodes(self, base: AssessmentParameters) -> bool:
        """Whether its episodes are simulated anew."""
        stride = self.assessment.get("preview_stride", base.preview_stride)
        return bool(self.start) or stride != base.preview_stride

    def scenario(self, base: Scenario) -> Scenario:
        """The scenario of its episodes."""
        changed = copy.deepcopy(base)
        changed.assessment = self.parameters(base.assessment)
        for name, value in self.start.items():
            setattr(changed.parameters.start, name, value)
        return changed


def readings_of(scenario: Scenario) -> list[Reading]:
    """The default reading, each other reading alone, and the former ones together.

    Args:
        scenario: The scenario; a reading that it has already is left out.
    """
    base = scenario.assessment
    rooted = {"warping_cost": "rooted"}
    plain = {"exaggeration": 1.0}
    bare = {"paper.dropout": 0.0, "paper.weight_decay": 1e-4}
    former = {
        **rooted,
        **plain,
        **bare,
        "initialization": "random",
        "paper.stride": 0,
        "paper.standardized": True,
    }
    usual = Reading(name="default").parameters(base)
    singles = [
        Reading(name="default"),
        Reading(name="path cost: root of the sum of squares", assessment=rooted),
        Reading(name="path cost: sum of distances", assessment={"warping_cost": "absolute"}),
        Reading(name="root, score weight 0.1", assessment={**rooted, "score_weight": 0.1}),
        Reading(name="t-SNE without exaggeration", assessment=plain),
        Reading(name="t-SNE from random points", assessment={"initialization": "random"}),
        Reading(name="disjoint segments", assessment={"paper.stride": 0}),
        Reading(
            name="raw x" if base.paper.standardized else "standardised x",
            assessment={"paper.standardized": not base.paper.standardized},
        ),
        Reading(name="x without velocities", assessment={"paper.velocities": False}),
        Reading(name="loss: distance, not squared", assessment={"paper.loss": "norm"}),
        Reading(name="no dropout or weight decay", assessment=bare),
        Reading(name="three layers of 256", assessment={"paper.hidden_sizes": [256] * 3}),
        Reading(name="200 epochs", assessment={"paper.epochs": 200}),
        Reading(
            name="200 epochs, stopped early",
            assessment={"paper.epochs": 200, "paper.held_out": 0.1},
        ),
    ]
    if base.preview_stride > 1:
        name = f"step of {scenario.step_s:g} s"
        singles.append(Reading(name=name, assessment={"preview_stride": 1}))
    start = getattr(scenario.parameters, "start", None)
    if any(getattr(start, "tracking_offset_m", ())):
        offset = {"tracking_offset_m": [0.0, 0.0, 0.0]}
        singles.append(Reading(name="no offset between plan and state", start=offset))
    if scenario.options_for("paper"):
        singles.append(Reading(name="disturbed episodes", is_exploring=True))
    singles = [
        one
        for one in singles
        if one == singles[0] or one.start or one.is_exploring or one.parameters(base) != usual
    ]
    return [*singles, Reading(name="former reading", assessment=former, is_exploring=True)]


def readings(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    train_episodes: Annotated[
        int, typer.Option(help="Training episodes of each reading.", min=64)
    ] = 1024,
    episodes: EpisodesOption = 400,
    calibration_episodes: CalibrationOption = 200,
    sizes: Annotated[
        str, typer.Option(help="Numbers of episodes for the default reading, such as '512,2048'.")
    ] = "",
    only: Annotated[str, typer.Option(help="Part of the names of the readings.")] = "",
    seed: SeedOption = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Train the paper's mode under every reading, and judge it on fresh episodes.

    The episodes for thresholds are its nominal feedback too.
    Episodes of readings with data of their own are kept in ASSESSMENT/readings. Writes
    ASSESSMENT/readings.json.
    """
    with open_study(
        "readings", scenario, assessment, seed=seed, release=release, workers=workers
    ) as study:
        base = study.scenario.assessment = replace(study.scenario.assessment, mode="paper")
        readings = readings_of(study.scenario)
        chosen = [one for one in readings if only in one.name]
        chosen += [
            Reading(name=f"default, {size} episodes", num_episodes=size)
            for size in parse_sizes(sizes)
        ]
        if not chosen:
            names = [one.name for one in readings]
            raise ValueError(f"--only '{only}': no reading of this name; they are {names}")
        for position, reading in enumerate(chosen):
            study.stages("readings", position, len(chosen))
            sets = _EpisodeSets(study, reading)
            train = sets.training(reading.num_episodes or train_episodes)
            test = sets.fresh(episodes, "evaluation")
            calibration = sets.fresh(calibration_episodes, "thresholds")
            learned = SafetyAssessment(reading.parameters(base)).fit(train)
            adapted = learned.adapt(nominal_feedback(learned, calibration), method="paper")
            rules = judged_rules(learned, adapted)
            # A promised miss rate takes more calibration episodes than the others need.
            del rules["conformal"]
            never = np.zeros(len(test), dtype=bool)
            study.add(f"readings.{position}", recalls(rules, calibration, test, never))
        study.entries |= {
            "training_episodes": train_episodes,
            "names": [one.name for one in chosen],
        }


class _EpisodeSets:
    """Episodes of a reading; those without changes are shared with `train` and `evaluate`."""

    def __init__(self, study: Study, reading: Reading):
        self._study, self._reading = study, reading
        self._is_own = reading.has_own_episodes(study.scenario.assessment)
        self._scenario = reading.scenario(study.scenario) if self._is_own else study.scenario

    def training(self, count: int) -> Episodes:
        """The first training episodes."""
        if self._is_own:
            options = self._scenario.options_for("paper")
            episodes = self._run("training", count, 0, options)
        else:
            mode = "sharpened" if self._reading.is_exploring else "paper"
            folder = episodes_folder(self._study.folder, mode)
            episodes = load_episodes(folder)[:count]
            if len(episodes) < count:
                raise ValueError(
                    f"readings: {folder} holds {len(episodes)} episodes, expected at least "
                    f"{count}: train with more"
                )
        info = replace(episodes.info, scenario_hash=self._scenario.simulation_hash())
        return Episodes(info, list(episodes))

    def fresh(self, count: int, purpose: str) -> Episodes:
        """Fresh episodes, as `evaluate` draws them."""
        if not self._is_own:
            return self._study.fresh(count, purpose)
        options = self._scenario.options_for("evaluation")
        return self._run(purpose, count, self._study.seeds[purpose], options)

    def _run(self, what: str, count: int, seed: int, options: dict[str, Any]) -> Episodes:
        own = f"{self._scenario.simulation_hash()[:12]}-{what}-{seed}"
        episodes = run_episodes(
            self._scenario,
            count,
            seed=seed,
            num_workers=self._study.workers,
            path=self._study.folder / "readings" / own,
            progress=partial(self._study.stages, f"episodes, {what}"),
            **options,
        )
        return episodes[:count]
