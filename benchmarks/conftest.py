"""Options, and the nominal episodes that several benchmarks use."""

from pathlib import Path

import figures
import pytest

from drake_safety import Scenario, load_scenario, run_episodes
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.dataset import completed, load_episodes, read_info

SCENARIO = "laikago_balancing"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("drake_safety")
    group.addoption(
        "--episodes",
        type=Path,
        help="Folder of nominal episodes to train on. By default runs/laikago/episodes where it "
        "fits the scenario, else a set that is simulated once and kept in pytest's cache.",
    )
    group.addoption(
        "--num-episodes",
        type=int,
        default=512,
        help="Nominal episodes to train on, 512 by default; the assessments that ship learn from "
        "2048.",
    )
    group.addoption(
        "--num-segments",
        type=int,
        default=2000,
        help="Segments for DTW and t-SNE beside their peers, which need 5 minutes and 1.5 GB for "
        "10000; 2000 by default.",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(figures)


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return load_scenario(SCENARIO)


@pytest.fixture(scope="session")
def num_episodes(pytestconfig: pytest.Config) -> int:
    return pytestconfig.getoption("num_episodes")


@pytest.fixture(scope="session")
def episodes_folder(pytestconfig: pytest.Config, scenario: Scenario, num_episodes: int) -> Path:
    """A folder with at least the given number of nominal episodes of the scenario."""
    chosen = pytestconfig.getoption("episodes")
    folder = chosen or pytestconfig.rootpath / "runs" / "laikago" / "episodes"
    if not _fits(folder, scenario, num_episodes):
        if chosen is not None:
            raise pytest.UsageError(
                f"--episodes {chosen} does not hold {num_episodes} nominal episodes of "
                f"'{SCENARIO}' as the scenario is now"
            )
        name = f"{SCENARIO}-{scenario.simulation_hash()[:16]}"
        folder = pytestconfig.cache.mkdir("episodes") / name
        run_episodes(scenario, num_episodes, path=folder)
    return folder


@pytest.fixture(scope="session")
def episodes(episodes_folder: Path, num_episodes: int) -> Episodes:
    """The nominal episodes."""
    return load_episodes(episodes_folder)[:num_episodes]


def _fits(folder: Path, scenario: Scenario, wanted: int) -> bool:
    if not (folder / "info.json").is_file():
        return False
    info, _ = read_info(folder)
    return (
        info.scenario_hash == scenario.simulation_hash()
        and info.variation == "nominal"
        and completed(folder) >= set(range(wanted))
    )
