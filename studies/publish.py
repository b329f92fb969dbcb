"""``python -m studies store``, ``readme`` and ``ship``: publishing the results of a run.

A shipped folder holds the files of a run, the card `README.md`, and `evaluation.json`: results,
commands, seeds and versions of the evaluation, and the SHA-256 of every evaluated file. It also
has verdicts on the first fresh episodes of its seed, to compare with a new simulation.
"""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.assessments import assessed_scenarios, shipped_folder
from drake_safety.cli.console import TrainingOption, open_stages, say
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.calibration import PLAN
from drake_safety.learning.segments import split
from drake_safety.simulation.dataset import read_info
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.worker_processes import Progress
from studies.documents import CARD_FILE, EVALUATION_FILE, GENERATED, card_text, generate

NUM_EPISODES = 6
"""Number of fresh episodes whose verdicts are stored."""
# Stored beside the evaluation.
_STUDIES = ("shifts", "walking")
_PRINTED = re.compile(r"(<!-- printed: drake-safety (.*?) -->\n```text\n).*?(```\n)", re.DOTALL)
_PRINTED_LINES = 5
_HASHES, _VERDICTS = "assessment_sha256", "first_episodes"
_TOLERANCE = 1e-3  # Γ differs less between processors, and more between assessments.
_FOLDER_OPTIONS = ("--assessment", "--out")


def documents(root: Path = Path()) -> list[Path]:
    """README and the pages with generated text."""
    paths = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    return [path for path in paths if GENERATED.search(path.read_text(encoding="utf-8"))]


def printed(text: str) -> str:
    """Replaces what is behind ``<!-- printed: drake-safety … -->`` by what the command prints."""

    def run(match: re.Match[str]) -> str:
        call = "from drake_safety.cli import main; main()"
        command = [sys.executable, "-c", call, *shlex.split(match[2])]
        done = subprocess.run(command, capture_output=True, text=True)
        shown = "".join(done.stdout.splitlines(keepends=True)[:_PRINTED_LINES])
        if not shown:
            raise ValueError(f"drake-safety {match[2]} prints nothing: {done.stderr}")
        return f"{match[1]}{shown}{match[3]}"

    return _PRINTED.sub(run, text)


def store(
    assessment: TrainingOption,
    out: Annotated[Path, typer.Option(help="File to write: docs/results/NAME.json.")],
) -> None:
    """Store the evaluation in ASSESSMENT, with its studies if there are any."""
    out.parent.mkdir(parents=True, exist_ok=True)
    evaluated(assessment).write(out)
    say("stored", out)


def readme(
    paths: Annotated[list[Path] | None, typer.Argument(help="Markdown files.", exists=True)] = None,
) -> None:
    """Rewrite the tables of README.md and docs from docs/results/NAME.json.

    They stand between <!-- results: NAME -->, or another kind of table, and <!-- end -->;
    figures of sentences behind <!-- value: … -->, outputs behind <!-- printed: … -->. Without
    PATHS also the cards of the shipped assessments, from what ships.
    """
    for path in paths or documents():
        text = path.read_text(encoding="utf-8")
        try:
            generated = printed(generate(text))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        path.write_text(generated, encoding="utf-8")
        say("results in", path)
    for name in [] if paths else assessed_scenarios():
        card = shipped_folder(name) / CARD_FILE
        card.write_text(card_text(card.parent, load_scenario(name)), encoding="utf-8")
        say("card", card)


def ship(
    assessment: TrainingOption,
    into: Annotated[
        Path, typer.Option(help="Parent of the folder, which is named after the scenario.")
    ] = Path("assessments"),
) -> None:
    """Copy trained assessments, with their evaluation and a card, into the package.

    Nothing is written where an assessment is missing, not calibrated or not the evaluated one, or
    where the scenario has changed since.
    """
    results = evaluated(assessment)
    if "train_command" not in results.entries:
        raise ValueError(
            f"ship: the training command of {assessment} is unknown: no command in "
            f"{episodes_folder(assessment)}"
        )
    scenario = load_scenario(str(results.entries["scenario"]))
    files = {mode: assessment_file(assessment, mode) for mode in MODES}
    learned = {}
    for mode, file in files.items():
        if not file.is_file():
            raise ValueError(f"ship: there is no '{mode}' assessment at {file}: train both modes")
        learned[mode] = SafetyAssessment.load(file)
        if PLAN not in learned[mode].calibrations_:
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
    _check_simulation(results, learned, scenario)
    with open_stages() as stages:
        results.entries |= {
            "calibrations": {
                mode: [asdict(calibration) for calibration in one.calibrations_.values()]
                for mode, one in learned.items()
            },
            _VERDICTS: first_verdicts(
                scenario,
                learned,
                seed=int(results.entries["seed"]),
                progress=partial(stages, "first fresh episodes"),
            ),
        }
    folder = into / scenario.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in files.values():
        shutil.copyfile(file, folder / file.name)
    results.write(folder / EVALUATION_FILE)
    (folder / CARD_FILE).write_text(card_text(folder, scenario), encoding="utf-8")
    say("shipped", folder)


def evaluated(folder: Path) -> Results:
    """The evaluation in the folder of a training and its studies, as they are published.

    Absolute paths of folders in commands are replaced by ``runs/NAME``.
    """
    file = folder / EVALUATION_FILE
    if not file.is_file():
        raise ValueError(
            f"{folder} holds no evaluation to store: `drake-safety evaluate` makes one"
        )
    results = Results.read(file)
    rows, entries = dict(results), results.entries
    for name in _STUDIES:
        if (folder / f"{name}.json").is_file():
            studied = Results.read(folder / f"{name}.json")
            rows |= studied
            entries[name] = studied.entries | {"command": _portable(studied.entries["command"])}
    entries["command"] = _portable(entries["command"])
    try:
        entries["train_command"] = _portable(read_info(episodes_folder(folder))[1]["command"])
    except (ValueError, OSError, KeyError):
        pass  # The results do not need the training episodes.
    return Results(rows, entries)


def _portable(command: str) -> str:
    # A resumed training equals a single one.
    words = [word for word in shlex.split(command) if word != "--resume"]
    for i, word in enumerate(words):
        option, equals, value = word.partition("=")
        if equals and option in _FOLDER_OPTIONS and Path(value).is_absolute():
            words[i] = f"{option}=runs/{Path(value).name}"
        elif i and words[i - 1] in _FOLDER_OPTIONS and Path(word).is_absolute():
            words[i] = f"runs/{Path(word).name}"
    return shlex.join(words)


def check_shipped(folder: Path, scenario: Scenario, *, num_workers: int | None = None) -> Results:
    """Checks that shipped assessments match their stored evaluation.

    Simulates the first fresh episodes of the evaluation again.

    Returns:
        Results of the evaluation.
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
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Simulates the first fresh episodes of a seed, with their verdicts at k = 0.

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
        **scenario.options_for("evaluation"),
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
    modes = [key for key, value in now.items() if isinstance(value, Mapping)]
    if before.keys() != now.keys() or any(before[k] != now[k] for k in now if k not in modes):
        return False
    pairs = [(before[mode], now[mode]) for mode in modes]
    apart = [abs(one["safety_probability"] - two["safety_probability"]) for one, two in pairs]
    is_same = all(one["verdict"] == two["verdict"] for one, two in pairs)
    return is_same and max(apart, default=0.0) <= _TOLERANCE
