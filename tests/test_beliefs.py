import numpy as np
import pytest

from drake_safety.learning.beliefs import EMPTY, empty, from_scores, fuse, fuse_cells


def printed_fusion(beliefs):
    """F with the products as the paper prints them, for a handful of uncertain beliefs."""
    mu = beliefs[:, 2]
    others = np.array([np.prod(np.delete(mu, i)) for i in range(len(mu))])
    divisor = others.sum() - len(mu) * mu.prod()
    masses = (beliefs[:, :2] * ((1 - mu) * others)[:, None]).sum(axis=0) / divisor
    return np.append(masses, (len(mu) - mu.sum()) * mu.prod() / divisor)


def random_beliefs(rng, count, num_causes=0):
    return from_scores(
        rng.uniform(size=count),
        rng.uniform(0.05, 0.95, size=count),
        rng.integers(0, max(num_causes, 1), size=count),
        num_causes,
    )


def test_a_score_becomes_the_masses_of_the_papers_equation_the_unsafe_one_booked_on_its_cause():
    np.testing.assert_allclose(from_scores(np.array([0.25]), 0.3), [[0.525, 0.175, 0.3]])
    beliefs = from_scores(np.array([0.5, 0.0]), 0.2, np.array([1, -1]), 3)
    np.testing.assert_allclose(beliefs, [[0.4, 0.4, 0.2, 0, 0.4, 0], [0.8, 0, 0.2, 0, 0, 0]])


def test_fusion_equals_the_printed_products():
    rng = np.random.default_rng(0)
    for count in (1, 2, 5, 20):
        beliefs = random_beliefs(rng, count)
        np.testing.assert_allclose(fuse(beliefs), printed_fusion(beliefs), rtol=1e-12)
    # By hand: w = 1 and 1/4, b_safe = (0.5 + 0.05) / 1.25, mu = (0.5 + 0.2) / 1.25.
    fused = fuse(np.array([[0.5, 0.0, 0.5], [0.2, 0.0, 0.8]]))
    np.testing.assert_allclose(fused, [0.44, 0.0, 0.56])


def test_fusion_of_a_thousand_beliefs_is_finite_and_keeps_their_uncertainty():
    fused = fuse(from_scores(np.linspace(0.0, 1.0, 1000), 0.3))
    np.testing.assert_allclose(fused, [0.35, 0.35, 0.3])


def test_fusion_ignores_empty_beliefs_and_the_order():
    rng = np.random.default_rng(1)
    beliefs = random_beliefs(rng, 6)
    with_empty = rng.permutation(np.vstack([beliefs, EMPTY, EMPTY]))
    np.testing.assert_allclose(fuse(with_empty), fuse(beliefs), rtol=1e-12)


def test_certain_beliefs_outweigh_all_others_and_are_averaged():
    fused = fuse(np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.999, 0.001]]))
    np.testing.assert_allclose(fused, [0.75, 0.25, 0.0])


def test_a_nearly_certain_belief_does_not_overflow():
    fused = fuse(np.array([[1.0, 0.0, 1e-300], [0.0, 0.5, 0.5]]))
    np.testing.assert_allclose(fused, [1.0, 0.0, 0.0], atol=1e-12)


def test_nothing_and_only_empty_beliefs_fuse_to_the_empty_one():
    np.testing.assert_array_equal(fuse(empty(0, 2)), empty((), 2))
    np.testing.assert_array_equal(fuse(empty(4)), EMPTY)


def test_cells_are_fused_each_for_itself_from_the_minimum_count_on():
    rng = np.random.default_rng(3)
    beliefs = random_beliefs(rng, 9, num_causes=2)
    cells = np.array([0, 0, 0, 2, 2, -1, 3, 3, 3])
    fused = fuse_cells(beliefs, cells, num_cells=5, min_count=3)
    for cell in (0, 3):
        np.testing.assert_allclose(fused[cell], fuse(beliefs[cells == cell]))
        np.testing.assert_allclose(
            [fused[cell, :3].sum(), fused[cell, 3:].sum()], [1, fused[cell, 1]]
        )
    for cell in (1, 2, 4):
        np.testing.assert_array_equal(fused[cell], empty((), 2))


def test_a_multiplicity_counts_as_so_many_equal_beliefs():
    rng = np.random.default_rng(0)
    beliefs = from_scores(rng.random(12), rng.uniform(0.0, 1.0, 12), np.zeros(12, dtype=int), 1)
    times, cells = rng.integers(1, 5, 12), rng.integers(0, 3, 12)
    options = {"num_cells": 3, "min_count": 1}
    np.testing.assert_allclose(
        fuse_cells(beliefs, cells, multiplicity=times, **options),
        fuse_cells(np.repeat(beliefs, times, axis=0), np.repeat(cells, times), **options),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: from_scores(np.array([1.5]), 0.3), "every score must lie"),
        (lambda: from_scores(np.array([0.5]), np.array([np.nan])), "every uncertainty must lie"),
        (lambda: from_scores(np.array([0.5]), 0.3, np.array([-1]), 2), "needs a cause"),
        (
            lambda: fuse_cells(empty(3), np.zeros(2, dtype=int), num_cells=1, min_count=1),
            "cells for beliefs",
        ),
    ],
)
def test_beliefs_that_cannot_be_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
