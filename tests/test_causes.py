import numpy as np
import pytest

from drake_safety.learning.causes import cause_words, likely_cause

NAMES = ["fall", "shelf"]


def test_smallest_relative_margin_outweighs_the_mass():
    masses, margins = np.array([0.6, 0.1]), np.array([-0.01, -0.02])
    assert likely_cause(NAMES, masses, margins) == "shelf"
    # One is a length and counts in centimetres, the other an angle and counts in tenths.
    assert likely_cause(NAMES, masses, margins, np.array([0.01, 0.1])) == "fall"
    assert likely_cause(NAMES, masses, np.array([np.nan, 0.02])) == "shelf"


def test_without_margins_the_mass_decides():
    unknown = np.full(2, np.nan)
    assert likely_cause(NAMES, np.array([0.1, 0.3]), unknown) == "shelf"
    assert likely_cause(NAMES, np.zeros(2), unknown) == ""


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
