from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.embedding_figure import embedding_figure
from drake_safety.learning.beliefs import UNCERTAINTY, from_scores, fuse_cells
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import split
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
        masses = from_scores(segments.score, 0.3, segments.cause, 2)
        cells = self.grid_.locate(segments.state[:, :2])
        self.beliefs_ = fuse_cells(masses, cells, num_cells=36, min_count=5)[None]

    def predict(self, state, desired_preview, features):
        return SimpleNamespace(embedding=state[:, :2])


@pytest.fixture(scope="module")
def assessment():
    return StandIn(make_episodes(60, seed=0))


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(20, seed=5)


def test_the_map_shows_every_segment_at_its_point_and_the_cells_that_hold_a_belief(
    assessment, fresh
):
    left, middle, *_ = embedding_figure(assessment, fresh).axes
    segments = split(fresh, stride=5, discount=0.99)
    drawn = left.collections[-1]
    order = np.lexsort(drawn.get_offsets().T)
    expected = np.lexsort(segments.state[:, :2].T)
    np.testing.assert_allclose(drawn.get_offsets()[order], segments.state[expected, :2], rtol=1e-12)
    np.testing.assert_allclose(np.sort(drawn.get_array()), np.sort(1.0 - segments.score))
    centres = assessment.grid_.centres[assessment.beliefs_[0][:, UNCERTAINTY] < 1.0]
    (x0, x1), (y0, y1) = middle.get_xlim(), middle.get_ylim()
    assert (([x0, y0] < centres) & (centres < [x1, y1])).all()
    assert {f"{len(segments)} segments", "Beliefs of the cells"} == {
        one.get_title(loc="left") for one in (left, middle)
    }
