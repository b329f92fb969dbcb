import numpy as np
import pytest

from drake_safety.learning.causes import NO_CAUSE, cause_words, likely_causes


def test_smallest_relative_margin_outweighs_the_mass():
    masses, margins = np.array([[0.6, 0.1]]), np.array([[-0.01, -0.02]])
    np.testing.assert_array_equal(likely_causes(masses, margins), [1])
    # One is a length and counts in centimetres, the other an angle and counts in tenths.
    np.testing.assert_array_equal(likely_causes(masses, margins, np.array([0.01, 0.1])), [0])


def test_without_margins_the_mass_decides():
    masses = np.array([[0.1, 0.3], [0.0, 0.0], [0.3, 0.1]])
    margins = np.array([[np.nan, np.nan], [np.nan, np.nan], [np.nan, 0.02]])
    np.testing.assert_array_equal(likely_causes(masses, margins), [1, NO_CAUSE, 1])
    np.testing.assert_array_equal(likely_causes(np.zeros((2, 0)), np.zeros((2, 0))), [NO_CAUSE] * 2)


@pytest.mark.parametrize(
    ("name", "margin", "is_known", "words"),
    [
        ("shelf", -0.012, True, ("likely cause", "shelf, -1.2 cm")),
        ("shelf", 0.01, True, ("nearest to its limit", "shelf, +1.0 cm")),
        ("", np.nan, True, ("", "")),
    ],
)
def test_words_of_a_cause(name, margin, is_known, words):
    assert cause_words(name, margin, (), is_known=is_known) == words
