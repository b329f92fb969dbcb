"""Episodes whose random draws are a point of a space of standard normal numbers."""

import numpy as np
import pytest
from scipy.stats import kstest

from drake_safety.simulation.normal_space import NormalGenerator, NormalPoint, moved

NUMBER = 4000
DRAWS = {
    "normal": (lambda rng: rng.normal(1.0, 2.0), lambda rng: rng.normal(1.0, 2.0, NUMBER)),
    "uniform": (lambda rng: rng.uniform(-1.0, 3.0), lambda rng: rng.uniform(-1.0, 3.0, NUMBER)),
    "random": (lambda rng: rng.random(), lambda rng: rng.random(NUMBER)),
    "exponential": (lambda rng: rng.exponential(2.0), lambda rng: rng.exponential(2.0, NUMBER)),
}


def generator(seed=0, z=None):
    point = NormalPoint(np.random.default_rng(seed), z)
    return NormalGenerator(point), point


@pytest.mark.parametrize("name", DRAWS)
def test_draws_have_the_distribution_of_any_generator_one_by_one_and_together(name):
    one, many = DRAWS[name]
    rng, _ = generator(1)
    expected = many(np.random.default_rng(2))
    for drawn in (np.array([one(rng) for _ in range(NUMBER)]), many(rng)):
        assert kstest(drawn, expected).pvalue > 1e-3


def test_discrete_draws_have_theirs():
    rng, point = generator(1)
    for low, high, endpoint in ((3, None, False), (-2, 3, False), (0, 4, True)):
        drawn = rng.integers(low, high, size=NUMBER, endpoint=endpoint)
        expected = np.random.default_rng(0).integers(low, high, size=50, endpoint=endpoint)
        assert set(drawn.tolist()) == set(expected.tolist())
    shares = np.bincount(rng.choice(3, size=NUMBER, p=[0.7, 0.3, 0.0]), minlength=3) / NUMBER
    assert shares == pytest.approx([0.7, 0.3, 0.0], abs=0.03)
    assert rng.choice(["left"], 2).tolist() == ["left", "left"]
    assert sorted(rng.permutation(5)) == sorted(rng.choice(5, 5, replace=False)) == [0, 1, 2, 3, 4]
    assert isinstance(int(rng.integers(2**62)), int)
    values = np.arange(4)
    rng.shuffle(values)
    assert sorted(values) == [0, 1, 2, 3]
    assert point.is_discrete.all()
    assert rng.spawn(2) == [rng, rng]


def test_a_point_gives_its_episode_again_and_a_near_one_a_near_episode():
    def episode(rng):
        direction = rng.uniform(-np.pi, np.pi)
        return np.append(rng.normal(size=(2, 2)).ravel(), [direction, rng.integers(3)])

    rng, point = generator(5)
    first = episode(rng)
    assert len(point.z) == 6
    np.testing.assert_array_equal(episode(generator(9, point.z)[0]), first)
    near = moved(point.z, point.is_discrete, 0.01, np.random.default_rng(0))
    assert 0.0 < np.abs(episode(generator(9, near)[0])[:5] - first[:5]).max() < 0.1
    # What is read beyond a point is drawn by the seed.
    rng, longer = generator(9, point.z)
    episode(rng)
    assert rng.normal() == np.random.default_rng(9).standard_normal()
    np.testing.assert_array_equal(longer.z[:6], point.z)


def test_moves_keep_the_standard_normal_distribution_and_most_discrete_draws():
    rng = np.random.default_rng(0)
    z, is_discrete = rng.standard_normal(NUMBER), np.arange(NUMBER) < 1000
    new = moved(z, is_discrete, 0.6, rng)
    assert kstest(new, "norm").pvalue > 1e-3
    assert np.corrcoef(z[1000:], new[1000:])[0, 1] == pytest.approx(0.8, abs=0.03)
    assert np.mean(z[:1000] == new[:1000]) == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(
    "draw", [lambda r: r.gamma(1.0), lambda r: r.choice(3, 2, False, [1, 0, 0])]
)
def test_what_has_no_inverse_is_refused_by_name(draw):
    with pytest.raises(ValueError, match=r"methods .*'uniform'.*; got '(gamma|choice)"):
        draw(generator()[0])
