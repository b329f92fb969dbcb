"""Check of a closed loop's contract: its ports, their sizes, and finite values."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_safety.simulation.closed_loop import REQUIRED_PORTS, ClosedLoop, check_ports
from drake_safety.simulation.motion import advance_to


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of a check."""

    item: str
    is_ok: bool
    message: str
    remedy: str = ""  # How to correct a failure, or what a warning is about.

    @property
    def is_warning(self) -> bool:
        """Whether the check passed, but something should be known or done."""
        return self.is_ok and bool(self.remedy)


def passed(item: str, message: str, remedy: str = "") -> Finding:
    """A finding without a problem; a warning if there is a remedy."""
    return Finding(item=item, is_ok=True, message=message, remedy=remedy)


def failed(item: str, message: str, remedy: str) -> Finding:
    """A finding of a problem."""
    return Finding(item=item, is_ok=False, message=message, remedy=remedy)


def check_contract(diagram: ClosedLoop, *, seed: int = 0) -> list[Finding]:
    """Checks a task's ports and names, its `reset`, and the ports' values over one step.

    Example: ``problems = [one for one in check_contract(loop) if not one.is_ok]``
    """
    findings = []
    item, remedy = "ports", "set the names and export the ports in __init__; one name per entry"
    try:
        check_ports(diagram)
        findings.append(passed(item, "complete, with the sizes of their names"))
        item, remedy = "reset", "reset(context, rng) samples a start and a plan into the Context"
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        first_step: object = diagram.reset(context, np.random.default_rng(seed))
        if isinstance(first_step, int | np.integer):
            findings.append(passed(item, "samples a start"))
        else:
            remedy = "return the first step whose future is undisturbed, mostly 0"
            findings.append(failed(item, f"returns {first_step!r}", remedy))
        item, remedy = "simulation", "correct the system named"
        begin_s, step_s = context.get_time(), diagram.scenario.step_s
        simulator.Initialize()
        findings.append(_finite(diagram, context, "at the start"))
        if advance_to(simulator, begin_s + step_s):
            ended = "let an episode last: no system may return EventStatus.ReachedTermination yet"
            findings.append(failed(item, f"ends at {context.get_time():g} s", ended))
        findings.append(_finite(diagram, context, f"after {step_s:g} s"))
    except (RuntimeError, TypeError, ValueError) as error:
        findings.append(failed(item, str(error), remedy))
    return findings


def _finite(diagram: ClosedLoop, context: Context, when: str) -> Finding:
    values = {name: diagram.GetOutputPort(name).Eval(context) for name in REQUIRED_PORTS}
    if wrong := [name for name, value in values.items() if not np.isfinite(value).all()]:
        remedy = "look for a division by zero, or a state that reset does not set"
        return failed(f"values {when}", f"ports {wrong} are not finite", remedy)
    return passed(f"values {when}", "finite")
