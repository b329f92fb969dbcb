"""Γ and its monitor as C: cost of a call, and what it says beside `predict` and the detector."""

import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from costs import alternate

from drake_safety import SafetyAssessment, load_scenario
from drake_safety.assessments import assessed_scenarios, load_assessment
from drake_safety.evaluation.shifts import plant_shifts
from drake_safety.learning.change_detector import rows_of
from drake_safety.simulation.rollouts import run_motion, worker_loop

PORTS = ("state", "desired_preview", "features")
NUM_MOTIONS, DURATION_S = 20, 5.0
NUM_ROWS, NUM_CALLS = 10_000, 100_000
SINGLE = 2e-5
SEED = 31


def faulty_motions(name: str) -> list[np.ndarray]:
    """Motions on changed plants and with faulty sensors, rows (state, preview, features)."""
    scenario = load_scenario(name)
    shifts = plant_shifts(scenario, scenario.make_loop())
    names = [one for one in shifts if not one.startswith("variation")][:NUM_MOTIONS]
    motions = []
    for one in names:
        shifted = scenario.with_variation(one, shifts[one].variation)
        loop = worker_loop(shifted, one, **shifts[one].options)()
        motion = run_motion(loop, seed=SEED, until_s=DURATION_S, with_features=True)
        motions.append(rows_of(motion))
    return motions


def unlike_training(assessment: SafetyAssessment, num: int) -> np.ndarray:
    """Rows ever farther from training, a tenth of which are not finite."""
    rng, known = np.random.default_rng(SEED), assessment.novelty_.training
    x = rng.multivariate_normal(known.mean, known.covariance, size=num, method="eigh")
    x = known.mean + rng.choice([0.5, 1.0, 2.0, 100.0], size=(num, 1)) * (x - known.mean)
    odd, num_states = rng.choice(num, num // 10, replace=False), len(assessment.info_.state_names)
    x[odd, rng.integers(num_states, size=len(odd))] = rng.choice([np.nan, np.inf], size=len(odd))
    return x[:, : sum(assessment.info_.widths[port] for port in PORTS)]


def built(assessment: SafetyAssessment, folder: Path) -> tuple[float, float]:
    """Writes and compiles; returns the size of the source [MB] and the time of gcc [s]."""
    source, *_ = assessment.to_c(folder / "gamma.c")
    shutil.copy(Path(__file__).with_name("c_calls.c"), folder)
    started = time.perf_counter()
    options = "-std=c99 -O3 -Wall -Wextra -Werror c_calls.c gamma.c -lm -o calls"
    subprocess.run(["gcc", *options.split()], cwd=folder, check=True)
    return source.stat().st_size / 1e6, time.perf_counter() - started


def called(rows: np.ndarray, num_causes: int, folder: Path) -> np.ndarray:
    """Belief, probability, alarm, and times of both calls [us], a row each."""
    checks = np.zeros((len(rows), num_causes + 1))  # Margins and hold.
    np.concatenate([rows, checks], axis=1).tofile(folder / "in")
    subprocess.run([folder / "calls", "in", "out"], cwd=folder, check=True)
    return np.fromfile(folder / "out").reshape(-1, 7)


def watched(assessment: SafetyAssessment, rows: np.ndarray) -> np.ndarray:
    alarm = np.zeros(len(rows))
    for one in assessment.detector_.watch([rows], assessment.info_.state_names)[1]:
        alarm[one.begin : one.end] = 1.0
    return alarm


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
@pytest.mark.parametrize("name", assessed_scenarios())
def test_c_call(benchmark: Any, report: Callable[..., None], tmp_path: Path, name: str) -> None:
    pytest.importorskip("emx_onnx_cgen", reason="the extra 'c' is not installed")
    assessment = load_assessment(name)
    info, num_causes = assessment.info_, len(assessment.info_.constraint_names)
    size_mb, compile_s = built(assessment, tmp_path)
    motions = faulty_motions(name)
    alarms = [called(one, num_causes, tmp_path)[:, 4] for one in motions]
    expected = [watched(assessment, one) for one in motions]
    same = sum(np.array_equal(*pair) for pair in zip(alarms, expected, strict=True))
    num_alarmed = sum(bool(one.any()) for one in expected)

    rows = np.concatenate(motions)[: NUM_ROWS // 2]
    rows = np.concatenate([rows, unlike_training(assessment, NUM_ROWS - len(rows))])
    parts = np.split(rows, np.cumsum([info.widths[port] for port in PORTS])[:-1], axis=1)
    said, predicted = called(rows, num_causes, tmp_path), assessment.predict(*parts)
    difference = np.abs(said[:, 3] - predicted.probability).max()
    difference = max(difference, np.abs(said[:, :3] - predicted.belief).max())
    repeated = np.tile(rows, (NUM_CALLS // NUM_ROWS, 1))
    times = called(repeated, num_causes, tmp_path)[:, 5:]

    assessment.to_onnx(tmp_path / "gamma.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(tmp_path / "gamma.onnx"), options)
    row = {port: part[:1] for port, part in zip(PORTS, parts, strict=True)}
    one = [part[0] for part in parts]

    def repeat(function: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(1000):
                function()

        return run

    _, seconds = alternate(
        benchmark,
        lambda: None,
        {
            "predict_one": repeat(lambda: assessment.predict_one(*one)),
            "onnxruntime": repeat(lambda: session.run(None, row)),
        },
        rounds=5,
    )
    median, worst = np.median(times, axis=0), np.quantile(times, 0.9999, axis=0)
    report(
        f"C, {name}: a call of Γ",
        median[0],
        "us",
        peers={peer: 1e3 * value for peer, value in seconds.items()} | {"monitor": median[1]},
        note=f"1 in 10000 takes {worst[0]:.0f} and {worst[1]:.0f} us, the longest "
        f"{times[:, 0].max():.0f} and {times[:, 1].max():.0f}; source {size_mb:.1f} MB, "
        f"gcc -O3 {compile_s:.1f} s",
    )
    report(
        f"C, {name}: largest difference to `predict`",
        difference,
        "",
        at_most=SINGLE,
        note=f"{len(rows)} rows",
    )
    report(
        f"C, {name}: motions with the same alarms",
        same,
        "motions",
        at_least=len(motions),
        note=f"of {len(motions)}; {num_alarmed} have one",
    )
