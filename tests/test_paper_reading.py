from dataclasses import replace

import numpy as np
import pytest

from drake_safety.learning.assessment import (
    AdaptationParameters,
    AssessmentParameters,
    SafetyAssessment,
)
from drake_safety.learning.assessment_parameters import PaperReading
from drake_safety.learning.inputs import InputColumns, is_rate
from drake_safety.learning.maps import stack_members, train_map
from drake_safety.learning.segments import Episodes, training_segments
from lip_assessments import QUICK, map_data
from lip_episodes import make_episodes


def paper(**changes):
    quick = {name: value for name, value in QUICK.items() if name != "epochs"}
    return AssessmentParameters(mode="paper", **quick | {"perplexity": 8.0} | changes)


def trained(data, reading, held_out=None):
    parameters = paper(paper=reading, batch_size=64)
    return stack_members([train_map(data, parameters, seed=0, held_out=held_out)], num_margins=0)


@pytest.fixture(scope="module")
def episodes():
    return make_episodes(90)


def test_segments_overlap_by_all_but_one_sample_or_not_at_all(episodes):
    horizon = episodes.info.horizon
    for stride, expected in ((1, 1), (0, horizon)):
        segments = training_segments(episodes, paper(paper=PaperReading(stride=stride)))
        first = segments.start_row[segments.episode == segments.episode[0]]
        assert set(np.diff(first)) <= {expected}
        assert not np.any(segments.start_row % expected)


@pytest.mark.train
def test_without_velocities_gamma_depends_on_configurations_alone(episodes):
    names = [f"base_{i}" if i % 2 else f"velocity_{i}" for i in range(6)]
    info = replace(episodes.info, state_names=names)
    episodes = Episodes(info, list(episodes))
    reading = PaperReading(velocities=False, epochs=2)
    assessment = SafetyAssessment(paper(paper=reading)).fit(episodes)
    rates = np.array([is_rate(name) for name in episodes.info.state_names])
    assert rates.any() and not rates.all()
    whole = InputColumns(episodes.info, paper())
    assert len(assessment.columns_.names) == len(whole.names) - rates.sum()
    one = episodes[0]
    state = one.true_state.copy()
    before = assessment.predict(state, one.desired_preview)
    state[:, rates] += 3.0
    after = assessment.predict(state, one.desired_preview)
    np.testing.assert_array_equal(after.embedding, before.embedding)
    x = assessment.inputs_of(state, one.desired_preview, None)
    np.testing.assert_array_equal(x[:, : (~rates).sum()], state[:, ~rates])


@pytest.mark.train
def test_the_loss_without_a_square_gives_the_median_and_with_it_the_mean():
    # Of equal inputs, four fifths are at one point and a fifth is at another.
    rng = np.random.default_rng(0)
    x = rng.normal(size=(640, 2))
    target = np.where((np.arange(640) % 5 == 0)[:, None], [10.0, 0.0], [0.0, 0.0])
    found = {
        loss: trained(map_data(x, target), PaperReading(loss=loss, epochs=60)).embed(x)[0, :, 0]
        for loss in ("squared", "norm")
    }
    assert np.mean(found["squared"]) == pytest.approx(2.0, abs=0.5)
    assert abs(np.mean(found["norm"])) < 0.5


@pytest.mark.train
def test_stopping_early_keeps_the_epoch_that_is_best_on_held_out_inputs():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(240, 12))
    target = np.column_stack([x[:, 0], np.zeros(240)]) + rng.normal(size=(240, 2))
    seen, unseen = map_data(x[:80], target[:80]), map_data(x[80:], target[80:])
    reading = PaperReading(epochs=150, dropout=0.0, weight_decay=0.0, hidden_sizes=[64, 64])

    def error(embedding):
        return np.linalg.norm(embedding.embed(unseen.x)[0] - unseen.target, axis=1).mean()

    assert error(trained(seen, reading, unseen)) < 0.95 * error(trained(seen, reading))


@pytest.mark.train
def test_standardised_inputs_make_the_map_independent_of_units():
    rng = np.random.default_rng(2)
    x = rng.normal(size=(200, 3))
    target = x[:, :2] * 5.0
    scale = np.array([100.0, 1.0, 0.1])
    for standardized in (True, False):
        reading = PaperReading(standardized=standardized, epochs=3, dropout=0.0)
        one = trained(map_data(x, target), reading).embed(x)
        other = trained(map_data(x * scale, target), reading).embed(x * scale)
        assert np.allclose(one, other, atol=1e-3) == standardized


def test_the_defaults_are_the_papers_table():
    learned, adapted = AssessmentParameters(), AdaptationParameters()
    assert (learned.discount, learned.horizon, learned.score_weight) == (0.99, 10, 0.01)
    assert (learned.initial_uncertainty, learned.min_count) == (0.3, 5)
    assert (learned.resolution, learned.cell_length) == (14, 10.0)
    assert (adapted.gate, adapted.least_uncertainty) == (0.3, 0.1)
    assert (adapted.decay_rate, adapted.first_uncertainty) == (0.4, 0.3)
    assert adapted.update_interval == 40
