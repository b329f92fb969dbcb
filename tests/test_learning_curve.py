"""Whether more training episodes would help, from the episodes themselves."""

import numpy as np
import pytest

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.learning_curve import describe, learning_curve
from drake_safety.learning.segments import Episodes
from lip_episodes import make_episodes


@pytest.mark.train
def test_what_is_not_learned_from_is_ranked_better_the_more_episodes_there_are():
    episodes = make_episodes(200)
    parameters = AssessmentParameters(horizon=episodes.info.horizon)
    area = learning_curve(episodes, parameters)
    assert area.shape == (3, 5)
    few, half, every = area.mean(axis=1)
    assert few < half < every
    assert every > 0.9
    # It depends on nothing but its arguments.
    np.testing.assert_array_equal(learning_curve(episodes, parameters), area)
    assert describe(area).startswith("more episodes would help")


@pytest.mark.train
def test_without_both_outcomes_nothing_is_said_of_more_episodes():
    episodes = make_episodes(60)
    safe = Episodes(episodes.info, [episode for episode in episodes if episode.is_safe])
    area = learning_curve(safe, AssessmentParameters(horizon=episodes.info.horizon))
    assert area.shape == (3, 0)
    assert describe(area).startswith("too few episodes of either label")


@pytest.mark.parametrize(
    ("quarter", "half", "spread", "told"),
    [
        (0.86, 0.89, 0.01, "more episodes would help"),
        (0.89, 0.899, 0.001, "more episodes would hardly help"),
        (0.895, 0.899, 0.05, "too few episodes to tell whether more would"),
    ],
)
def test_more_would_help_where_the_last_doubling_did(quarter, half, spread, told):
    noise = spread * np.array([1.0, -1.0, 0.5, -0.5, 0.0])
    area = np.array([quarter + noise, half - noise, np.full(5, 0.9)])
    assert describe(area).startswith(told)
    assert f"{quarter:.3f}, {half:.3f} and 0.900 (± 0.000)" in describe(area)
