import numpy as np
import pytest

from drake_safety.learning.causes import NO_CAUSE, cause_words, likely_causes

UNKNOWN = [np.nan, np.nan]


def test_the_smallest_predicted_margin_outweighs_the_mass():
    causes = likely_causes(np.array([[0.6, 0.1]]), np.array([[0.03, -0.01]]))
    np.testing.assert_array_equal(causes, [1])


def test_margins_are_compared_in_their_units():
    margins = np.array([[-0.01, -0.02]])
    masses = np.zeros((1, 2))
    np.testing.assert_array_equal(likely_causes(masses, margins), [1])
    # One is a length and counts in centimetres, the other an angle and counts in tenths.
    np.testing.assert_array_equal(likely_causes(masses, margins, np.array([0.01, 0.1])), [0])


def test_without_margins_the_mass_decides_and_without_either_nothing_is_named():
    masses = np.array([[0.1, 0.3], [0.0, 0.0], [0.3, 0.1]])
    margins = np.array([UNKNOWN, UNKNOWN, [np.nan, 0.02]])
    np.testing.assert_array_equal(likely_causes(masses, margins), [1, NO_CAUSE, 1])


def test_a_safe_set_without_constraints_has_no_cause():
    np.testing.assert_array_equal(likely_causes(np.zeros((2, 0)), np.zeros((2, 0))), [NO_CAUSE] * 2)


@pytest.mark.parametrize(
    ("margin", "is_known", "words"),
    [
        (-0.012, True, ("likely cause", "shelf, -1.2 cm")),
        (0.01, True, ("nearest to its limit", "shelf, +1.0 cm")),
        (-0.012, False, ("nearest to its limit", "shelf, -1.2 cm")),
        (np.nan, True, ("likely cause", "shelf")),
    ],
)
def test_what_keeps_its_limit_or_is_not_known_is_no_cause_of_a_violation(margin, is_known, words):
    assert cause_words("shelf", margin, (), is_known=is_known) == words


def test_without_a_cause_there_are_no_words():
    assert cause_words("", np.nan, ()) == ("", "")
