import numpy as np
import pytest

from drake_safety.learning.assessment import AdaptationParameters, AssessmentParameters
from drake_safety.learning.assessment_parameters import PaperReading
from drake_safety.learning.maps import stack_members, train_map
from drake_safety.learning.segments import training_segments
from lip_assessments import map_data
from lip_episodes import make_episodes


def test_segments_overlap_by_all_but_one_sample_or_not_at_all():
    episodes = make_episodes(90)
    for stride, expected in ((1, 1), (0, episodes.info.horizon)):
        parameters = AssessmentParameters(mode="paper", paper=PaperReading(stride=stride))
        segments = training_segments(episodes, parameters)
        first = segments.start_row[segments.episode == segments.episode[0]]
        assert set(np.diff(first)) <= {expected}
        assert not np.any(segments.start_row % expected)


@pytest.mark.train
def test_standardised_inputs_make_map_independent_of_units():
    x = np.random.default_rng(2).normal(size=(200, 3))
    target, scale = x[:, :2] * 5.0, np.array([100.0, 1.0, 0.1])
    for standardized in (True, False):
        reading = PaperReading(standardized=standardized, epochs=3, dropout=0.0)
        parameters = AssessmentParameters(mode="paper", paper=reading, batch_size=64)
        points = []
        for inputs in (x, x * scale):
            member = train_map(map_data(inputs, target), parameters, seed=0)
            points.append(stack_members([member]).embed(inputs))
        assert np.allclose(*points, atol=1e-3) == standardized


def test_defaults_are_the_papers_table():
    learned, adapted = AssessmentParameters(), AdaptationParameters()
    assert (learned.discount, learned.horizon, learned.score_weight) == (0.99, 10, 0.01)
    assert (learned.initial_uncertainty, learned.min_count) == (0.3, 5)
    assert (learned.resolution, learned.cell_length) == (14, 10.0)
    assert (adapted.gate, adapted.least_uncertainty) == (0.3, 0.1)
    assert (adapted.decay_rate, adapted.first_uncertainty) == (0.4, 0.3)
    assert adapted.update_interval == 40
