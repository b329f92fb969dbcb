import copy

import numpy as np
import pytest

from drake_safety.learning.maps import learned_trees
from drake_safety.learning.trained_maps import INPUT_LIMIT
from drake_safety.learning.trees import MOST_LEAVES, Trees
from lip_assessments import map_data

NUM_INPUTS = 5


def by_hand():
    """Two trees: x0 > 1, then on its left x2 > -2; and one leaf alone."""
    return Trees(
        feature=np.array([[0, 0], [2, 0]]),
        threshold=np.array([[1.0, np.inf], [-2.0, np.inf]]),
        left=np.array([[0b011, 0], [0b001, 0]]),
        value=np.array([[1.0, 2.0, 4.0], [10.0, 0.0, 0.0]]),
    )


def drawn(num=2000, seed=0):
    """Inputs in which single and double precision fall on different sides, and their labels."""
    rng = np.random.default_rng(seed)
    x = 1.0 + 1e-6 * rng.normal(size=(num, NUM_INPUTS))
    x[:, 1:] = rng.normal(size=(num, NUM_INPUTS - 1))
    logit = 3e6 * (x[:, 0] - 1.0) + 2.0 * x[:, 1] * x[:, 2] + np.sin(3.0 * x[:, 3])
    return x, rng.random(num) < 1.0 / (1.0 + np.exp(-logit))


def fitted(**options):
    x, label = drawn()
    return Trees.fit(x, label, np.ones(len(x)), seed=0, **options)


def test_the_leaf_is_the_one_a_walk_reaches_and_equality_goes_to_the_left():
    x = np.zeros((4, NUM_INPUTS))
    x[:, 0], x[:, 2] = [1.0, 1.0, 1.5, 1.5], [-2.0, 0.0, -3.0, 0.0]
    np.testing.assert_array_equal(by_hand().evaluate(x), [11.0, 12.0, 14.0, 14.0])


def test_rows_that_are_not_finite_have_no_logit_and_the_arrays_cannot_change():
    trees = by_hand()
    for odd in (np.nan, -np.inf, INPUT_LIMIT):
        x = np.zeros((3, NUM_INPUTS))
        x[1, 4] = odd
        np.testing.assert_array_equal(trees.evaluate(x), [12.0, np.nan, 12.0])
    assert trees.evaluate(x[:0]).shape == (0,)
    with pytest.raises(ValueError, match="read-only"):
        trees.arrays["value"][0] = 0.0
    again = Trees(**copy.deepcopy(trees.arrays))
    np.testing.assert_array_equal(again.evaluate(x), trees.evaluate(x))


@pytest.mark.train
def test_the_logit_is_that_of_scikit_learn(monkeypatch):
    models, of = [], Trees._of
    monkeypatch.setattr(Trees, "_of", lambda model, num: models.append(model) or of(model, num))
    trees, x = fitted(num_trees=60), drawn()[0]
    (model,), single = models, x.astype(np.float32)
    assert max(nodes.get_n_leaf_nodes() for (nodes,) in model._predictors) == MOST_LEAVES
    np.testing.assert_allclose(trees.evaluate(x), model.decision_function(single), atol=1e-6)
    between = np.nextafter(single, single[::-1])  # Beside the thresholds.
    np.testing.assert_allclose(trees.evaluate(between), model.decision_function(between), atol=1e-6)
    assert np.ptp(trees.evaluate(x)) > 4.0
    # A row has the same bits whatever the others are.
    together = trees.evaluate(x[:101])
    np.testing.assert_array_equal(together, [trees.evaluate(row[None])[0] for row in x[:101]])


@pytest.mark.train
@pytest.mark.parametrize(("num_rare", "is_rare"), [(0, True), (3, False)])
def test_where_the_rest_to_learn_from_has_one_label_there_are_no_trees(num_rare, is_rare):
    episode = np.repeat(np.arange(40), 20)
    is_held_out = episode < 10
    # Episodes 10, 20 and 30 choose the number of trees.
    label = np.isin(episode, [10, 20, 30][:num_rare]) | (is_held_out & (episode % 2 == 0))
    x = drawn(len(episode))[0]
    data = map_data(x, x[:, :2], is_unsafe=label == is_rare)
    assert learned_trees(data, episode, is_held_out, 0) == (None, None)
    data.is_unsafe[episode == 33] = is_rare
    tried, trees = learned_trees(data, episode, is_held_out, 0)
    assert 0 < len(tried) == len(trees)


@pytest.mark.train
def test_their_number_is_chosen_on_what_they_have_not_learned_and_a_seed_gives_the_same_bits():
    x, label = drawn()
    is_held_out = np.arange(len(x)) % 5 == 0
    few = fitted(is_held_out=is_held_out)
    assert 5 < len(few) < 200
    for name, array in fitted(is_held_out=is_held_out).arrays.items():
        np.testing.assert_array_equal(array, few.arrays[name])
    others = x[~is_held_out], label[~is_held_out], np.ones(1600)
    other = Trees.fit(*others, seed=0, num_trees=len(few))
    np.testing.assert_array_equal(other.evaluate(x), few.evaluate(x))
    # A label with a weight of nothing is not learned.
    weight = np.where(label, 1.0, 1e-9)
    assert np.all(Trees.fit(x, label, weight, seed=0, num_trees=100).evaluate(x) > 3.0)
