from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.segments import split
from lip_episodes import make_episodes


@pytest.fixture(scope="module")
def episodes():
    return make_episodes(40, seed=3, noise=0.05)


class StandIn:
    """An assessment that takes the first column of what it sees for its belief of safe."""

    used_ = ()
    parameters = SimpleNamespace(initial_uncertainty=0.3)

    def __init__(self, uses_true_state):
        self.settings = SimpleNamespace(is_paper=uses_true_state)

    def predict(self, state, desired_preview, features):
        assert features is not None
        # More than half of the belief about every third input is of empty cells.
        is_third = np.arange(len(state))[:, None] % 3 == 2
        belief = np.where(is_third, (0.2, 0.1, 0.7), (0.6, 0.1, 0.3))
        return SimpleNamespace(probability=state[:, 0], belief=belief)


@pytest.mark.parametrize("uses_true_state", [True, False])
def test_an_assessment_scores_by_its_probability_on_what_its_mode_sees(episodes, uses_true_state):
    segments = split(episodes, stride=1, discount=1.0)
    scorer = assessment_scorer("gamma", StandIn(uses_true_state))
    assert scorer.uses_true_state is uses_true_state
    probability = scorer.probability(segments.state, segments.desired_preview, segments.features)
    is_unknown = np.arange(len(segments)) % 3 == 2
    np.testing.assert_array_equal(np.isnan(probability), is_unknown)
    np.testing.assert_array_equal(probability[~is_unknown], segments.state[~is_unknown, 0])
    # The unsafe score of nominal segments is of what the mode sees.
    state = segments.true_state if uses_true_state else segments.state
    expected = np.where(is_unknown, 1.0, 1.0 - state[:, 0])
    np.testing.assert_array_equal(scorer.unsafe_score(segments), expected)
