import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from cart_episodes import assert_identical
from drake_safety import load_scenario, run_episodes
from drake_safety.simulation.dataset import completed, load_episodes

NUM_EPISODES, WITHIN_S, PATIENCE_S = 1500, 10.0, 60.0


@pytest.fixture(autouse=True)
def answered_sigint():
    """SIGINT as in a terminal: a shell's background job ignores it, and so would its children."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def start(folder):
    """`drake-safety train` of the pendulum with two workers, once some episodes are on disk."""
    command = [sys.executable, "-m", "drake_safety.cli", "train", "pendulum", "--workers", "2"]
    command += ["--episodes", f"{NUM_EPISODES}", "--mode", "sharpened", "--out", str(folder)]
    process = subprocess.Popen(
        [*command, "--resume"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    wait_for(lambda: len(completed(folder / "episodes")) >= 64, 2 * PATIENCE_S)
    return process


def wait_for(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def workers_of(process):
    children = psutil.Process(process.pid).children(recursive=True)
    return [child for child in children if "popen_loky" in " ".join(child.cmdline())]


@pytest.fixture(scope="module")
def undisturbed():
    return run_episodes(load_scenario("pendulum"), 400, num_workers=2)


def assert_kept(folder, undisturbed):
    """What is on disk is right, and the set goes on from there, bit for bit."""
    kept = completed(folder)
    assert len(kept) >= 64
    if len(kept) < len(undisturbed):
        resumed = run_episodes(load_scenario("pendulum"), len(undisturbed), path=folder)
    else:
        resumed = load_episodes(folder)
    num = min(len(resumed), len(undisturbed))
    assert_identical(resumed[:num], undisturbed[:num])


@pytest.mark.train
@pytest.mark.parametrize(
    ("kill", "is_worker", "code", "said"),
    [
        (signal.SIGKILL, False, -signal.SIGKILL, []),
        (signal.SIGINT, False, 130, ["kept: the same command continues (train: with --resume)"]),
        (signal.SIGKILL, True, 2, ["a worker process was killed", "--resume"]),
    ],
)
def test_a_killed_command_leaves_no_process_and_resumes_exactly(
    kill, is_worker, code, said, tmp_path, undisturbed
):
    process = start(tmp_path)
    workers = workers_of(process)
    assert len(workers) == 2
    os.kill(workers[0].pid if is_worker else process.pid, kill)
    output = process.communicate(timeout=PATIENCE_S)[0]
    _, alive = psutil.wait_procs(workers, timeout=WITHIN_S)
    assert not alive and process.returncode == code
    assert all(words in output for words in said) and "Traceback" not in output
    assert_kept(tmp_path / "episodes", undisturbed)


def test_a_worker_whose_parent_ended_while_it_started_ends_at_once():
    code = (
        "import os\n"
        "from drake_safety.simulation.worker_processes import end_with_parent\n"
        "end_with_parent(os.getppid() + 1)\n"
        "print('goes on')"
    )
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (ended.returncode, ended.stdout) == (1, "")
