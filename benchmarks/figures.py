"""A plugin of pytest: the results of all benchmarks as one table, and as JSON.

A benchmark reports its results by the fixture `report`. The table is printed at the end; the JSON
of pytest-benchmark (``--benchmark-json``), which has the machine, the date and the commit, holds
the same rows under ``figures``.
"""

import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

import pytest

PACKAGES = (
    "drake_safety",
    "drake",
    "numpy",
    "scipy",
    "torch",
    "daqp",
    "dtaidistance",
    "openTSNE",
    "pyarrow",
    "scikit-learn",
    "tslearn",
)


@dataclass(kw_only=True)
class Figure:
    """A measured value with its limits and the values of peers in the same run.

    Attributes:
        unit: Of the value; "x" for a ratio.
        peers: What others need, or what the value is made of; runs are compared by the first.
    """

    name: str
    value: float
    unit: str
    at_most: float | None = None
    at_least: float | None = None
    peers: dict[str, float] = field(default_factory=dict)
    note: str = ""

    @property
    def verdict(self) -> str:
        if self.at_most is None and self.at_least is None:
            return ""
        # Written so that a NaN is within no limit.
        if self.at_most is not None and not self.value <= self.at_most:
            return "OVER THE LIMIT"
        if self.at_least is not None and not self.value >= self.at_least:
            return "UNDER THE LIMIT"
        return "OK"

    @property
    def limit(self) -> str:
        if self.at_most is not None:
            return f"<= {self.at_most:.4g}"
        return "" if self.at_least is None else f">= {self.at_least:.4g}"

    def row(self) -> dict[str, Any]:
        """Everything, as JSON types."""
        return {**asdict(self), "limit": self.limit, "verdict": self.verdict}


FIGURES = pytest.StashKey[list[Figure]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[FIGURES] = []


@pytest.fixture
def report(pytestconfig: pytest.Config) -> Callable[..., None]:
    """Keeps a `Figure`, given as its fields."""
    figures = pytestconfig.stash[FIGURES]

    def keep(name: str, value: float, unit: str, **fields: Any) -> None:
        if name in {figure.name for figure in figures}:
            raise ValueError(f"report: there is a figure '{name}' already; names must differ")
        peers = {peer: float(cost) for peer, cost in fields.pop("peers", {}).items()}
        figures.append(Figure(name=name, value=float(value), unit=unit, peers=peers, **fields))

    return keep


def pytest_benchmark_update_machine_info(machine_info: dict[str, Any]) -> None:
    machine_info["packages"] = {package: version(package) for package in PACKAGES}


def pytest_benchmark_update_json(config: pytest.Config, output_json: dict[str, Any]) -> None:
    output_json["figures"] = [figure.row() for figure in config.stash[FIGURES]]


# Last, so that the path stands below the table wherever pytest-benchmark prints its own lines.
@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    figures = config.stash[FIGURES]
    if not figures:
        return
    terminalreporter.section("figures")
    for line in table(figures):
        terminalreporter.write_line(line)
    outside = sum(figure.verdict not in ("", "OK") for figure in figures)
    limits = sum(bool(figure.verdict) for figure in figures)
    terminalreporter.write_line(
        f"{limits - outside} of {limits} within their limits; Python {platform.python_version()}, "
        f"Drake {version('drake')}"
    )
    path = config.getoption("benchmark_json", None)
    if path:
        terminalreporter.write_line(f"stored in {path}")


def table(figures: list[Figure]) -> list[str]:
    """The lines of a table, headings first."""
    rows = [("figure", "value", "limit", "", "peers", "note")]
    for figure in figures:
        peers = ", ".join(f"{name} {value:.4g}" for name, value in figure.peers.items())
        value = f"{figure.value:.4g} {figure.unit}"
        rows.append((figure.name, value, figure.limit, figure.verdict, peers, figure.note))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
