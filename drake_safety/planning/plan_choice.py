"""Planning with Γ: selection of the safest of several candidate plans."""

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
    """The chosen plan, and the probability of all candidates.

    Attributes:
        index: Position of the chosen plan among the candidates.
        threshold: Lowest probability of an accepted plan.
    """

    index: int
    probability: np.ndarray
    threshold: float

    @property
    def is_accepted(self) -> bool:
        """Whether the probability of the chosen plan reaches the threshold."""
        return bool(self.probability[self.index] >= self.threshold)


def plan_inputs(
    loop: ClosedLoop, context: Context, plans: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The assessment's inputs for each plan, in the state of a Context.

    Args:
        context: Its Context; it keeps its plan.
        plans: M candidates, the first of them the plan of the Context.

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
    """Sets the plan with the highest probability; the present plan is one of the candidates.

    Args:
        context: Its Context, in the state to plan from; the chosen plan is set in it.
        threshold: Lowest probability of an accepted plan. If no candidate reaches it, the best
            one is set, and ``is_accepted`` is False.

    Raises:
        ValueError: The task's plans cannot be chosen.
    """
    offering = require(loop, OffersPlans)
    plans = offering.candidate_plans(context, rng, num_plans)
    state, preview, features = plan_inputs(loop, context, plans)
    probability = assessment.predict(state, preview, features).probability
    best = int(np.argmax(probability))  # The first of equals: the present plan, if any.
    offering.set_plan(context, plans[best])
    return PlanChoice(index=best, probability=probability, threshold=threshold)
