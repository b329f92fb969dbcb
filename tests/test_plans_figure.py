import numpy as np
import pytest

from drake_safety.evaluation.plans_figure import plans_figure

RNG = np.random.default_rng(0)
GOALS = RNG.uniform([0.5, -0.3, 0.5], [1.0, 1.3, 1.6], (50, 3))
IS_UNSAFE = RNG.random(50) < 0.5
IS_REFUSED = IS_UNSAFE ^ (RNG.random(50) < 0.2)


def test_every_target_is_drawn_once_in_either_view_and_left_is_left():
    for axes, (right, up) in zip(
        plans_figure(GOALS, IS_UNSAFE, IS_REFUSED).axes, ((1, 2), (1, 0)), strict=True
    ):
        drawn = np.concatenate([np.asarray(marks.get_offsets()) for marks in axes.collections])
        expected = GOALS[:, [right, up]]
        np.testing.assert_allclose(
            drawn[np.lexsort(drawn.T)], expected[np.lexsort(expected.T)], atol=1e-12
        )
        low, high = axes.get_xlim()
        assert low > high


def test_the_legend_counts_each_verdict_among_those_of_its_outcome():
    texts = plans_figure(GOALS, IS_UNSAFE, IS_REFUSED).legends[0].get_texts()
    labels = [text.get_text() for text in texts]
    num_missed, num_unsafe = np.sum(IS_UNSAFE & ~IS_REFUSED), IS_UNSAFE.sum()
    share = 100 * num_missed / num_unsafe
    assert f"accepted, but unsafe: {num_missed} of {num_unsafe}, {share:.1f} %" in labels
    counts = [int(label.split(": ")[1].split(" of ")[0]) for label in labels]
    assert sum(counts) == len(GOALS)


def test_a_single_target_and_none_can_be_drawn():
    for number in (1, 0):
        rows = slice(0, number)
        assert plans_figure(GOALS[rows], IS_UNSAFE[rows], IS_REFUSED[rows]).axes


def test_as_many_verdicts_as_targets_are_expected():
    with pytest.raises(ValueError, match=r"expected \(N, 3\), \(N,\), \(N,\)"):
        plans_figure(GOALS, IS_UNSAFE[:-1], IS_REFUSED)
