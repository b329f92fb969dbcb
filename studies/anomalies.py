"""``python -m studies anomalies``: the change monitor beside others on the protocol of RAPT.

Munn et al. (arXiv 2602.01515) judge a monitor by whole episodes of 20 s at 50 Hz: one half is
unperturbed, each of the others has one of 14 kinds of anomaly from 1 s on (`studies.injections`).
An episode's score is its largest level; that of an anomaly is the largest since its onset. Its end
is where the robot leaves the safe set; unperturbed ones that do are left out. The threshold is that
of 0.5 % of other unperturbed episodes.

All monitors see the columns of the change monitor. The others learn from nominal motion: a GRU
after RAPT, an isolation forest of rows, and a check of the range of each column.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    WorkersOption,
)
from drake_safety.cli.training_folder import MODES, assessment_folder
from drake_safety.evaluation.metrics import Estimate, auc, median, share
from drake_safety.learning.change_detector import ChangeDetector, rows_of, usual_rows
from drake_safety.learning.seeds import ANOMALIES, MOTION
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.capabilities import FollowsCommands, require
from drake_safety.simulation.rollouts import run_motions
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.worker_processes import Progress
from studies.alarms import equal_share_threshold
from studies.gru_monitor import GruMonitor
from studies.harness import CalibrationOption, ReleaseOption, Study, open_study
from studies.injections import (
    EPISODE_S,
    ONSET_S,
    PLANTS,
    SENSORS,
    drawn_change,
    drawn_fault,
    faulty,
    kind_of,
    run_changed,
)

FALSE_POSITIVES = 0.005
"""Share of the episodes for thresholds that are above them."""
UNPERTURBED, POOLED = "unperturbed", "pooled"
"""Rows of results beside the kinds: of "detected" they are the false positives, and all kinds."""
_NUM_TREES = 100
_LEAST_SPREAD = 1e-4  # Of a column [its unit].


def anomalies(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    episodes: Annotated[
        int, typer.Option(help="Unperturbed episodes; as many are perturbed.", min=14)
    ] = 280,
    calibration_episodes: CalibrationOption = 400,
    motion: Annotated[
        float, typer.Option(help="Motion of `train`, from which the others learn [min].", min=2.0)
    ] = 120.0,
    seed: Annotated[int, typer.Option(help="First of the seeds of motion.")] = ANOMALIES.first,
    release: ReleaseOption = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; that of ASSESSMENT by default.")
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Judge the change monitor on RAPT's 14 kinds of anomaly, beside a GRU and simpler monitors.

    For walking robots. Motion is kept in OUT/anomalies: a stopped study continues. Writes
    OUT/anomalies.json.
    """
    learned = assessment_folder(load_scenario(scenario), assessment)
    out = out or learned.out
    with open_study(
        "anomalies", scenario, learned.path, seed=seed, release=release, workers=workers, out=out
    ) as study:
        seeds = ANOMALIES.seeds(study.seed)
        detector = study.load(MODES[0], seeds.values()).detector_
        seeds["training"] = MOTION.first
        loop: Any = study.scenario.make_loop()
        require(loop, FollowsCommands, "anomalies")  # Its controller's memory can be handed over.
        drawn = partial(_motion, study, out / "anomalies", seeds)
        num = math.ceil(episodes / len(SENSORS | PLANTS))
        calm = drawn("unperturbed", episodes * EPISODE_S, EPISODE_S)
        other = drawn("thresholds", calibration_episodes * EPISODE_S, EPISODE_S)
        changed = run_changed(
            study.scenario,
            num * len(PLANTS),
            seed=seeds["perturbed"],
            path=_folder(study, out / "anomalies", seeds, "perturbed"),
            num_workers=workers,
            progress=partial(study.stages, "motion, perturbed"),
        )
        names = [loop.state_names[i] for i in detector.watched]
        seen = [Watched(UNPERTURBED, one.index, rows_of(one)) for one in calm if one.is_safe]
        seen += with_faults(seen, num, seeds["perturbed"], detector, names)
        for one in changed:
            change = drawn_change(loop, seeds["perturbed"], one.index)
            onset, group = round(ONSET_S / detector.step_s), len(calm) + one.index
            seen.append(Watched(kind_of(one.index), group, rows_of(one), onset, change.joints))
        training = [
            one[:, detector.columns] for one in usual_rows(drawn("training", 60.0 * motion))
        ]
        monitors = [
            Monitor("monitor", names, lambda x: detector.watch([x])[0], detector.alarm_level),
            *learned_monitors(training, detector.columns, names, partial(study.stages, "GRU")),
        ]
        calibration = [rows_of(one) for one in other if one.is_safe]
        for done, monitor in enumerate(monitors):
            study.stages("judging", done, len(monitors))
            for kind, found in judged(monitor, calibration, seen, detector.step_s).items():
                study.add(f"anomalies.{monitor.name}.{kind}", found)
        study.stages("judging", len(monitors), len(monitors))
        study.entries |= {
            "seeds": seeds,
            "motion_min": motion,
            "detector": detector.describe(),
            "thresholds": len(calibration),
            "left_out": sum(not one.is_safe for one in [*calm, *other]),
            "perturbed": sum(one.kind != UNPERTURBED for one in seen),
            "kinds": [POOLED, *SENSORS, *PLANTS, UNPERTURBED],
            "false_positives": FALSE_POSITIVES,
            "episode_s": EPISODE_S,
            "onset_s": ONSET_S,
        }


