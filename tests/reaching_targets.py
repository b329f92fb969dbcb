"""Targets of the packaged reaching whose outcome is known: safe short of a plane."""

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episode, Episodes
from drake_safety.planning.goal_verdict import goal_inputs
from drake_safety.simulation.rollouts import episodes_info
from drake_safety.simulation.scenario import load_scenario
from live_scenarios import quick

SCENARIO = "atlas_reaching"
BOUNDARY_M = 0.75
CAUSE = "collision"
NEAR, FAR = (0.6, 0.5, 1.05), (0.95, 0.5, 1.05)


def made_up_episodes(loop):
    """As many episodes as goals, from the standing posture, safe where x < `BOUNDARY_M`.

    What the assessment sees of them is real; what came of them is not, so that it is known.
    """
    rng = np.random.default_rng(0)
    goals = rng.uniform(*loop.target_box, (160, 3))
    episodes = []
    columns = zip(goals, *goal_inputs(loop, goals), strict=True)
    for index, (goal, state, preview, features) in enumerate(columns):
        margins = np.full((loop.scenario.num_steps + 1, len(loop.constraint_names)), 0.1)
        shape = (len(margins), 1)
        # No two robots stand alike, nor does one with the other hand.
        state, features = (part + rng.normal(0.0, 0.01, part.shape) for part in (state, features))
        is_safe = bool(goal[0] < BOUNDARY_M)
        column = loop.constraint_names.index(CAUSE)
        margins[:, column] = np.linspace(0.05, 0.05 if is_safe else -0.02, len(margins))
        episodes.append(
            Episode(
                index=index,
                time_s=loop.scenario.step_s * np.arange(len(margins)),
                state=np.tile(state, shape),
                true_state=np.tile(state, shape),
                output=np.tile(goal, shape)
                + np.linspace(0.0, 0.0025 * index, len(margins))[:, None],
                desired_output=np.tile(goal, shape),
                desired_preview=np.tile(preview, shape),
                features=np.tile(features, shape),
                margins=margins,
                is_safe=is_safe,
                cause="" if is_safe else CAUSE,
            )
        )
    return Episodes(episodes_info(loop, seed=0), episodes)


def learned_targets():
    """An assessment of them."""
    scenario = quick(load_scenario(SCENARIO))
    scenario.assessment.epochs = 40
    return SafetyAssessment(scenario.assessment).fit(made_up_episodes(scenario.make_loop()))
