"""Time to a verdict on the command line, compared with starting Python and Drake alone."""

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
from costs import alternate

ROUNDS = 5
TARGETS = {"accepted": ("0.7", "0.3", "1.0"), "refused": ("0.9", "0.3", "1.2")}
EXIT_CODES = {"accepted": 0, "refused": 1}
MAX_S = {"accepted": 4.0, "refused": 4.0}
IMPORTS = "import pydrake.multibody.plant, pydrake.systems.analysis"


@pytest.mark.parametrize("verdict", list(TARGETS))
def test_ask_from_start_to_exit(benchmark: Any, report: Callable[..., None], verdict: str) -> None:
    def run(arguments: list[str], code: int = 0) -> Callable[[], None]:
        def start() -> None:
            process = subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
            assert process.returncode == code, process.stderr.decode()

        return start

    ask = ["-m", "drake_safety.cli", "ask", "atlas_reaching", "--target", *TARGETS[verdict]]
    wall_s, peers_s = alternate(
        benchmark,
        run(ask, EXIT_CODES[verdict]),
        {f"python -c '{IMPORTS}'": run(["-c", IMPORTS])},
        rounds=ROUNDS,
        clock=time.perf_counter,
    )
    report(
        f"ask, {verdict} target, atlas_reaching",
        wall_s,
        "s wall",
        at_most=MAX_S[verdict],
        peers=peers_s,
        note="whole process",
    )
