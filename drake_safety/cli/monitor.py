"""``drake-safety monitor``: the change detector over logs of a robot."""

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
from drake_safety.logs.episodes import loggable_loop, motions_from_log
from drake_safety.logs.robot_log import FORMATS, read_pieces
from drake_safety.logs.sequences import Motion, SequenceMap, read_recording, read_sequences
from drake_safety.simulation.rollouts import worker_loop
from drake_safety.simulation.scenario import Scenario

_SEQUENCES = ".npz"
_LEAST_S = 1.0  # Shortest motion in which the lack of an alarm is evidence.


def monitor(
    scenario: console.ScenarioArgument,
    log: Annotated[
        list[Path], Option(help="Log, .npz file of sequences, or folder of either; repeatable.")
    ],
    log_map: console.MapOption = None,
    assessment: console.AssessmentOption = None,
    out: Annotated[Path | None, Option(help="Folder; by default ASSESSMENT/monitor.")] = None,
) -> None:
    """Run the change monitor over logs of a robot: its alarms, their causes, and its levels."""
    loaded, learned, gamma = folders.open_assessment(scenario, assessment)
    folder = out or learned.out / "monitor"
    folders.check_writable(folder)
    files = [file for path in log for file in _files(path)]
    logs: list[dict[str, Any]] = []
    with console.open_stages() as stages:
        for i, file in enumerate(files):
            for entry, motions in _motions(file, log_map, loaded, gamma):
                picture = folder / f"{file.stem}-{len(logs) + 1}"
                logs.append(_judged(motions, gamma, picture) | entry)
            stages("logs", i + 1, len(files))
    entries = {"monitor": gamma.detector_.describe(), "logs": logs}
    folder.mkdir(parents=True, exist_ok=True)
    Results({}, console.made_by(loaded.name) | entries).write(folder / "monitor.json")
    columns = ("log", "until [s]", "judged", "alarm [s]", "ends [s]", "largest level", "cause")
    console.show(console.new_table(*columns, rows=[row for entry in logs for row in _rows(entry)]))
    console.say("figures ", folder / "monitor.json")
    console.say("pictures", folder)
    if short := sum(not entry["alarms"] and entry["judged_s"] < _LEAST_S for entry in logs):
        raise ValueError(f"{short} of {len(logs)} logs have less than {_LEAST_S:g} s of motion")


def _files(path: Path) -> list[Path]:
    """A log, or the logs in a folder that is not itself a ROS 2 bag."""
    bag, known = "metadata.yaml", [*FORMATS, _SEQUENCES]
    if not path.exists():
        raise ValueError(f"log '{path}' does not exist")
    if not path.is_dir() or (path / bag).is_file():
        return [path]
    files = [p for p in path.iterdir() if p.suffix.lower() in known or (p / bag).is_file()]
    if not files:
        raise ValueError(f"folder '{path}' has no log; known are {known} and ROS 2 bags")
    return sorted(files)


def _motions(
    file: Path, log_map: Path | None, scenario: Scenario, gamma: SafetyAssessment
) -> Iterator[tuple[dict[str, Any], list[Motion]]]:
    """Identifies a log, or each sequence of a file, with its motions."""
    entry = {"log": str(file), "sequence": None, "left_safe_set": ""}
    if file.suffix.lower() == _SEQUENCES:
        if log_map is None:
            raise ValueError(f"sequences '{file}' need --map")
        sequence_map = load_typed_file(SequenceMap, log_map, f"map '{log_map}'")
        sequences = read_sequences(file, sequence_map, gamma.detector_, gamma.info_)
        yield from ((entry | {"sequence": i}, motions) for i, motions in enumerate(sequences))
        return
    if log_map is None and file.suffix.lower() == ".mcap":
        if recorded := read_recording(file, gamma.detector_, gamma.info_):
            motions, left = recorded
            yield entry | {"left_safe_set": left}, motions
            return
    loop = loggable_loop(worker_loop(scenario, "actual")())
    read = read_pieces(file, log_map, loop.robot)
    if summary := read.summary():
        console.say(summary, style="yellow")
    episodes = motions_from_log(read.pieces, loop, step_s=gamma.detector_.step_s)
    entry["left_safe_set"] = next((e.cause for e in episodes if not e.is_safe), "")
    motions = [(episode.time_s, rows_of(episode)) for episode in episodes]
    yield entry | {"duration_s": read.duration_s}, motions


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
                "begin_s": float(time_s[alarm.begin]),
                "end_s": float(time_s[alarm.end]) if alarm.end < len(time_s) else None,
                "level": float(levels[alarm.begin : alarm.end].max()),
                "cause": alarm.cause,
            }
            for alarm in alarms
        ],
    }


def _rows(entry: Mapping[str, Any]) -> list[list[str]]:
    """A row of the table for each alarm of a log, or one that says that there is none."""
    number = "" if entry["sequence"] is None else f" [{entry['sequence']}]"
    left = entry["left_safe_set"] and f", left the safe set: {entry['left_safe_set']}"
    share = entry["judged_s"] / max(entry["duration_s"], 1e-9)
    name = f"{Path(*Path(entry['log']).parts[-2:])}{number}"
    head = [name, f"{entry['end_s']:.2f}{left}", f"{share:.0%}"]
    if not entry["alarms"] and entry["judged_s"] < _LEAST_S:
        return [[*head, "-", "-", "-", f"not judged: {entry['judged_s']:.2f} s"]]
    if not entry["alarms"]:
        return [[*head, "-", "-", f"{entry['level']:.2f}", f"no alarm; largest: {entry['state']}"]]
    rows = []
    for alarm in entry["alarms"]:
        numbers = (alarm[key] for key in ("begin_s", "end_s", "level"))
        cells = ["goes on" if value is None else f"{value:.2f}" for value in numbers]
        rows.append([*head, *cells, alarm["cause"]])
    return rows
