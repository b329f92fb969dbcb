import json
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
THREE = """
def test_three(benchmark, report):
    benchmark.pedantic(lambda: None, rounds=1)
    report("tick, arm", 2.0, "us CPU", at_most=2.5, peers={"solver alone": 4.0}, note="7 joints")
    report("speed-up, arm", 1.7, "x", at_least=1.8, peers={"one worker": 3})
    report("memory, arm", 0.25, "GB")
"""


@pytest.fixture
def run_benchmarks(pytester, monkeypatch):
    """Runs a file of benchmarks with the table's plugin; returns pytest's result and the JSON."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    # In a worker of xdist, pytest-benchmark would measure nothing.
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)

    def run(source, *options):
        pytester.makepyfile(source)
        file = pytester.path / "bench.json"
        result = pytester.runpytest_inprocess(
            *("-p", "figures", "-p", "no:xdist", "-p", "no:cacheprovider"),
            *("--benchmark-only", "--benchmark-quiet", f"--benchmark-json={file}", *options),
        )
        return result, file

    return run


@pytest.mark.train
def test_one_table_says_values_limits_verdicts_and_peers_and_where_it_is_stored(run_benchmarks):
    result, file = run_benchmarks(THREE)
    result.assert_outcomes(passed=1)
    lines = [line for line in result.outlines if ", arm" in line]
    assert [line.split("  ")[0] for line in lines] == ["tick, arm", "speed-up, arm", "memory, arm"]
    tick, speed_up, memory = lines
    for part in ("2 us CPU", "<= 2.5", "OK", "solver alone 4", "7 joints"):
        assert part in tick
    for part in ("1.7 x", ">= 1.8", "UNDER THE LIMIT", "one worker 3"):
        assert part in speed_up
    assert "OK" not in memory and "LIMIT" not in memory
    printed = result.stdout.str()
    assert "1 of 2 within their limits" in printed and f"stored in {file}" in printed
    # pytest-benchmark's own table would be a second one.
    assert "StdDev" not in printed
    content = json.loads(file.read_text())
    assert content["datetime"] and content["commit_info"]["id"]
    assert content["machine_info"]["packages"]["drake"]
    tick, speed_up, memory = content["figures"]
    row = {"name": "tick, arm", "value": 2.0, "unit": "us CPU", "at_most": 2.5, "at_least": None}
    row |= {"peers": {"solver alone": 4.0}, "note": "7 joints", "limit": "<= 2.5", "verdict": "OK"}
    assert tick == row
    assert speed_up["verdict"] == "UNDER THE LIMIT" and memory["verdict"] == ""
