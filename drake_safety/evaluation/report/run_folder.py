"""Contents of the folder of a run, and a list of the missing ones."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episodes, EpisodesInfo
from drake_safety.simulation.dataset import load_episodes, read_info

REPORT_FOLDER = "report"


@dataclass(frozen=True, kw_only=True)
class Missing:
    """A missing or inconsistent part of a run.

    Attributes:
        what: The part.
        why: The reason.
        command: The command that generates it, or "".
    """

    what: str
    why: str
    command: str = ""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One recorded simulation.

    Attributes:
        name: Its folder within the run.
        recording: The 3-D recording, if it is there.
        events: Events as written by ``run``: command, columns and rows; or empty.
    """

    name: str
    recording: Path | None
    events: Mapping[str, Any]


@dataclass(kw_only=True)
class Run:
    """The readable contents of a run.

    Attributes:
        folder: The run's folder.
        info: Metadata of the training episodes.
        extra: Command and scenario stored with them.
        episodes: The training episodes.
        assessments: By mode.
        results: Results of the evaluation.
        motions: Recorded simulations.
        pictures: By path within the run without suffix, the files by suffix.
        missing: Missing or inconsistent parts.
    """

    folder: Path
    info: EpisodesInfo | None = None
    extra: dict[str, Any] = field(default_factory=dict)
    episodes: Episodes | None = None
    assessments: dict[str, SafetyAssessment] = field(default_factory=dict)
    results: Results = field(default_factory=lambda: Results({}))
    motions: list[Motion] = field(default_factory=list)
    pictures: dict[str, dict[str, Path]] = field(default_factory=dict)
    missing: list[Missing] = field(default_factory=list)

    @property
    def scenario(self) -> dict[str, Any]:
        """The scenario that the episodes were simulated with; empty if unknown."""
        try:
            read = yaml.safe_load(str(self.extra.get("scenario_yaml", "")))
        except yaml.YAMLError:
            return {}
        return read if isinstance(read, dict) else {}

    @property
    def scenario_name(self) -> str:
        """Name of the scenario, from the episodes or else the evaluation."""
        if self.info is not None:
            return self.info.scenario
        return str(self.results.entries.get("scenario", "of an unknown scenario"))

    @property
    def causes(self) -> Counter[str]:
        """Number of training episodes by end: "safe" or the violated constraint."""
        return Counter(episode.cause or "safe" for episode in self.episodes or ())


def read_run(folder: Path, *, episodes: Path, assessments: Mapping[str, Path]) -> Run:
    """Reads the contents of the folder of a run.

    Args:
        folder: The folder written by `train` and `evaluate`.
        episodes: Folder of the training episodes in it.
        assessments: Files of the assessments in it, by mode.

    Raises:
        ValueError: The folder does not exist, or holds no part of a run.
    """
    if not folder.is_dir():
        raise ValueError(f"report: there is no folder '{folder}'")
    evaluation = folder / "evaluation.json"
    if not any(path.exists() for path in (episodes, evaluation, *assessments.values())):
        there = sorted(path.name for path in folder.iterdir())
        shown = [*there[:8], *(["…"] if len(there) > 8 else [])]
        expected = [path.name for path in (episodes, *assessments.values(), evaluation)]
        raise ValueError(
            f"report: '{folder}' is no run: it holds none of {expected}; it holds {shown}. "
            "`drake-safety train` and `evaluate` write one"
        )
    run = Run(folder=folder)
    _read_episodes(run, episodes)
    for mode, path in assessments.items():
        _read_assessment(run, mode, path)
    if run.info is None and run.assessments:
        run.info = next(iter(run.assessments.values())).info_
    _read_results(run, evaluation)
    _find_pictures(run)
    _find_motions(run)
    return run


