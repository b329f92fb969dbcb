"""Planning with Γ: selection of the safest of several candidate plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.planning.goal_verdict import inputs_of_each
from drake_safety.simulation.capabilities import OffersPlans, require
from drake_safety.simulation.closed_loop import ClosedLoop


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanChoice:
    """The chosen plan, by its index among the candidates, and the probability of all of them."""

    index: int
    probability: np.ndarray
    threshold: float

    @property
    def is_accepted(self) -> bool:
        """Whether the probability of the chosen plan reaches the threshold."""
        return bool(self.probability[self.index] >= self.threshold)


def plan_inputs(loop: ClosedLoop, context: Context, plans: Sequence[Any]) -> list[np.ndarray]:
    """State (M, n_s), desired preview (M, H n_z) and features (M, n_f) of M plans.

    The first of the plans is that of the Context, which keeps it.
    """
    set_plan = require(loop, OffersPlans).set_plan
    try:
        return inputs_of_each(loop, context, set_plan, plans)
    finally:
        set_plan(context, plans[0])


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
        context: In the state to plan from; the chosen plan is set in it.
        threshold: Lowest probability of an accepted plan; the best one is set also if it is lower.

    Raises:
        ValueError: The task's plans cannot be chosen.
    """
    offering = require(loop, OffersPlans)
    plans = offering.candidate_plans(context, rng, num_plans)
    probability = assessment.predict(*plan_inputs(loop, context, plans)).probability
    best = int(np.argmax(probability))  # The first of equals: the present plan, if any.
    offering.set_plan(context, plans[best])
    return PlanChoice(index=best, probability=probability, threshold=threshold)
