"""Whether more training episodes would help, from the episodes themselves."""

import numpy as np
import pytest

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.learning_curve import describe, learning_curve
from drake_safety.learning.segments import Episodes
from lip_episodes import make_episodes


@pytest.mark.train
def test_held_out_episodes_are_ranked_better_the_more_are_learned():
    episodes, parameters = make_episodes(200), AssessmentParameters()
    area = learning_curve(episodes, parameters)
    assert area.shape == (3, 5)
    few, half, every = area.mean(axis=1)
    assert few < half < every and every > 0.9
    assert describe(area).startswith("more episodes would help")
    safe = Episodes(episodes.info, [episode for episode in episodes if episode.is_safe])
    assert describe(learning_curve(safe, parameters)).startswith("too few episodes of either label")


@pytest.mark.parametrize(
    ("quarter", "half", "spread", "answer"),
    [
        (0.86, 0.89, 0.01, "more episodes would help"),
        (0.89, 0.899, 0.001, "more episodes would hardly help"),
        (0.895, 0.899, 0.05, "too few episodes to tell whether more would"),
    ],
)
def test_more_would_help_where_the_last_doubling_did(quarter, half, spread, answer):
    noise = spread * np.array([1.0, -1.0, 0.5, -0.5, 0.0])
    area = np.array([quarter + noise, half - noise, np.full(5, 0.9)])
    assert describe(area).startswith(answer)
    assert f"{quarter:.3f}, {half:.3f} and 0.900 (± 0.000)" in describe(area)
