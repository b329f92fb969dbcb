from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.embedding_figure import embedding_figure
from drake_safety.learning.beliefs import from_scores, fuse_cells
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import split
from drake_safety.learning.training_scores import TrainingScores
from lip_episodes import make_episodes


class StandIn:
    """An assessment whose embedding is the pendulum's horizontal position."""

    def __init__(self, episodes):
        self.info_ = episodes.info
        self.parameters = SimpleNamespace(
            horizon=episodes.info.horizon, discount=0.99, initial_uncertainty=0.3
        )
        self.grid_ = Grid(resolution=6, cell_length=0.1)
        segments = split(episodes, stride=1, discount=0.99)
        points = segments.state[None, :, :2]
        masses = from_scores(segments.score, 0.3, segments.cause, 2)
        cells = self.grid_.locate(points[0])
        count = np.bincount(cells[cells >= 0], minlength=36)[None]
        scores = {"score": segments.score, "cause": segments.cause, "count": count}
        self.training_ = TrainingScores(points=points, **scores)
        self.beliefs_ = fuse_cells(masses, cells, num_cells=36, min_count=5)[None]

    def predict(self, state, desired_preview, features):
        return SimpleNamespace(embedding=state[:, :2])


@pytest.fixture(scope="module")
def assessment():
    return StandIn(make_episodes(60, seed=0))


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(20, seed=5)


def test_the_map_shows_every_segment_at_its_point_and_every_count(assessment, fresh):
    left, middle, *_ = embedding_figure(assessment, fresh).axes
    segments = split(fresh, stride=5, discount=0.99)
    drawn = left.collections[-1]
    order = np.lexsort(drawn.get_offsets().T)
    expected = np.lexsort(segments.state[:, :2].T)
    np.testing.assert_allclose(drawn.get_offsets()[order], segments.state[expected, :2], rtol=1e-12)
    np.testing.assert_allclose(np.sort(drawn.get_array()), np.sort(segments.score))
    points = assessment.training_.points[0]
    inside = np.abs(points).max(axis=1) < assessment.grid_.half_width
    assert sum(int(count) for count in [text.get_text() for text in middle.texts]) == inside.sum()


def test_an_assessment_from_which_no_segment_was_left_out_has_the_same_map(assessment, fresh):
    texts = [text.get_text() for text in embedding_figure(assessment, fresh).axes[1].texts]
    whole = copy(assessment)
    whole.training_ = replace(assessment.training_, count=None)
    assert [one.get_text() for one in embedding_figure(whole, fresh).axes[1].texts] == texts
