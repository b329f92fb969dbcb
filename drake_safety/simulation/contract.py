"""The contract of a closed loop, checked: which ports it has promised, how large, and finite."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.simulation.closed_loop import REQUIRED_PORTS, ClosedLoop, check_ports

_NAMES = ("state_names", "output_names", "feature_names", "constraint_names")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What was looked at, and what was found.

    Attributes:
        item: What was looked at.
        is_ok: Whether it is as it should be.
        message: What is so.
        remedy: How to mend it; empty when there is nothing to mend.
    """

    item: str
    is_ok: bool
    message: str
    remedy: str = ""


def check_contract(diagram: ClosedLoop, *, seed: int = 0) -> list[Finding]:
    """Checks that a task's diagram keeps the contract of :class:`ClosedLoop`.

    Its ports exist and have the sizes that its names promise, `reset` draws a start, and what the
    ports then say is finite, at the start and one assessment step later.

    Args:
        diagram: The closed loop.
        seed: Seed of the start that is drawn.

    Returns:
        A finding for each part; later parts are left out while an earlier one fails.
    """
    findings = [_names(diagram), _ports(diagram)]
    if not all(finding.is_ok for finding in findings):
        return findings
    return [*findings, *_values(diagram, seed)]


def _ports(diagram: ClosedLoop) -> Finding:
    try:
        check_ports(diagram)
    except ValueError as error:
        return Finding(
            item="ports",
            is_ok=False,
            message=str(error),
            remedy="call builder.ExportOutput(port, NAME) for each before finish(builder); one "
            "name an entry; the preview is H·n_z, row-major in time",
        )
    return Finding(item="ports", is_ok=True, message="all are there, as large as the names promise")


def _names(diagram: ClosedLoop) -> Finding:
    missing = [name for name in _NAMES if name not in vars(diagram)]
    return Finding(
        item="names",
        is_ok=not missing,
        message=f"task '{type(diagram).__name__}' does not set {missing}"
        if missing
        else "states, outputs, features and constraints have names",
        remedy="set them in __init__: lists of what the ports carry" if missing else "",
    )


def _values(diagram: ClosedLoop, seed: int) -> list[Finding]:
    from pydrake.systems.analysis import Simulator

    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    try:
        first_step = diagram.reset(context, np.random.default_rng(seed))
    except (RuntimeError, TypeError, ValueError) as error:
        return [
            Finding(
                item="reset",
                is_ok=False,
                message=str(error),
                remedy="reset(context, rng) draws a start and a plan into the Context",
            )
        ]
    is_step = isinstance(first_step, int | np.integer)
    findings = [
        Finding(
            item="reset",
            is_ok=is_step,
            message="draws a start" if is_step else f"returns {first_step!r}",
            remedy="" if is_step else "return the first step whose future is undisturbed, mostly 0",
        )
    ]
    step_s = diagram.scenario.step_s
    try:
        simulator.Initialize()
        findings.append(_finite(diagram, context, "at the start"))
        simulator.AdvanceTo(step_s)
        findings.append(_finite(diagram, context, f"after {step_s:g} s"))
    except (RuntimeError, TypeError, ValueError) as error:
        findings.append(
            Finding(
                item="simulation",
                is_ok=False,
                message=str(error),
                remedy="the system that is named raises it",
            )
        )
    return findings


def _finite(diagram: ClosedLoop, context: Context, when: str) -> Finding:
    wrong = [
        name
        for name in REQUIRED_PORTS
        if not np.isfinite(diagram.GetOutputPort(name).Eval(context)).all()
    ]
    return Finding(
        item=f"values {when}",
        is_ok=not wrong,
        message=f"ports {wrong} are not finite" if wrong else "finite",
        remedy="look for a division by zero, or a state that the reset did not set"
        if wrong
        else "",
    )
