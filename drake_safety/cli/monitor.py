"""``drake-safety monitor``: the change detector over logs of a robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.timeline_figure import levels_figure
from drake_safety.files.schema import load_typed_file
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.change_detector import rows_of
from drake_safety.logs.episodes import motions_from_log
from drake_safety.logs.robot_log import FORMATS, read_pieces
from drake_safety.logs.sequences import Motion, SequenceMap, read_sequences
from drake_safety.simulation.rollouts import worker_loop
from drake_safety.simulation.scenario import Scenario

_SEQUENCES = ".npz"
_LEAST_S = 1.0  # Of motion in which no alarm says something.


def monitor(
    scenario: console.ScenarioArgument,
    log: Annotated[
        list[Path],
        Option(help="Log of a robot, .npz file of sequences, or folder of either; repeatable."),
    ],
    log_map: Annotated[Path, Option("--map", help="Map of their columns, a YAML file.")],
    assessment: console.AssessmentOption = None,
    out: Annotated[
        Path | None, Option(help="Folder to write; ASSESSMENT/monitor by default.")
    ] = None,
) -> None:
    """Run the change monitor over logs of a robot: its alarms, their causes, and its levels.

    Writes monitor.json and a picture of each log, or sequence of an .npz file.
    """
    loaded, learned, gamma = folders.open_assessment(scenario, assessment)
    folder = out or learned.out / "monitor"
    folders.check_writable(folder)
    files = [file for given in log for file in _files(given)]
    found: list[dict[str, Any]] = []
    with console.open_stages() as stages:
        for i, file in enumerate(files):
            for what, motions in _motions(file, log_map, loaded, gamma):
                picture = folder / f"{file.stem}-{len(found) + 1}"
                found.append(_judged(motions, gamma, picture) | what)
            stages("logs", i + 1, len(files))
    entries = {"monitor": gamma.detector_.describe(), "logs": found}
    folder.mkdir(parents=True, exist_ok=True)
    Results({}, console.made_by(loaded.name) | entries).write(folder / "monitor.json")
    _show(found)
    console.say("figures ", folder / "monitor.json")
    console.say("pictures", folder)
    if told := [one["log"] for one in found if not one["alarms"] and one["judged_s"] < _LEAST_S]:
        raise ValueError(
            f"{len(told)} of {len(found)} logs have less than {_LEAST_S:g} s of motion without a "
            f"missing value, which is too short to judge: {', '.join(told[:3])}"
        )


def _files(given: Path) -> list[Path]:
    """A log, or those in a folder that is not itself a ROS 2 bag."""
    bag, known = "metadata.yaml", [*FORMATS, _SEQUENCES]
    if not given.exists():
        raise ValueError(f"log '{given}' does not exist")
    if not given.is_dir() or (given / bag).is_file():
        return [given]
    found = [p for p in given.iterdir() if p.suffix.lower() in known or (p / bag).is_file()]
    if not found:
        raise ValueError(f"folder '{given}' has no log; known are {known} and ROS 2 bags")
    return sorted(found)


def _motions(
    file: Path, log_map: Path, scenario: Scenario, gamma: SafetyAssessment
) -> Iterator[tuple[dict[str, Any], list[Motion]]]:
    """A log, or each sequence of a file, by what identifies it; and its motions."""
    what = {"log": str(file), "sequence": None, "left_safe_set": ""}
    if file.suffix.lower() == _SEQUENCES:
        read_by = load_typed_file(SequenceMap, log_map, f"map '{log_map}'")
        read = read_sequences(file, read_by, gamma.detector_, gamma.info_)
        yield from ((what | {"sequence": i}, motions) for i, motions in enumerate(read))
    else:
        loop = worker_loop(scenario, "actual")()
        pieces = read_pieces(file, log_map, loop.robot)
        if summary := pieces.summary():
            console.say(summary, style="yellow")
        found = motions_from_log(pieces.pieces, loop, step_s=gamma.detector_.step_s)
        what["left_safe_set"] = next((one.cause for one in found if not one.is_safe), "")
        yield (
            what | {"duration_s": pieces.duration_s},
            [(one.time_s, rows_of(one)) for one in found],
        )


def _judged(motions: Sequence[Motion], gamma: SafetyAssessment, picture: Path) -> dict[str, Any]:
    """Duration, largest level and alarms of a log, which are drawn into a picture."""
    detector = gamma.detector_
    if not motions:
        return {"end_s": 0.0, "duration_s": 0.0, "judged_s": 0.0, "level": 0.0, "alarms": []}
    names = [gamma.info_.state_names[i] for i in detector.watched]
    levels, alarms = detector.watch([rows for _, rows in motions], names)
    time_s = np.concatenate([times for times, _ in motions]).round(6)
    save(levels_figure(time_s, levels, names, alarms, detector.alarm_level), picture)
    return {
        "end_s": float(time_s[-1]),
        "duration_s": float(time_s[-1]),
        "judged_s": float(sum(times[-1] - times[0] for times, _ in motions)),
        "level": float(levels.max()),
        "state": names[int(levels.max(axis=0).argmax())],
        "alarms": [
            {
                "begin_s": float(time_s[one.begin]),
                "end_s": float(time_s[one.end]) if one.end < len(time_s) else None,
                "level": float(levels[one.begin : one.end].max()),
                "cause": one.cause,
            }
            for one in alarms
        ],
    }


def _show(found: Sequence[Mapping[str, Any]]) -> None:
    """Prints a row an alarm, and one for a log without any."""
    rows = []
    for one in found:
        number = "" if one["sequence"] is None else f" [{one['sequence']}]"
        left = one["left_safe_set"] and f", left the safe set: {one['left_safe_set']}"
        share = one["judged_s"] / max(one["duration_s"], 1e-9)
        head = [f"{Path(*Path(one['log']).parts[-2:])}{number}", f"{one['end_s']:.2f}{left}"]
        head.append(f"{share:.0%}")
        if not one["alarms"] and one["judged_s"] < _LEAST_S:
            told = f"not judged: {one['judged_s']:.2f} s, expected at least {_LEAST_S:g} s"
            rows.append([*head, "-", "-", "-", told])
        elif not one["alarms"]:
            told = f"no alarm; largest: {one['state']}"
            rows.append([*head, "-", "-", f"{one['level']:.2f}", told])
        for alarm in one["alarms"]:
            numbers = (alarm[key] for key in ("begin_s", "end_s", "level"))
            cells = ["goes on" if value is None else f"{value:.2f}" for value in numbers]
            rows.append([*head, *cells, alarm["cause"]])
            head = ["", "", ""]
    columns = ("log", "until [s]", "judged", "alarm [s]", "ends [s]", "largest level", "cause")
    console.show(console.new_table(*columns, rows=rows))
