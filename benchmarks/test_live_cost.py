"""Real-time factor of the live sessions: simulation, Γ and drawing."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from drake_safety import load_assessment, load_scenario
from drake_safety.live.session import AXES, GO, TICK_S, LiveSession
from drake_safety.plants.balls import Throw
from drake_safety.simulation.closed_loop import ClosedLoop

DURATION_S, ROUNDS = 3.0, 3
BALL = Throw(mass_kg=3.0, speed_m_s=8.0, direction_rad=-1.3)  # Requires recovery steps.
TARGET = np.array([0.7, 0.3, 1.0])


def begin_throws(meshcat: Meshcat, scenario_name: str) -> tuple[ClosedLoop, LiveSession]:
    scenario = load_scenario(scenario_name)
    gamma = load_assessment(scenario_name)
    loop = scenario.make_loop("actual", assessment=gamma, meshcat=meshcat, ball=True)
    threshold = scenario.parameters.recovery.threshold
    session = LiveSession(loop, meshcat, threshold=threshold)
    loop.throw_ball(session.context, BALL, 0.2)
    return loop, session


def begin_goals(meshcat: Meshcat, scenario_name: str) -> tuple[ClosedLoop, LiveSession]:
    scenario = load_scenario(scenario_name)
    gamma = load_assessment(scenario_name)
    loop = scenario.make_loop("actual", assessment=gamma, meshcat=meshcat)
    session = LiveSession(loop, meshcat, threshold=gamma.calibrations_["plan"].threshold)
    for name, value in zip(AXES, TARGET, strict=True):
        session.panel.set_value(name, float(value))
    session.panel.click(GO)
    session.tick()
    return loop, session


@pytest.mark.parametrize(
    ("scenario_name", "begin"),
    [("laikago_balancing", begin_throws), ("atlas_reaching", begin_goals)],
)
def test_live_page_keeps_up_with_the_clock(
    benchmark: Any,
    report: Callable[..., None],
    scenario_name: str,
    begin: Callable[[Meshcat, str], tuple[ClosedLoop, LiveSession]],
) -> None:
    factors, bare_factors = [], []

    def run() -> None:
        meshcat = Meshcat()
        loop, session = begin(meshcat, scenario_name)
        start_s = session.context.get_time()
        # The same motion without the session.
        bare = Simulator(loop, session.context.Clone())
        start = time.perf_counter()
        bare.AdvanceTo(start_s + DURATION_S)
        bare_factors.append(DURATION_S / (time.perf_counter() - start))
        start = time.perf_counter()
        for _ in range(round(DURATION_S / TICK_S)):
            assert session.tick()
        factors.append(DURATION_S / (time.perf_counter() - start))

    benchmark.pedantic(run, rounds=ROUNDS)
    report(
        f"live page, real-time factor, {scenario_name}",
        np.median(factors),
        "x",
        at_least=1.0,
        peers={"without the session": float(np.median(bare_factors))},
        note=f"{DURATION_S:g} s of the actual plant, lowest of {ROUNDS}: {min(factors):.2f}",
    )
