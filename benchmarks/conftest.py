"""Results of the benchmarks, with limits and peers, in one table at the end."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from drake_safety import Scenario, load_scenario, run_episodes
from drake_safety.simulation.dataset import completed, read_info

SCENARIO = "laikago_balancing"


@dataclass(kw_only=True)
class Figure:
    """A measured value with its limit and the values of peers."""

    name: str
    value: float
    unit: str
    at_most: float | None = None
    at_least: float | None = None
    peers: dict[str, float] = field(default_factory=dict)
    note: str = ""

    @property
    def verdict(self) -> str:
        if self.at_most is not None and self.value > self.at_most:
            return "OVER THE LIMIT"
        if self.at_least is not None and self.value < self.at_least:
            return "UNDER THE LIMIT"
        return "" if self.at_most is None and self.at_least is None else "OK"

    @property
    def limit(self) -> str:
        if self.at_most is not None:
            return f"<= {self.at_most:g}"
        return "" if self.at_least is None else f">= {self.at_least:g}"


FIGURES = pytest.StashKey[list[Figure]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("drake_safety")
    group.addoption(
        "--episodes",
        type=Path,
        help="Folder of nominal episodes to train on. By default runs/laikago/episodes where it "
        "fits the scenario, else a set that is simulated once and kept in pytest's cache.",
    )
    group.addoption("--num-episodes", type=int, default=2048, help="Nominal episodes to train on.")
    group.addoption(
        "--reference-episodes",
        type=int,
        default=100,
        help="Episodes that are simulated again in finer steps, some 4 CPU seconds each.",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[FIGURES] = []


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    figures = config.stash[FIGURES]
    if not figures:
        return
    rows = [("figure", "value", "limit", "", "beside it")]
    for figure in figures:
        peers = [f"{name} {value:.4g}" for name, value in figure.peers.items()]
        beside = ", ".join([*peers, figure.note] if figure.note else peers)
        rows.append(
            (
                figure.name,
                f"{figure.value:.4g} {figure.unit}",
                figure.limit,
                figure.verdict,
                beside,
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    terminalreporter.section("figures and their limits")
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        terminalreporter.write_line("  ".join(cells).rstrip())


@pytest.fixture
def report(
    request: pytest.FixtureRequest,
    benchmark: Any,  # pytest-benchmark has no types.
) -> Callable[..., None]:
    """Keeps a `Figure`, given as its fields, for the table and in the benchmark's extra_info."""

    def keep(name: str, value: float, unit: str, **fields: Any) -> None:
        figure = Figure(name=name, value=float(value), unit=unit, **fields)
        request.config.stash[FIGURES].append(figure)
        benchmark.extra_info[name] = {**asdict(figure), "verdict": figure.verdict}

    return keep


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return load_scenario(SCENARIO)


@pytest.fixture(scope="session")
def episodes_folder(pytestconfig: pytest.Config, scenario: Scenario) -> Iterator[Path]:
    """A folder with at least the given number of nominal episodes of the scenario."""
    wanted = pytestconfig.getoption("num_episodes")
    chosen = pytestconfig.getoption("episodes")
    folder = chosen or pytestconfig.rootpath / "runs" / "laikago" / "episodes"
    if not _fits(folder, scenario, wanted):
        if chosen is not None:
            raise pytest.UsageError(
                f"--episodes {chosen} does not hold {wanted} nominal episodes of '{SCENARIO}' as "
                "the scenario is now"
            )
        name = f"{SCENARIO}-{scenario.simulation_hash()[:16]}"
        folder = pytestconfig.cache.mkdir("episodes") / name
        run_episodes(scenario, wanted, path=folder)
    yield folder


def _fits(folder: Path, scenario: Scenario, wanted: int) -> bool:
    if not (folder / "info.json").is_file():
        return False
    info, _ = read_info(folder)
    return (
        info.scenario_hash == scenario.simulation_hash()
        and info.variation == "nominal"
        and completed(folder) >= set(range(wanted))
    )