def _folder(study: Study, folder: Path, seeds: dict[str, int], purpose: str) -> Path:
    return folder / f"{study.scenario.simulation_hash()[:12]}-{seeds[purpose]}-{purpose}"


def _motion(
    study: Study,
    folder: Path,
    seeds: dict[str, int],
    purpose: str,
    duration_s: float,
    until_s: float = math.inf,
) -> Episodes:
    """Undisturbed motion of a purpose, which is kept."""
    return run_motions(
        study.scenario,
        duration_s,
        seed=seeds[purpose],
        until_s=until_s,
        num_workers=study.workers,
        path=_folder(study, folder, seeds, purpose),
        progress=partial(study.stages, f"motion, {purpose}"),
    )


@dataclass(frozen=True, eq=False)
class Watched:
    """An episode as monitors see it.

    Attributes:
        kind: Of the anomaly, or `UNPERTURBED`.
        group: The same for episodes of the same recording.
        rows: (state, desired preview, features), (K, n).
        onset: Row of the anomaly.
        truth: Names of faulty sensors or joints.
    """

    kind: str
    group: int
    rows: np.ndarray
    onset: int = 0
    truth: frozenset[str] = frozenset()


def with_faults(
    calm: Sequence[Watched], num: int, seed: int, detector: ChangeDetector, names: Sequence[str]
) -> list[Watched]:
    """The given number of faults of each kind of `SENSORS`, on recordings in turn.

    Args:
        calm: The recordings.
        seed: Seed of the faults.
        detector: Watches the sensors.
        names: Their names.
    """
    step_s, found = detector.step_s, []
    for i, kind in enumerate(kind for kind in SENSORS for _ in range(num)):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(i, 2)))
        recording, onset = calm[i % len(calm)], round(ONSET_S / step_s)
        which, value = drawn_fault(kind, len(names), rng)
        columns = detector.watched[which]
        rows = faulty(recording.rows, kind, columns, value, onset, step_s, rng)
        truth = frozenset(names[k] for k in which)
        found.append(Watched(kind, recording.group, rows, onset, truth))
    return found


@dataclass(frozen=True)
class Monitor:
    """A monitor.

    Attributes:
        names: Names of the sensors of its levels; "" for a level of none, (d,).
        levels: Maps rows (K, n) to levels (K, d).
        limit: Level above which it alarms by itself; NaN if it has none.
    """

    name: str
    names: Sequence[str]
    levels: Callable[[np.ndarray], np.ndarray]
    limit: float = math.nan


