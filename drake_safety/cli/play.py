"""``drake-safety play``: throw balls, move targets, walk or watch, with Γ beside the scene."""

import contextlib
import secrets
import signal
import socket
import sys
from typing import Annotated

from typer import Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.training_folder import MODES
from drake_safety.diagrams.balancing.throws import HasBall
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.live.session import LiveSession
from drake_safety.planning.goal_verdict import goal_threshold
from drake_safety.simulation.capabilities import FollowsCommands, HasGoals

_FIRST_PORT = 7000


def play(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    hand: console.HandOption = None,
    variation: console.VariationOption = "nominal",
    recovery: console.RecoveryOption = None,
    seed: Annotated[int, Option(help="Seed of start and noise.")] = DEMONSTRATION.first,
    mode: console.ModeOption = MODES[0],
    mcap: console.McapOption = None,
    port: Annotated[int | None, Option(help="Port of the page; by default a free port.")] = None,
    host: Annotated[
        str, Option(help="Address that serves the page; everyone who reaches it has the controls.")
    ] = console.LOOPBACK,
) -> None:
    """Simulate a task on a page in the browser, in real time, until Stop or Ctrl-C."""
    from drake_safety.live.page import serve_page  # Needs the extra "live".

    loaded, _, gamma = folders.open_assessment(scenario, assessment, mode)
    options = console.given(hand=hand, recovery=recovery)
    task = loaded.make_loop(variation, assessment=gamma, **options)
    rule = goal_threshold(gamma)
    threshold = rule.threshold
    if isinstance(task, FollowsCommands):
        options["guard"], threshold = True, loaded.parameters.guard.threshold
    elif isinstance(task, HasBall) and not isinstance(task, HasGoals):
        options["ball"], threshold = True, loaded.parameters.recovery.threshold
    else:
        console.say(f"threshold {threshold:.3g}, {rule.origin}")
    page_port = _page_port(host, port)
    # The page forwards the scene, on Linux from one of millions of this machine's addresses.
    hidden = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    meshcat = console.open_viewer(hidden if sys.platform == "linux" else console.LOOPBACK)
    loop = loaded.make_loop(variation, assessment=gamma, meshcat=meshcat, **options)
    limits = {"threshold": threshold, "unsafe_below": rule.unsafe_below}
    with contextlib.ExitStack() as stack:
        monitor = stack.enter_context(console.recorded(loop, mcap))
        session = LiveSession(loop, meshcat, **limits, seed=seed, monitor=monitor)
        scene = meshcat.web_url()
        stack.enter_context(serve_page(session.panel, host=host, port=page_port, scene_url=scene))
        # An exception of a handler could be raised, and lost, inside Drake.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, session.end)
        console.say(f"live at http://{host}:{page_port}")
        console.say("Stop, on the page, or Ctrl-C ends")
        session.run()


def _page_port(host: str, port: int | None) -> int:
    """The port of the page, which is free."""
    for candidate in range(_FIRST_PORT, _FIRST_PORT + 200) if port is None else [port]:
        with contextlib.suppress(OSError, OverflowError):
            socket.create_server((host, candidate)).close()
            return candidate
    raise ValueError(
        f"no page can be served at {host}:{port or _FIRST_PORT}: this port is not free"
    )
