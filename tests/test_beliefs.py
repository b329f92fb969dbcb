import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import naive
from drake_safety.learning.beliefs import EMPTY, empty, from_scores, fuse, fuse_cells


@st.composite
def beliefs(draw, num_causes=0):
    """Up to twenty uncertain beliefs."""
    n = draw(st.integers(1, 20))
    score, uncertainty = (
        draw(arrays(float, n, elements=st.floats(*ends))) for ends in ((0.0, 1.0), (0.05, 0.95))
    )
    cause = draw(arrays(int, n, elements=st.integers(0, max(num_causes, 1) - 1)))
    return from_scores(score, uncertainty, cause, num_causes)


def test_a_score_becomes_the_masses_of_the_papers_equation_the_unsafe_one_booked_on_its_cause():
    np.testing.assert_allclose(from_scores(np.array([0.25]), 0.3), [[0.525, 0.175, 0.3]])
    beliefs = from_scores(np.array([0.5, 0.0]), 0.2, np.array([1, -1]), 3)
    np.testing.assert_allclose(beliefs, [[0.4, 0.4, 0.2, 0, 0.4, 0], [0.8, 0, 0.2, 0, 0, 0]])


@given(beliefs(), st.integers(0, 3), st.randoms())
def test_fusion_is_the_printed_products_and_ignores_empty_beliefs_and_the_order(
    beliefs, num_empty, random
):
    expected = naive.fusion(beliefs)
    np.testing.assert_allclose(fuse(beliefs), expected, rtol=1e-12, atol=1e-300)
    shuffled = [*beliefs, *[EMPTY] * num_empty]
    random.shuffle(shuffled)
    np.testing.assert_allclose(fuse(np.array(shuffled)), expected, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize(
    ("beliefs", "expected"),
    [
        # w = 1 and 1/4, b_safe = (0.5 + 0.05) / 1.25, mu = (0.5 + 0.2) / 1.25.
        ([[0.5, 0.0, 0.5], [0.2, 0.0, 0.8]], [0.44, 0.0, 0.56]),
        # A thousand keep their uncertainty.
        (from_scores(np.linspace(0.0, 1.0, 1000), 0.3), [0.35, 0.35, 0.3]),
        # Certain ones outweigh all others and are averaged.
        ([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.999, 0.001]], [0.75, 0.25, 0.0]),
        # A nearly certain one does not overflow.
        ([[1.0, 0.0, 1e-300], [0.0, 0.5, 0.5]], [1.0, 0.0, 0.0]),
        (empty((0,), 2), empty((), 2)),
        (empty((4,)), EMPTY),
    ],
)
def test_fused_beliefs_worked_by_hand(beliefs, expected):
    np.testing.assert_allclose(fuse(np.array(beliefs)), expected, atol=1e-12)


@given(beliefs(num_causes=2), st.integers(1, 4), st.data())
def test_cells_are_fused_each_for_itself_from_the_minimum_count_on(beliefs, min_count, data):
    n = len(beliefs)
    cells, times = (
        data.draw(arrays(int, n, elements=st.integers(*ends))) for ends in ((-1, 3), (1, 4))
    )
    options = {"num_cells": 5, "min_count": min_count}
    fused = fuse_cells(beliefs, cells, **options)
    for cell in range(5):
        own = beliefs[cells == cell]
        expected = fuse(own) if len(own) >= min_count else empty((), 2)
        np.testing.assert_allclose(fused[cell], expected, atol=1e-12)
        sums = [fused[cell, :3].sum(), fused[cell, 3:].sum()]
        np.testing.assert_allclose(sums, [1.0, fused[cell, 1]], atol=1e-12)
    # A multiplicity counts as so many equal beliefs.
    options["min_count"] = 1
    repeated = fuse_cells(np.repeat(beliefs, times, axis=0), np.repeat(cells, times), **options)
    counted = fuse_cells(beliefs, cells, multiplicity=times, **options)
    np.testing.assert_allclose(counted, repeated, atol=1e-12)


def test_beliefs_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="every score must lie"):
        from_scores(np.array([1.5]), 0.3)
    with pytest.raises(ValueError, match="needs a cause"):
        from_scores(np.array([0.5]), 0.3, np.array([-1]), 2)
