from types import SimpleNamespace

import numpy as np
import pytest

from cart_episodes import make_episode, make_info
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.episode_start import StatePlane
from shuttle_task import shuttling
from studies.truth import agreement, boundary_distance, random_plan_estimates, simulate_truth

# Safe on the left half of a grid of 5 x 5: its first two rows along the first variable.
HALF = np.repeat(np.array([True, True, False, False, False]), 5).reshape(5, 5)


def test_distances_count_from_either_side():
    distance = boundary_distance(HALF)
    np.testing.assert_allclose(distance[:, 0], [0.5, 0.25, 0.25, 0.5, 0.75])
    assert np.isinf(boundary_distance(np.ones((3, 3), dtype=bool))).all()


def test_a_grid_reaches_to_its_corners_with_the_first_variable_first():
    plane = StatePlane(
        axes=("x", "y"), lowest=(0.0, -1.0), highest=(2.0, 1.0), start=lambda point: point
    )
    points = plane.points(3)
    np.testing.assert_array_equal(points[0, 0], [0.0, -1.0])
    np.testing.assert_array_equal(points[2, 0], [2.0, -1.0])
    np.testing.assert_array_equal(points[1, 2], [1.0, 1.0])
    with pytest.raises(ValueError, match="resolution must be at least 2; got 1"):
        plane.points(1)


class SaysTheState:
    """An assessment that takes the first number of a state for the probability of safety."""

    def predict_rows(self, rows):
        return SimpleNamespace(belief=np.stack([rows.state[:, 0], 1.0 - rows.state[:, 0]], axis=1))


def test_random_plans_are_judged_by_their_first_rows_alone():
    # (what is said first, whether it stays safe); later rows say the opposite.
    said = [(0.95, True), (0.6, True), (0.3, True), (0.95, False), (0.6, False), (0.05, False)]
    info = make_info()
    episodes = []
    for index, (first, stays_safe) in enumerate(said):
        cause = "" if stays_safe else info.constraint_names[0]
        episode = make_episode(index, first_step=0, is_safe=stays_safe, cause=cause)
        episode.state[:, 0] = 1.0 - first
        episode.state[0, 0] = first
        episodes.append(episode)
    found = random_plan_estimates(SaysTheState(), Episodes(info, episodes))
    assert found["safe_share"].value == 0.5
    # Two of the five that are safe, or said to be.
    assert found["intersection_over_union"].value == pytest.approx(2 / 5)
    assert found["intersection_over_union"].n == 5
    assert found["confident_errors"].value == pytest.approx(1 / 6)


def test_agreement_is_overlap_and_confident_errors_with_their_distance_to_the_other_kind():
    found = agreement(HALF, HALF.astype(float))
    assert (found.intersection_over_union, found.confident_errors, found.band) == (1.0, 0.0, 0.0)
    more = np.zeros((5, 5))
    more[:3] = 0.8  # No confident word; 0 where it is safe would be.
    found = agreement(HALF, more)
    assert found.intersection_over_union == pytest.approx(2 / 3)
    assert found.confident_errors == 0.0
    wrong = HALF.astype(float)
    wrong[4, 2] = 0.95
    found = agreement(HALF, wrong)
    assert found.confident_errors == pytest.approx(1 / 25)
    # From row 4 to row 1 there are three of four spacings.
    assert found.band == pytest.approx(0.75)
    with pytest.raises(ValueError, match=r"\(5, 5\) outcomes and \(4, 5\) probabilities"):
        agreement(HALF, np.zeros((4, 5)))
    with pytest.raises(ValueError, match=r"'Shuttling' has no state plane 'hold'; it has \[\]"):
        simulate_truth(shuttling(), "hold", 3, num_workers=1)
