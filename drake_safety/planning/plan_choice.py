"""Planning with Γ: of the plans that would do, the one that Γ takes to be safest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.capabilities import OffersPlans, require
from drake_safety.simulation.closed_loop import ClosedLoop

_INPUTS = ("state", "desired_preview", "features")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanChoice:
    """Which plan was chosen, and what Γ said of all.

    Attributes:
        index: Position of the chosen plan among the candidates.
        safety_probability: Γ, calibrated, of each candidate, (M,).
        threshold: From which Γ on a plan is accepted.
    """

    index: int
    safety_probability: np.ndarray
    threshold: float

    @property
    def is_accepted(self) -> bool:
        """Whether the chosen plan may be executed; if not, it takes another target."""
        return bool(self.safety_probability[self.index] >= self.threshold)


def plan_inputs(
    loop: ClosedLoop, context: Context, plans: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What an assessment judges each plan by, from the state that a Context is in.

    Args:
        loop: A closed loop whose plans can be chosen.
        context: Its Context; it keeps the plan that it has.
        plans: M candidates, the first of them the plan that the Context has.

    Returns:
        State (M, n_s), desired preview (M, H n_z) and features (M, n_f).
    """
    offering = require(loop, OffersPlans)
    ports = [loop.GetOutputPort(name) for name in _INPUTS]
    rows = []
    try:
        for plan in plans:
            offering.set_plan(context, plan)
            rows.append([port.Eval(context).copy() for port in ports])
    finally:
        offering.set_plan(context, plans[0])
    state, preview, features = (np.array(column) for column in zip(*rows, strict=True))
    return state, preview, features


def choose_plan(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    context: Context,
    *,
    threshold: float,
    rng: np.random.Generator,
    num_plans: int = 16,
) -> PlanChoice:
    """Sets the plan with the highest Γ; the one that the Context has is among the candidates.

    Args:
        loop: A closed loop whose plans can be chosen.
        assessment: What was learned from its episodes.
        context: Its Context, in the state to plan from; the chosen plan is set in it.
        threshold: From which Γ, calibrated, on a plan is accepted. If none is, the best is
            set all the same and the choice says so: it takes another target.
        rng: Source of the candidates.
        num_plans: How many candidates are judged at most.

    Raises:
        ValueError: The task's plans cannot be chosen.
    """
    offering = require(loop, OffersPlans)
    plans = offering.candidate_plans(context, rng, num_plans)
    state, preview, features = plan_inputs(loop, context, plans)
    said = assessment.predict(state, preview, features if assessment.uses_features else None)
    best = int(np.argmax(said.calibrated))  # Of equally good ones the first: no needless change.
    offering.set_plan(context, plans[best])
    return PlanChoice(index=best, safety_probability=said.calibrated, threshold=threshold)
