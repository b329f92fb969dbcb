"""``python -m studies scale``: what learning costs, and what approximate neighbours lose."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import (
    ScenarioArgument,
    TrainingOption,
    WorkersOption,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import MODES, episodes_folder, run_fresh_episodes
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.metrics import Estimate, auc, auc_difference
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.learning.training import segments_for
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.scenario import load_scenario
from studies import command_line
from studies.learning_curve import parse_sizes
from studies.scale_figure import STAGES, scale_figure

SCALE_FILE = "scale.json"


def scale(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    sizes: Annotated[
        str, typer.Option(help="Numbers of segments.")
    ] = "5000,20000,50000,100000,200000",
    exact: Annotated[str, typer.Option(help="Those learned with exact neighbours too.")] = "",
    mode: Annotated[str, typer.Option(help="The mode.")] = "paper",
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes for the AUC.")] = 600,
    seed: Annotated[int, typer.Option(help="First seed of the fresh ones.")] = EVALUATION.first,
    workers: WorkersOption = None,
) -> None:
    """Learn from more and more segments: CPU time by stage, peak memory, size of the file, AUC.

    Every size is learned in a fresh process from the first episodes of ASSESSMENT that have so many
    segments. Adds to ASSESSMENT/scale.json, and draws it; a stopped study continues.
    """
    if mode not in MODES:
        raise ValueError(f"scale: mode must be one of {list(MODES)}; got '{mode}'")
    loaded = load_scenario(scenario)
    parameters = dataclasses.replace(loaded.assessment, mode=mode)
    path = episodes_folder(assessment, mode)
    wanted = [(size, False) for size in parse_sizes(sizes)]
    wanted += [(size, True) for size in parse_sizes(exact)]
    counts = counts_for({size for size, _ in wanted}, load_episodes(path), parameters)
    file = assessment / SCALE_FILE
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"] if file.is_file() else {}
    with open_stages() as stages:
        fresh = run_fresh_episodes(
            loaded, assessment, episodes, seed, partial(stages, "fresh nominal episodes"), workers
        )
        for done, (size, is_exact) in enumerate(wanted):
            stages("sizes", done, len(wanted))
            key = f"{mode} {size}{' exact' if is_exact else ''}"
            if key not in rows:
                row = _in_fresh_process(parameters, path, counts[size], is_exact, fresh)
                rows[key] = {"mode": mode, "is_exact": is_exact, **row}
                _write(file, loaded.name, seed, rows)
        stages("sizes", len(wanted), len(wanted))
    chosen = {key: row for key, row in rows.items() if row["mode"] == mode}
    segments = split(fresh, stride=1, discount=1.0)
    table = new_table("segments", "episodes", *STAGES, "ms each", "GB", "file, MB", "AUC", "k = 0")
    for row in sorted(chosen.values(), key=lambda row: (row["segments"], row["is_exact"])):
        cpu_s = row["cpu_s"]
        table.add_row(
            f"{row['segments']}{' (exact)' if row['is_exact'] else ''}",
            f"{row['episodes']}",
            *(f"{cpu_s[stage]:.0f}" for stage in STAGES),
            f"{1e3 * sum(cpu_s.values()) / row['segments']:.1f}",
            f"{row['peak_gb']:.2f}",
            f"{row['file_mb']:.1f}",
            *(interval(one) for one in _areas(segments, np.array(row["score"]))),
        )
    console.print(table)
    for key, row in chosen.items():
        other = chosen.get(key.removesuffix(" exact"))
        if row["is_exact"] and other is not None:
            for what, part in (("segments", slice(None)), ("k = 0", segments.is_first)):
                found = auc_difference(
                    np.array(other["score"])[part],
                    np.array(row["score"])[part],
                    segments.is_unsafe[part],
                    segments.episode[part],
                )
                console.print(f"{row['segments']}, {what}: AUC - exact AUC {interval(found)}")
    print_path("figures", file)
    for picture in save(scale_figure(list(chosen.values())), assessment / f"scale_{mode}"):
        print_path("picture", picture)


def counts_for(
    sizes: set[int], episodes: Episodes, parameters: AssessmentParameters
) -> dict[int, int]:
    """The number of first episodes that have so many segments, by size.

    Args:
        sizes: Numbers of segments.
        episodes: The training episodes.
        parameters: Parameters of the assessment.

    Raises:
        ValueError: There are fewer segments.
    """
    per_episode = np.bincount(segments_for(episodes, parameters)[0].episode)
    total = np.cumsum(per_episode)
    misfits = sorted(size for size in sizes if not 1 <= size <= total[-1])
    if misfits:
        raise ValueError(
            f"scale: the {len(episodes)} episodes of '{episodes.info.scenario}' have {total[-1]} "
            f"segments; got sizes {misfits}"
        )
    return {size: int(np.searchsorted(total, size)) + 1 for size in sizes}


def _areas(segments: Segments, score: np.ndarray) -> list[Estimate]:
    return [
        auc(score[part], segments.is_unsafe[part], segments.episode[part])
        for part in (slice(None), segments.is_first)
    ]


def _write(file: Path, scenario: str, seed: int, rows: dict[str, Any]) -> None:
    report = {
        "command": command_line(),
        "scenario": scenario,
        "seed": seed,
        "versions": versions(),
        "rows": rows,
    }
    file.write_text(json.dumps(report) + "\n", encoding="utf-8")


def _in_fresh_process(*arguments: Any) -> dict[str, Any]:
    # Peak memory is that of a process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(learned_row, *arguments).result()


def learned_row(
    parameters: AssessmentParameters, path: Path, count: int, is_exact: bool, fresh: Episodes
) -> dict[str, Any]:
    """Learns from the first episodes of a folder, and judges fresh ones.

    Args:
        parameters: Parameters of the assessment.
        path: The folder.
        count: Number of episodes.
        is_exact: Whether all pairs of segments are compared.
        fresh: Fresh episodes.

    Returns:
        "segments", "episodes", "cpu_s" by stage, "peak_gb" of this process, "file_mb", and
        "score", the unsafe score of every segment of the fresh episodes.
    """
    if is_exact:
        parameters = dataclasses.replace(parameters, candidates_per_neighbour=0)
    training = load_episodes(path)[:count]
    cpu_s = dict.fromkeys(STAGES, 0.0)
    last = time.process_time()

    def progress(stage: str, done: int, wanted: int) -> None:
        nonlocal last
        now = time.process_time()
        cpu_s[stage if stage in cpu_s else STAGES[-1]] += now - last
        last = now

    learned = SafetyAssessment(parameters).fit(training, progress)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "assessment.safetensors"
        learned.save(file)
        size = file.stat().st_size
    peak = next(
        line.split()[1]
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        if line.startswith("VmHWM")
    )
    scorer = assessment_scorer(parameters.mode, learned)
    return {
        "segments": len(segments_for(training, parameters)[0]),
        "episodes": count,
        "cpu_s": cpu_s,
        "peak_gb": int(peak) / 1024**2,
        "file_mb": size / 1e6,
        "score": scorer.unsafe_score(split(fresh, stride=1, discount=1.0)).round(6).tolist(),
    }
