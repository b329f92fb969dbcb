"""Gradient-boosted trees: learned by scikit-learn, evaluated in numpy without it."""

from __future__ import annotations

from typing import Any

import numpy as np

from drake_safety.learning.trained_maps import INPUT_LIMIT, are_usable

MOST_TREES = 300
MOST_LEAVES = 31
_WITHOUT_GAIN = 20
"""Trees that may follow without a gain on the held-out inputs."""
_NUM_BINS = 255
_CHUNK = 16  # Rows, whose comparisons fit into the cache.


class Trees:
    """An immutable sum of T decision trees: a logit of an unsafe end.

    At a node with ``x[feature] > threshold``, in single precision, an input goes to the right: the
    node excludes the leaves on its left. The first leaf that no node excludes is reached
    ("QuickScorer", Lucchese et al., 2015).

    Args:
        feature: Columns of x that the nodes compare, (M, T), M < 32.
        threshold: Thresholds of the nodes, (M, T); infinite for absent nodes.
        left: Leaves to the left of the nodes as bits, the lowest for the first leaf, (M, T).
        value: Terms of the logit by leaf, (T, M + 1).
    """

    def __init__(
        self, *, feature: np.ndarray, threshold: np.ndarray, left: np.ndarray, value: np.ndarray
    ):
        self.arrays: dict[str, np.ndarray] = {
            "feature": feature.astype(np.uint16),
            "threshold": threshold.astype(np.float32),
            "left": left.astype(np.uint32),
            "value": value.astype(np.float32),
        }
        for array in self.arrays.values():
            array.setflags(write=False)
        self._feature, self._value = feature.astype(np.intp), value.astype(np.float32).astype(float)
        self._first = np.arange(len(value)) * value.shape[1]

    def __len__(self) -> int:
        """T."""
        return len(self._value)

    @classmethod
    def fit(
        cls,
        x: np.ndarray,
        is_unsafe: np.ndarray,
        weight: np.ndarray,
        *,
        seed: int,
        is_held_out: np.ndarray | None = None,
        num_trees: int = MOST_TREES,
    ) -> Trees:
        """Learns from finite inputs x (N, n_x) with both labels, deterministically for a seed.

        With held-out inputs, `num_trees` is the largest number of trees; it is chosen on these.
        """
        from sklearn.ensemble import HistGradientBoostingClassifier
        from threadpoolctl import threadpool_limits

        known = x if is_held_out is None else x[~is_held_out]
        data = binned(x, like=known), is_unsafe, weight
        learned, judged = data, (None, None, None)
        if is_held_out is not None:
            learned = tuple(part[~is_held_out] for part in data)
            judged = tuple(part[is_held_out] for part in data)
        model = HistGradientBoostingClassifier(
            learning_rate=0.1,
            max_iter=num_trees,
            max_leaf_nodes=MOST_LEAVES,
            min_samples_leaf=40,
            l2_regularization=1.0,
            max_features=0.5,
            early_stopping=is_held_out is not None,
            n_iter_no_change=_WITHOUT_GAIN,
            random_state=seed,
        )
        with threadpool_limits(1):
            model.fit(*learned, X_val=judged[0], y_val=judged[1], sample_weight_val=judged[2])
        if is_held_out is not None:
            num_trees = max(1, int(np.argmax(model.validation_score_)))
        return cls._of(model, num_trees)

    @classmethod
    def _of(cls, model: Any, num_trees: int) -> Trees:
        """The first trees of scikit-learn's `HistGradientBoostingClassifier`."""
        shape = MOST_LEAVES - 1, num_trees
        feature, left = np.zeros(shape, dtype=np.intp), np.zeros(shape, dtype=np.int64)
        threshold, value = np.full(shape, np.inf), np.zeros((num_trees, MOST_LEAVES))
        # The public interface gives neither trees nor the first guess.
        for tree, (predictor,) in enumerate(model._predictors[:num_trees]):
            nodes = predictor.nodes
            is_leaf = nodes["is_leaf"] > 0
            # A node comes before its left subtree, and that before its right one.
            first_leaf = np.cumsum(is_leaf) - is_leaf
            split = nodes[~is_leaf]
            rows = slice(len(split)), tree
            feature[rows], threshold[rows] = split["feature_idx"], split["num_threshold"]
            left[rows] = (1 << first_leaf[split["right"]]) - (1 << first_leaf[~is_leaf])
            value[tree, : len(split) + 1] = nodes["value"][is_leaf]
        value[0] += model._baseline_prediction.item()
        # The largest number of single precision that is not above: the same decisions.
        single = threshold.astype(np.float32)
        below = np.nextafter(single, np.float32(-np.inf))
        single = np.where(single > threshold, below, single)
        return cls(feature=feature, threshold=single, left=left, value=value)

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Returns the logit (N,) at inputs (N, n_x), whatever the others; NaN if not finite."""
        if not are_usable(x):
            is_usable = (np.abs(x) < INPUT_LIMIT).all(axis=1)  # False for NaN.
            if not is_usable.all():
                logit = np.full(len(x), np.nan)
                logit[is_usable] = self.evaluate(x[is_usable])
                return logit
        if len(x) > _CHUNK:
            parts = [self.evaluate(x[i : i + _CHUNK]) for i in range(0, len(x), _CHUNK)]
            return np.concatenate(parts)
        is_right = x.astype(np.float32).take(self._feature, axis=1) > self.arrays["threshold"]
        excluded = np.bitwise_or.reduce(is_right * self.arrays["left"], axis=1)
        # The lowest bit that is not set.
        leaf = np.frexp(~excluded & (excluded + 1))[1] - 1
        return np.add.reduce(self._value.take(self._first + leaf), axis=1)


def binned(x: np.ndarray, *, like: np.ndarray) -> np.ndarray:
    """Moves inputs x (N, n_x) to the nearest of 255 quantiles of each column of `like`.

    scikit-learn then splits between these, as it does by itself. With sample weights it would look
    for each quantile singly, which takes longer than learning.
    """
    x, like = x.astype(np.float32), like.astype(np.float32)
    shares, moved = np.linspace(0.0, 1.0, _NUM_BINS), np.empty_like(x)
    every = np.quantile(like, shares, axis=0, method="inverted_cdf")
    for column, quantiles in enumerate(every.T):
        values = np.unique(quantiles)
        middle = (values[1:].astype(float) + values[:-1]) / 2.0
        moved[:, column] = values[np.searchsorted(middle, x[:, column])]
    return moved