def learned_monitors(
    training: Sequence[np.ndarray],
    columns: np.ndarray,
    names: Sequence[str],
    progress: Progress | None = None,
) -> list[Monitor]:
    """GRU, isolation forest and range check.

    Args:
        training: What they see of motions, (K, n_u).
        columns: Places of it in rows, (n_u,).
        names: Names of the first ones, the measured states.
        progress: Called with the number of the GRU's steps done and wanted.
    """
    from sklearn.ensemble import IsolationForest

    gru = GruMonitor(training, len(names), progress)
    every = np.concatenate(training)
    forest = IsolationForest(n_estimators=_NUM_TREES, random_state=0).fit(every)
    low, high = every.min(axis=0), every.max(axis=0)
    width = np.maximum(high - low, _LEAST_SPREAD)

    def strangeness(rows: np.ndarray) -> np.ndarray:
        return -forest.score_samples(rows[:, columns])[:, None]

    def excess(rows: np.ndarray) -> np.ndarray:
        return np.maximum(low - rows[:, columns], rows[:, columns] - high) / width

    others = [""] * (len(columns) - len(names))
    return [
        Monitor("gru", [*names, ""], lambda rows: gru.levels(rows[:, columns]), 1.0),
        Monitor("isolation_forest", [""], strangeness),
        Monitor("range_check", [*names, *others], excess),
    ]


def judged(
    monitor: Monitor, calibration: Sequence[np.ndarray], episodes: Sequence[Watched], step_s: float
) -> dict[str, dict[str, Estimate]]:
    """What a monitor sees of each kind, of all, and of unperturbed episodes.

    Args:
        monitor: The monitor.
        calibration: Rows (K, n) of the unperturbed episodes for the threshold.
        episodes: Others, unperturbed and not.
        step_s: Time between two rows [s].

    Returns:
        By kind "auc"; "detected", the share above the threshold; "alarmed", that above the own
        limit; of those detected the median "delay_s", and where it is known what is faulty "named",
        the share in which the largest level is that of such a sensor, or one of such a joint.
    """
    largest = np.array([monitor.levels(rows).max() for rows in calibration])
    threshold = -equal_share_threshold(-largest, FALSE_POSITIVES)
    sights = [_seen(monitor, one, threshold) for one in episodes]
    kinds = np.array([one.kind for one in episodes])
    group = np.array([one.group for one in episodes])
    level = np.array([one.level for one in sights])
    delay_s = step_s * np.array([one.delay for one in sights])
    is_named = np.array([one.is_named for one in sights])
    has_truth = np.array([bool(one.truth) for one in episodes])
    is_anomaly, is_detected = kinds != UNPERTURBED, level > threshold
    found = {}
    for kind in (POOLED, *dict.fromkeys(kinds[is_anomaly].tolist()), UNPERTURBED):
        of_kind = is_anomaly if kind == POOLED else kinds == kind
        estimates = {"detected": share(is_detected[of_kind], group[of_kind])}
        if kind != UNPERTURBED:
            both = of_kind | ~is_anomaly
            area = auc(level[both], is_anomaly[both], group[both])
            estimates = {
                "auc": area,
                **estimates,
                "delay_s": median(delay_s[of_kind & is_detected]),
            }
            known = of_kind & is_detected & has_truth
            if known.any() and any(monitor.names):
                estimates["named"] = share(is_named[known], group[known])
        if not math.isnan(monitor.limit):
            estimates["alarmed"] = share(level[of_kind] > monitor.limit, group[of_kind])
        found[kind] = estimates
    return found


class _Sight(NamedTuple):
    level: float
    delay: float
    is_named: bool


def _seen(monitor: Monitor, episode: Watched, threshold: float) -> _Sight:
    """Largest level since the onset, rows until the threshold, and whether the truth is named."""
    levels = monitor.levels(episode.rows)[episode.onset :]
    largest = levels.max(axis=1)
    is_above = largest > threshold
    if not is_above.any():
        return _Sight(float(largest.max()), math.inf, False)
    first = int(np.argmax(is_above))
    name = monitor.names[int(np.argmax(levels[first]))]
    is_named = name in episode.truth or name.removesuffix("_rate") in {
        one.removesuffix("_rate") for one in episode.truth
    }
    return _Sight(float(largest.max()), float(first), is_named)
