"""CPU time, wall time and memory, measured so that they can be compared."""

import multiprocessing
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any


def alternate(
    benchmark: Any,  # pytest-benchmark has no types.
    ours: Callable[[], Any],
    peers: Mapping[str, Callable[[], Any]],
    *,
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> tuple[float, dict[str, float]]:
    """Seconds of a function, and of each peer, by a clock.

    They take turns, so that all meet the same state of the machine, and the quickest of the rounds
    counts: what else runs on the machine only ever adds. One turn of each goes before, uncounted.
    """
    peer_s: dict[str, list[float]] = {name: [] for name in peers}
    our_s: list[float] = []

    def measure(function: Callable[[], Any], seconds: list[float]) -> None:
        started = clock()
        function()
        seconds.append(clock() - started)

    def measure_peers() -> None:
        for name, function in peers.items():
            measure(function, peer_s[name])

    for function in (*peers.values(), ours):
        function()
    benchmark.pedantic(measure, args=(ours, our_s), setup=measure_peers, rounds=rounds)
    return min(our_s), {name: min(seconds) for name, seconds in peer_s.items()}


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function in a process of its own, whose peak memory is its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def peak_memory_gb() -> float:
    """Peak memory of this process."""
    # getrusage would count the parent's memory at the time of the fork.
    lines = Path("/proc/self/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    return int(fields["VmHWM"].split()[0]) / 1024**2
