"""Whether more training episodes would help: a classifier learns from a part of them and from all.

Gradient boosting ranks about as well as Γ and learns in seconds, so it stands for Γ here.
"""

from __future__ import annotations

import math

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.segments import Episodes, split

_NUM_FOLDS = 5
_NUM_ROWS = 6  # Of an episode: its rows are alike.
_LEAST_EPISODES = 4 * _NUM_FOLDS  # Of either label, so that a quarter of any four folds has some.
_MATTERS = 0.05  # Share of the area over the ROC curve that the last doubling closes, if it helps.


def learning_curve(episodes: Episodes, parameters: AssessmentParameters) -> np.ndarray:
    """AUC of gradient boosting on every fifth of the episodes, after learning from the others.

    It is for a quarter, half and all of the others, (3, 5); empty with few episodes of a label.
    """
    from sklearn import model_selection
    from sklearn.ensemble import HistGradientBoostingClassifier
    from threadpoolctl import threadpool_limits

    if min(episodes.num_unsafe, len(episodes) - episodes.num_unsafe) < _LEAST_EPISODES:
        return np.empty((3, 0))
    rows = split(episodes, stride=1, discount=1.0, shortest=1)
    order = np.lexsort([np.random.default_rng(0).random(len(rows)), ~rows.is_first, rows.episode])
    nth = np.arange(len(rows)) - np.searchsorted(rows.episode, rows.episode)
    rows = rows.take(np.sort(order[nth < _NUM_ROWS]))  # The first and others.
    boosting = HistGradientBoostingClassifier(
        max_leaf_nodes=15, max_features=0.5, early_stopping=False, random_state=0
    )
    # Threads that wait for each other are many times slower on a busy machine.
    with threadpool_limits(1):
        return model_selection.learning_curve(
            boosting,
            InputColumns(episodes.info, parameters).of_rows(rows),
            rows.is_unsafe,
            groups=rows.episode,
            train_sizes=[0.25, 0.5, 1.0],
            cv=model_selection.StratifiedGroupKFold(_NUM_FOLDS, shuffle=True, random_state=0),
            scoring="roc_auc",
        )[2]


def describe(area: np.ndarray) -> str:
    """One line: the held-out figures (3, 5) of :func:`learning_curve`, and what they mean."""
    if not area.size:
        return "too few episodes of either label to say whether more would help"
    values = np.array([*area, area[2] - area[0], area[2] - area[1]])
    spread = 2 * values.std(axis=1, ddof=1) / math.sqrt(area.shape[1])
    quarter, half, every, twice, doubling = values.mean(axis=1)
    answer = "too few episodes to tell whether more would help"
    if doubling > _MATTERS * (1.0 - every) and twice > spread[3]:
        answer = "more episodes would help"
    elif doubling + spread[4] < 2 * _MATTERS * (1.0 - every):
        answer = "more episodes would hardly help"
    return (
        f"{answer}: gradient boosting has an AUC of {quarter:.3f}, {half:.3f} and {every:.3f} (± "
        f"{spread[2]:.3f}) on held-out episodes, with a quarter, half and all of the others"
    )
