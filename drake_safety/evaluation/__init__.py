"""How good an assessment is: figures with intervals, direct classifiers beside it, and pictures."""
