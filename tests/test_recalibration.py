import numpy as np
import pytest

from drake_safety.learning.prediction import BaseLogit, sigmoid
from drake_safety.learning.recalibration import (
    HIDDEN_STD,
    OFFSET_STD,
    SLOPE_STD,
    LabelledHeads,
    fitted_change,
    row_weights,
)

LOGIT = BaseLogit(margin_unit=0.02, margin_range=(-0.03, 0.1), margin_slope=0.5, trees_slope=0.4)


def labelled(heads, is_unsafe, activations=None):
    return LabelledHeads(
        heads=heads,
        activations=np.zeros((1, len(heads), 0)) if activations is None else activations,
        is_unsafe=is_unsafe,
        weight=np.ones(len(heads)),
    )


def drawn(rng, num, change=(0.0, 0.0, 0.0)):
    """Heads and two maps of three activations, and ends that are as likely as L with a change."""
    heads = rng.normal(scale=1.5, size=(num, len(change) - 1))
    activations = np.maximum(rng.normal(size=(2, num, 3)), 0.0)
    shifted = LOGIT.of_heads(heads) + change[0] + heads @ change[1:]
    return labelled(heads, rng.random(num) < sigmoid(shifted), activations)


@pytest.mark.parametrize("made", [(0.8, 0.2, 0.1), (1.2, 0.2, 0.1, 0.2)])
def test_the_change_solves_its_own_equation(made):
    rng = np.random.default_rng(0)
    actual, twins = drawn(rng, 50, made), drawn(rng, 50, np.zeros(len(made)))
    mean = actual.activations.mean(axis=1, keepdims=True)
    unit = np.sqrt(np.mean(np.sum((actual.activations - mean) ** 2, axis=(0, 2))))
    change, hidden, hidden_range = fitted_change(actual, twins, LOGIT)
    added = np.einsum("kni,ki->n", actual.activations, hidden[:, :-1]) + hidden[:, -1].sum()
    np.testing.assert_allclose(hidden_range, [added.min(), added.max()])
    np.testing.assert_allclose(hidden[:, -1], -np.sum(hidden[:, :-1] * mean[:, 0], axis=1))
    w = np.concatenate([change, unit * hidden[:, :-1].ravel()])

    def slope(of, w):
        centred = (of.activations - mean).transpose(1, 0, 2).reshape(len(of.heads), -1) / unit
        phi = np.column_stack([np.ones(len(of.heads)), of.heads, centred])
        return phi.T @ (sigmoid(LOGIT.of_heads(of.heads) + phi @ w) - of.is_unsafe)

    of_slopes = [SLOPE_STD] * (len(made) - 1)
    deviation = [OFFSET_STD, *of_slopes, *[HIDDEN_STD] * 6]
    residual = slope(actual, w) - slope(twins, np.zeros(len(w))) + w / np.array(deviation) ** 2
    np.testing.assert_allclose(residual, 0.0, atol=1e-3)
    assert change[0] > 0.3


def test_what_is_wrong_of_the_twins_too_is_not_adapted_to():
    rng = np.random.default_rng(2)
    wrong = (1.0, 0.0, 0.0)
    both = drawn(rng, 20_000, wrong), drawn(rng, 20_000, wrong)
    assert np.abs(fitted_change(*both, LOGIT)[0]).max() < 0.15
    # Were L right of the twins, all of that would be the actual robot's.
    change, *_ = fitted_change(both[0], drawn(rng, 20_000), LOGIT)
    assert change[0] == pytest.approx(1.0, abs=0.1)


def test_more_danger_never_counts_as_less():
    rng = np.random.default_rng(3)
    heads = rng.normal(scale=2.0, size=(5000, 3))
    upside_down = labelled(heads, rng.random(5000) < sigmoid(-3.0 * heads.sum(axis=1)))
    right = labelled(heads, rng.random(5000) < sigmoid(LOGIT.of_heads(heads)))
    change, *_ = fitted_change(upside_down, right, LOGIT)
    np.testing.assert_allclose(change[1:], -np.array(LOGIT.slopes))


def test_the_change_stays_finite_however_large_the_gap():
    heads, every = np.full((4000, 2), -4.0), np.ones(4000, dtype=bool)
    change, *_ = fitted_change(labelled(heads, every), labelled(heads, ~every), LOGIT)
    assert np.isfinite(change).all() and change[0] + heads[0] @ change[1:] > 8.0


def test_an_episode_counts_by_its_first_row_and_by_all_of_them_together():
    np.testing.assert_allclose(row_weights(np.array([2, 1, 4])), [2, 1, 3, 1.5, *[0.5] * 3])