def _read_episodes(run: Run, path: Path) -> None:
    name, again = str(run.folder), "drake-safety train SCENARIO --resume --out"
    try:
        run.info, run.extra = read_info(path)
        again = f"drake-safety train {run.info.scenario} --resume --out {name}"
        run.episodes = load_episodes(path)
    except (ValueError, OSError, TypeError) as error:
        run.missing.append(
            Missing(what="Training episodes", why=_sentence(error), command=again.strip())
        )
        return
    asked = re.search(r"--episodes[ =](\d+)", str(run.extra.get("command", "")))
    if asked and int(asked[1]) > len(run.episodes):
        run.missing.append(
            Missing(
                what="Part of the training episodes",
                why=f"{len(run.episodes)} of {asked[1]} are here: the training was stopped or is "
                "still running.",
                command=f"{again} --episodes {asked[1]}",
            )
        )


def _read_assessment(run: Run, mode: str, path: Path) -> None:
    scenario = "SCENARIO" if run.info is None else run.info.scenario
    try:
        assessment = SafetyAssessment.load(path)
    except (ValueError, OSError) as error:
        run.missing.append(
            Missing(
                what=f"The learned assessment, mode “{mode}”, and its map",
                why=_sentence(error),
                command=f"drake-safety train {scenario} --resume --out {run.folder}",
            )
        )
        return
    run.assessments[mode] = assessment
    if run.info is not None and assessment.info_.scenario_hash != run.info.scenario_hash:
        run.missing.append(
            Missing(
                what=f"Agreement of “{mode}” with the episodes",
                why=f"It was learned from scenario '{assessment.info_.scenario}' with hash "
                f"{assessment.info_.scenario_hash[:12]}; the episodes here are of "
                f"'{run.info.scenario}' with hash {run.info.scenario_hash[:12]}.",
            )
        )


def _read_results(run: Run, path: Path) -> None:
    scenario = "SCENARIO" if run.info is None else run.info.scenario
    command = f"drake-safety evaluate {scenario} --assessment {run.folder}"
    if not path.is_file():
        run.missing.append(
            Missing(
                what="The evaluation: verdict tables and their pictures",
                why="There is no evaluation.json: the run was not evaluated.",
                command=command,
            )
        )
        return
    try:
        run.results = Results.read(path)
    except (ValueError, OSError) as error:
        run.missing.append(Missing(what="The evaluation", why=_sentence(error), command=command))
        return
    stored = run.results.entries.get("scenario_hash")
    if run.info is not None and stored != run.info.scenario_hash:
        run.missing.append(
            Missing(
                what="An evaluation of this training",
                why=f"{path.name} is of scenario '{run.results.entries.get('scenario')}' with hash "
                f"{str(stored)[:12]}, the training of '{run.info.scenario}' with hash "
                f"{run.info.scenario_hash[:12]}: its results below are of another scenario.",
                command=command,
            )
        )


def _find_pictures(run: Run) -> None:
    for suffix in (".svg", ".png"):
        for path in sorted(run.folder.glob(f"**/*{suffix}")):
            name = path.relative_to(run.folder).with_suffix("")
            # The figures of the report itself are written anew; hidden folders hold none.
            if name.parts[0] != REPORT_FOLDER and not any(p.startswith(".") for p in name.parts):
                run.pictures.setdefault(name.as_posix(), {})[suffix] = path


def _find_motions(run: Run) -> None:
    folders = {path.parent for path in run.folder.glob("**/recording.html")}
    folders |= {path.parent for path in run.folder.glob("**/timeline.*")}
    for folder in sorted(folders):
        if REPORT_FOLDER in folder.relative_to(run.folder).parts:
            continue
        recording = folder / "recording.html"
        try:
            events = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        except (ValueError, OSError):
            events = {}
        run.motions.append(
            Motion(
                name=folder.relative_to(run.folder).as_posix(),
                recording=recording if recording.is_file() else None,
                events=events if isinstance(events, dict) else {},
            )
        )
    if not any(motion.recording for motion in run.motions):
        scenario = "SCENARIO" if run.info is None else run.info.scenario
        run.missing.append(
            Missing(
                what="A recorded motion: its timeline and the 3-D recording",
                why="No folder here holds a recording.html.",
                command=f"drake-safety run {scenario} --assessment {run.folder}",
            )
        )


def _sentence(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text[0].upper() + text[1:] + ("" if text.endswith(".") else ".")
