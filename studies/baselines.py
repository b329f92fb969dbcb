"""Baseline classifiers: direct classification of the inputs of the assessment."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, area_under_curve, mean
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer
from drake_safety.files.progress import StageProgress
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import Episodes, Segments, split

KINDS = ("gradient_boosting", "mlp")
_VALIDATION_SHARE = 0.1
_MLP_EPOCHS = 60
_MLP_PATIENCE = 20
Statistic = Callable[[np.ndarray], float]  # Weights of samples.


class DirectClassifier:
    """Predicts from x whether an episode ends unsafely, without embedding or beliefs.

    It learns from the assessment's segments: every start row, labelled by the end of its episode.
    It stops early by a held-out tenth of the *episodes* and plants, and runs on one thread, so that
    the same seed gives the same bits.
    """

    def __init__(self, kind: str, *, seed: int = 0, shortest: int | None = None):
        self.kind, self.seed, self.shortest = kind, seed, shortest

    def fit(self, episodes: Episodes) -> DirectClassifier:
        """Fits the classifier to episodes, at least two of either kind, and returns it."""
        from threadpoolctl import threadpool_limits

        segments = split(episodes, stride=1, discount=1.0, shortest=self.shortest)
        x = self._inputs(segments.state, segments.desired_preview, segments.features)
        is_held_out = self._held_out(segments)
        with threadpool_limits(1):
            train = self._boost if self.kind == "gradient_boosting" else self._train_mlp
            train(
                x[~is_held_out],
                segments.is_unsafe[~is_held_out],
                x[is_held_out],
                segments.is_unsafe[is_held_out],
            )
        return self

    def predict_unsafe(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None = None
    ) -> np.ndarray:
        """Probability of an unsafe end, (N,); NaN for an input that is not finite."""
        from threadpoolctl import threadpool_limits

        x = self._inputs(state, desired_preview, features)
        probability = np.full(len(x), np.nan)
        is_finite = np.isfinite(x).all(axis=1)
        if is_finite.any():
            known = x[is_finite]
            if self.kind == "mlp":
                known = self._standardised(known)
            with threadpool_limits(1):
                probability[is_finite] = self.model_.predict_proba(known)[:, 1]
        return probability

    def _inputs(
        self, state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray | None
    ) -> np.ndarray:
        parts = [state, desired_preview, *([] if features is None else [features])]
        return np.concatenate([np.asarray(part, dtype=np.float32) for part in parts], axis=1)

    def _held_out(self, segments: Segments) -> np.ndarray:
        """Mask of the segments of held-out episodes and plants, (N,)."""
        rng = np.random.default_rng(self.seed)
        chosen = []
        for is_class in (~segments.is_unsafe, segments.is_unsafe):
            members = np.unique(segments.group[is_class])
            count = max(1, round(_VALIDATION_SHARE * len(members)))
            chosen.append(rng.choice(members, size=count, replace=False))
        return np.isin(segments.group, np.concatenate(chosen))

    def _boost(
        self, x: np.ndarray, label: np.ndarray, x_held_out: np.ndarray, label_held_out: np.ndarray
    ) -> None:
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(
            learning_rate=0.1,
            max_iter=400,
            min_samples_leaf=40,
            l2_regularization=1.0,
            max_features=0.5,
            early_stopping=True,
            n_iter_no_change=20,
            random_state=self.seed,
        )
        self.model_: Any = model.fit(x, label, X_val=x_held_out, y_val=label_held_out)

    def _train_mlp(
        self, x: np.ndarray, label: np.ndarray, x_held_out: np.ndarray, label_held_out: np.ndarray
    ) -> None:
        from sklearn.neural_network import MLPClassifier

        spread = x.std(axis=0, dtype=float)
        self.mean_ = x.mean(axis=0, dtype=float)
        # A column that is constant in training must not be scaled up elsewhere.
        self.scale_ = np.where(spread > 1e-9, spread, 1.0)
        x, x_held_out = self._standardised(x), self._standardised(x_held_out)
        model = MLPClassifier(
            hidden_layer_sizes=(128, 128),
            alpha=0.3,
            batch_size=min(256, len(x)),
            learning_rate_init=1e-3,
            random_state=self.seed,
        )
        best, smallest_error, waited = None, np.inf, 0
        for _ in range(_MLP_EPOCHS):
            model.partial_fit(x, label, classes=[False, True])
            # The log loss would stop an overconfident net whose ranking still improves.
            error = np.mean((model.predict_proba(x_held_out)[:, 1] - label_held_out) ** 2)
            waited += 1
            if error < smallest_error:
                smallest_error, waited = error, 0
                best = [w.copy() for w in (*model.coefs_, *model.intercepts_)]
            if waited == _MLP_PATIENCE:
                break
        if best is not None:
            num_layers = len(model.coefs_)
            model.coefs_, model.intercepts_ = best[:num_layers], best[num_layers:]
        self.model_ = model

    def _standardised(self, x: np.ndarray) -> np.ndarray:
        # Double precision: the penalty drives unused weights into slow subnormal float32.
        return (x - self.mean_) / self.scale_


def classifier_scorers(
    episodes: Episodes,
    progress: StageProgress,
    *,
    shortest: int | None = None,
    seeds: Sequence[int] = (0,),
) -> list[Scorer]:
    """The baseline classifiers, trained on the training episodes of the assessment."""
    scorers = []
    wanted = list(itertools.product(KINDS, seeds))
    for i, (kind, seed) in enumerate(wanted):
        progress("baseline classifiers", i, len(wanted))
        classifier = DirectClassifier(kind, seed=seed, shortest=shortest).fit(episodes)

        def probability(
            *inputs: np.ndarray, predict_unsafe: Any = classifier.predict_unsafe
        ) -> np.ndarray:
            return 1.0 - predict_unsafe(*inputs)

        used = [UsedEpisodes.of("training", episodes.info, len(episodes))]
        name = kind if len(seeds) == 1 else f"{kind}_{seed}"
        scorers.append(Scorer(name=name, probability=probability, used=used))
    progress("baseline classifiers", len(wanted), len(wanted))
    return scorers


def _ahead(own: Statistic, others: Sequence[Statistic], weight: np.ndarray) -> float:
    area = own(weight)
    return float(np.mean([area - other(weight) for other in others]))


def classifier_differences(
    gamma: Scorer, classifiers: Sequence[Scorer], test: Episodes
) -> dict[Key, Estimate]:
    """Γ minus the classifiers of each kind, on every row and on the first rows of fresh episodes.

    The AUC and the Brier score of a kind are means over its seeds; intervals are of paired
    resamples of the episodes.
    """
    segments = split(test, stride=1, discount=1.0, shortest=1)
    scores = {one.name: one.unsafe_score(segments) for one in (gamma, *classifiers)}
    found = {}
    every = np.ones(len(segments), dtype=bool)
    for place, rows in {"rows": every, "first": segments.is_first}.items():
        label, episode = segments.is_unsafe[rows], segments.episode[rows]
        own = scores[gamma.name][rows]
        own_area = area_under_curve(own, label)
        for kind in KINDS:
            others = [one[rows] for name, one in scores.items() if name.startswith(kind)]
            areas = [area_under_curve(other, label) for other in others]
            ahead = partial(_ahead, own_area, areas)
            found[f"difference.{place}", kind, "auc"] = Bootstrap().over_episodes(ahead, episode)
            error = np.mean([(other - label) ** 2 for other in others], axis=0)
            found[f"difference.{place}", kind, "brier"] = mean(
                (own - label) ** 2 - error, episode, bootstrap=Bootstrap()
            )
    return found
