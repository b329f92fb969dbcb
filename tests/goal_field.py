"""Doubles for judging goals: a task whose input is its goal, and a Γ that is a given field."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from drake_safety.learning.assessment import Prediction

BOX = np.array([[0.0, -1.0, 0.0], [1.0, 1.0, 2.0]])


class GoalTask:
    """Offers what is asked of a loop whose plans have a goal; its state is the goal."""

    target_box = BOX
    named_targets: ClassVar[dict] = {}
    hand = None
    constraint_names = ("wall", "floor")

    def __init__(self):
        self.num_resets = 0

    def CreateDefaultContext(self):
        return {}

    def reset(self, context, rng, goal=None):
        raise AssertionError("a verdict begins from the standing posture")

    def goal_of(self, episode):
        raise AssertionError("a verdict needs no episode")

    def reset_standing(self, context, goal, rng=None):
        self.num_resets += 1
        context["goal"] = np.array(goal, dtype=float)

    def GetOutputPort(self, name):
        return SimpleNamespace(Eval=lambda context: context["goal"])


class FieldAssessment:
    """Γ of a goal is a given function of it: `gamma(goals (N, 3)) -> (N,)`."""

    parameters = SimpleNamespace(initial_uncertainty=0.3, margin_unit=0.02)
    base_logit_ = object()
    embedding_ = SimpleNamespace(has_heads=False)

    def __init__(self, gamma, unknown=0.3):
        self._gamma = gamma
        self._unknown = unknown

    def predict(self, state, desired_preview, features):
        n = len(state)
        gamma = np.asarray(self._gamma(state), dtype=float)
        known = 1.0 - self._unknown
        unsafe = known * (1.0 - gamma)
        return Prediction(
            belief=np.column_stack([known * gamma, unsafe, np.full(n, self._unknown)]),
            embedding=np.zeros((n, 2)),
            cause_probability=np.column_stack([0.2 * unsafe, 0.8 * unsafe]),
            predicted_margins=np.column_stack([gamma - 0.5, np.full(n, 0.02)]),
            probability=gamma,
            novelty=np.zeros(len(gamma)),
            fall_probability=np.full(len(gamma), np.nan),
        )
