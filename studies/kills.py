"""``python -m studies kills``: commands that are killed at random moments, and resumed."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import console, new_table, open_stages
from drake_safety.simulation.dataset import load_episodes

SCENARIO = """\
task: drake_safety.diagrams.pendulum:Pendulum
variations:
  nominal: {}
  actual: {mass_scale: 1.1}
assessment:
  {margin_unit: 0.1, margin_range: [-0.1, 0.5], epochs: 4, ensemble_size: 1, paper: {epochs: 4}}
"""
COMMANDS = {
    "train": "--episodes 240 --resume --out {folder}",
    "evaluate": "--episodes 200 --calibration-episodes 60 --no-baselines --assessment {folder}",
    "calibrate": "--episodes 300 --splits 0 --assessment {folder}",
    "adapt": "--feedback 80 --assessment {folder}",
}
KILLS = (
    ("main", signal.SIGKILL),
    ("main", signal.SIGTERM),
    ("main", signal.SIGINT),
    ("worker", signal.SIGKILL),
)
_WITHIN_S = 10.0
_VARYING = ("command", "versions", "created", "date")  # Entries of reports that may differ.


def kills(
    num_kills: Annotated[int, typer.Option("--kills", help="Kills of each command.", min=1)] = 20,
    only: Annotated[str, typer.Option(help="One command; all by default.")] = "",
    seed: Annotated[int, typer.Option(help="Seed of the moments.")] = 0,
) -> None:
    """Kill commands and their workers at random moments, resume them, and compare every file.

    Each must leave no process, temporary file or lock within 10 s, and resume to the same episodes,
    assessments and figures, bit for bit.
    """
    names = [only] if only else list(COMMANDS)
    for name in names:
        if name not in COMMANDS:
            raise ValueError(f"kills: no command '{name}'; they are {list(COMMANDS)}")
    rng = np.random.default_rng(seed)
    table = new_table("command", "killed", "signal", "after [s]", "exit", "left behind", "resumed")
    failures = 0
    with tempfile.TemporaryDirectory() as temporary, open_stages() as stages:
        root = Path(temporary)
        scenario = root / "kills.yaml"
        scenario.write_text(SCENARIO, encoding="utf-8")
        trained = root / "trained"
        _run(_command("train", scenario, trained))
        for name in names:
            reference = _copy(trained if name != "train" else None, root / f"{name}-reference")
            started = time.monotonic()
            _run(_command(name, scenario, reference))
            span_s = time.monotonic() - started
            expected = fingerprints(reference)
            for number in range(num_kills):
                stages(name, number, num_kills)
                folder = _copy(trained if name != "train" else None, root / "killed")
                whom, what = KILLS[number % len(KILLS)]
                after_s = float(rng.uniform(0.1, 1.0)) * span_s
                code, left = _killed(_command(name, scenario, folder), whom, what, after_s, folder)
                _run(_command(name, scenario, folder))
                is_same = fingerprints(folder) == expected
                failures += bool(left) or not is_same
                row = (name, whom, what.name, f"{after_s:.1f}", f"{code}")
                table.add_row(*row, left or "nothing", "same bits" if is_same else "DIFFERS")
            stages(name, num_kills, num_kills)
    console.print(table)
    console.print(f"{num_kills * len(names)} kills, {failures} with something amiss")
    if failures:
        raise typer.Exit(1)


def fingerprints(folder: Path) -> dict[str, str]:
    """SHA-256 of what the files of a run say, by name.

    Episodes count by their arrays, whatever their shards; figures without command and versions;
    pictures do not count.

    Args:
        folder: The folder.
    """
    found = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if file.suffix == ".safetensors":
            found[name] = hashlib.sha256(file.read_bytes()).hexdigest()
        elif file.name == "info.json":
            digest = hashlib.sha256()
            for episode in load_episodes(file.parent):
                for value in vars(episode).values():
                    is_array = isinstance(value, np.ndarray)
                    digest.update(value.tobytes() if is_array else repr(value).encode())
            found[str(file.parent.relative_to(folder))] = digest.hexdigest()
        elif file.suffix == ".json":
            text = json.dumps(_settled(json.loads(file.read_text(encoding="utf-8"))))
            found[name] = hashlib.sha256(text.encode()).hexdigest()
    return found


def _settled(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _settled(v) for name, v in content.items() if name not in _VARYING}
    return content


def _command(name: str, scenario: Path, folder: Path) -> list[str]:
    options = shlex.split(COMMANDS[name].format(folder=shlex.quote(str(folder))))
    program = [sys.executable, "-m", "drake_safety.cli"]
    return [*program, name, str(scenario), *options, "--workers", "2"]


def _copy(source: Path | None, target: Path) -> Path:
    shutil.rmtree(target, ignore_errors=True)
    if source is not None:
        shutil.copytree(source, target)
    return target


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"kills: {shlex.join(command)} failed: {done.stdout}{done.stderr}")


def _killed(
    command: Sequence[str], whom: str, what: signal.Signals, after_s: float, folder: Path
) -> tuple[int, str]:
    """Starts a command, kills it or a worker, and returns its exit code and what it left."""
    import psutil

    # A file: a pipe would be open as long as a worker that is left behind.
    log = folder.with_suffix(".log")
    with log.open("w", encoding="utf-8") as file:
        # A shell's background job ignores SIGINT, and so would what it starts.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    time.sleep(after_s)
    children: list[psutil.Process] = []
    try:
        children = psutil.Process(process.pid).children(recursive=True)
        workers = [one for one in children if "LokyProcess" in " ".join(one.cmdline())]
        victim = psutil.Process(process.pid) if whom == "main" or not workers else workers[0]
        victim.send_signal(what)
    except psutil.NoSuchProcess:
        pass  # It had finished.
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=_WITHIN_S)
    left = [f"process {one.pid}" for one in alive]
    for one in alive:
        one.kill()
    if "Traceback" in log.read_text(encoding="utf-8"):
        left.append("a traceback")
    # A killed process cannot tidy up: what it leaves is swept when its folder is opened again.
    if what != signal.SIGKILL:
        left += [str(file.relative_to(folder)) for file in folder.rglob(".*.tmp")]
    return process.returncode, ", ".join(left)
