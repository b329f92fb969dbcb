"""``drake-safety play``: throw balls, move targets, walk or watch, with Γ beside the scene."""

from __future__ import annotations

import contextlib
import socket
from typing import Annotated, Any

import typer

from drake_safety.cli.console import (
    LOOPBACK,
    AssessmentOption,
    HostOption,
    ScenarioArgument,
    console,
    open_viewer,
    print_shipped,
    warn_of_empty_scene,
)
from drake_safety.cli.targets import HandOption
from drake_safety.cli.training_folder import assessment_folder, goal_threshold, load_assessment
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.live.session import LiveSession
from drake_safety.simulation.capabilities import FollowsCommands, HasBall, HasGoals
from drake_safety.simulation.scenario import load_scenario

_FIRST_PORT = 7000


def play(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    hand: HandOption = None,
    variation: Annotated[str, typer.Option(help="Variation of the plant.")] = "actual",
    recovery: Annotated[
        bool | None, typer.Option("--recovery/--no-recovery", help="Recovery steps; on by default.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of start and noise.")] = DEMONSTRATION.first,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    port: Annotated[
        int | None,
        typer.Option(
            help="Of the page; the scene's is the next one. Free ones from 7000 on by default."
        ),
    ] = None,
    host: HostOption = LOOPBACK,
) -> None:
    """Simulate a task on a page in the browser, in real time, until Stop or Ctrl-C.

    Sliders and buttons throw a ball or move the target; keys walk a robot that follows commands,
    push it, and switch its guard. Any other task begins anew from random starts. Γ, belief and
    verdict are shown.
    """
    from drake_safety.live.page import serve_page  # Of the extra "live".

    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, assessment)
    gamma = load_assessment(folder.path, mode)
    given = {"hand": hand, "recovery": recovery}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    # Check the capabilities of the task before a browser is opened.
    asked = loaded.make_loop(variation, assessment=gamma, **options)
    rule = goal_threshold(folder.path, gamma)
    threshold = rule.threshold
    if isinstance(asked, FollowsCommands):
        options["guard"], threshold = True, loaded.parameters.guard.threshold
    elif isinstance(asked, HasBall) and not isinstance(asked, HasGoals):
        options["ball"], threshold = True, loaded.parameters.recovery.threshold
    print_shipped(folder, gamma)
    if not options.keys() & {"guard", "ball"}:
        told = f"threshold {threshold:.3g}, {rule.origin}"
        console.print(told, highlight=False, soft_wrap=True)
    page_port = _page_port(host, port)
    meshcat = open_viewer(host, page_port + 1, has_rate=False)
    loop = loaded.make_loop(variation, assessment=gamma, meshcat=meshcat, **options)
    session = LiveSession(
        loop, meshcat, threshold=threshold, unsafe_below=rule.unsafe_below, seed=seed
    )
    warn_of_empty_scene(meshcat, loaded.task)
    address = meshcat.web_url().rpartition(":")[0]
    with serve_page(session.panel, host=host, port=page_port, scene_port=meshcat.port()):
        console.print(f"live at {address}:{page_port}", highlight=False, soft_wrap=True)
        console.print("Stop, on the page, or Ctrl-C ends", highlight=False)
        with contextlib.suppress(KeyboardInterrupt):
            session.run()
    pace = session.pace
    if pace.simulated_s == 0.0:
        console.print("nothing was simulated", highlight=False)
        return
    console.print(
        f"real-time factor {pace.realtime_factor:.2f} over {pace.simulated_s:.1f} s simulated; "
        f"this machine could run it at {pace.possible_factor:.2f}",
        highlight=False,
    )


def _page_port(host: str, port: int | None) -> int:
    """The port of the page: it and the next one are free.

    Raises:
        ValueError: They are not.
    """
    asked = range(_FIRST_PORT, _FIRST_PORT + 200, 2) if port is None else [port]
    for candidate in asked:
        with contextlib.suppress(OSError, OverflowError):
            for one in (candidate, candidate + 1):
                socket.create_server((host, one)).close()
            return candidate
    raise ValueError(
        f"no page can be served at {host}:{asked[0]}: this port or the next one is not free"
    )
