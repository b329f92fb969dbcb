"""``python -m studies scale``: what learning costs, and what approximate neighbours lose."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption, versions
from drake_safety.cli.training_folder import MODES, episodes_folder
from drake_safety.evaluation.metrics import Estimate, auc
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.seeds import EVALUATION
from drake_safety.learning.segments import Episodes, Segments, split, training_segments
from drake_safety.simulation.dataset import load_episodes
from studies.baselines import auc_difference
from studies.harness import (
    Arrays,
    EpisodesOption,
    ReleaseOption,
    SeedOption,
    fingerprint,
    kept,
    open_study,
    parse_sizes,
)

STAGES = ("distances", "t-SNE", "training", "rest")
"""Stages of learning: those of `SafetyAssessment.fit`, the short ones together."""


def scale(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    sizes: Annotated[
        str, typer.Option(help="Numbers of segments.")
    ] = "5000,20000,50000,100000,200000",
    exact: Annotated[str, typer.Option(help="Those learned with exact neighbours too.")] = "",
    mode: Annotated[str, typer.Option(help="The mode.")] = "paper",
    episodes: EpisodesOption = 600,
    seed: SeedOption = EVALUATION.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Learn from more and more segments: CPU time by stage, peak memory, size of the file, AUC.

    Every size is learned in a fresh process from the first episodes of ASSESSMENT that have so many
    segments, and kept there: a stopped study continues. Writes ASSESSMENT/scale.json and its plot.
    """
    if mode not in MODES:
        raise ValueError(f"scale: mode must be one of {list(MODES)}; got '{mode}'")
    with open_study(
        "scale",
        scenario,
        assessment,
        seed=seed,
        release=release,
        workers=workers,
        plotted=lambda row: row.metric in ("ms a segment", "peak GB", "auc"),
    ) as study:
        parameters = replace(study.scenario.assessment, mode=mode)  # type: ignore[arg-type]
        path = episodes_folder(assessment, mode)
        training = load_episodes(path)
        methods = {"": parameters, " exact": replace(parameters, candidates_per_neighbour=0)}
        wanted = [(size, "") for size in parse_sizes(sizes)]
        wanted += [(size, " exact") for size in parse_sizes(exact)]
        counts = counts_for({size for size, _ in wanted}, training, parameters)
        fresh = study.fresh(episodes)
        rows = kept(
            assessment / f"scale/{fingerprint(parameters, training.info, fresh.info, versions())}",
            {
                f"{mode} {size}{which}": (methods[which], path, counts[size], fresh)
                for size, which in wanted
            },
            _in_fresh_process,
            workers=1,
            progress=lambda done, total: study.stages("sizes", done, total),
        )
        segments = split(fresh, stride=1, discount=1.0)
        for name, row in rows.items():
            study.add(f"costs.{name}", row_estimates(row))
            approximate = rows.get(name.removesuffix(" exact"), row)
            for set_, part in (("segments", slice(None)), ("k0", segments.is_first)):
                study.add(f"{set_}.{name}", _areas(segments, part, row, approximate))


def row_estimates(row: Arrays) -> dict[str, Estimate]:
    """What a size costs: CPU time by stage [s] and a segment [ms], peak memory, file [MB]."""
    num = int(row["segments"])
    costs = dict(zip((f"{stage} s" for stage in STAGES), row["cpu_s"], strict=True))
    costs |= {"ms a segment": 1e3 * row["cpu_s"].sum() / num, "segments": num}
    costs |= {"peak GB": row["peak_gb"], "file MB": row["file_mb"]}
    return {name: Estimate.exact(float(cost), int(row["episodes"])) for name, cost in costs.items()}


def _areas(segments: Segments, part: Any, row: Arrays, other: Arrays) -> dict[str, Estimate]:
    """AUC, and that with approximate neighbours minus it, where the row has exact ones."""
    truth = segments.is_unsafe[part], segments.episode[part]
    found = {"auc": auc(row["score"][part], *truth)}
    if other is not row:
        found["approximate minus exact"] = auc_difference(
            other["score"][part], row["score"][part], *truth
        )
    return found


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
    per_episode = np.bincount(training_segments(episodes, parameters).episode)
    total = np.cumsum(per_episode)
    misfits = sorted(size for size in sizes if not 1 <= size <= total[-1])
    if misfits:
        raise ValueError(
            f"scale: the {len(episodes)} episodes of '{episodes.info.scenario}' have {total[-1]} "
            f"segments; got sizes {misfits}"
        )
    return {size: int(np.searchsorted(total, size)) + 1 for size in sizes}


def _in_fresh_process(*arguments: Any) -> Arrays:
    # Peak memory is that of a process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(learned_row, *arguments).result()


def learned_row(
    parameters: AssessmentParameters, path: Path, count: int, fresh: Episodes
) -> Arrays:
    """Learns from the first episodes of a folder, and judges fresh ones.

    Args:
        parameters: Parameters of the assessment.
        path: The folder.
        count: Number of episodes.
        fresh: Fresh episodes.

    Returns:
        "segments", "episodes", "cpu_s" of the `STAGES`, "peak_gb" of this process, "file_mb", and
        "score", the unsafe score of every segment of the fresh episodes.
    """
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
    row = {
        "segments": len(training_segments(training, parameters)),
        "episodes": count,
        "cpu_s": list(cpu_s.values()),
        "peak_gb": int(peak) / 1024**2,
        "file_mb": size / 1e6,
        "score": scorer.unsafe_score(split(fresh, stride=1, discount=1.0)),
    }
    return {name: np.asarray(value) for name, value in row.items()}
