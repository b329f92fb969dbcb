"""Ablations: variants of the assessment, each trained with one choice changed.

All variants learn from the same stored episodes and are evaluated at the same rows of the same
fresh ones, whatever inputs they use.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import (
    Bootstrap,
    Estimate,
    auc,
    auc_difference,
    segment_estimates,
    threshold_at,
)
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.segments import Episodes, Segments, split
from drake_safety.simulation.dataset import load_episodes

BASELINE = "baseline"
_SCORE_WEIGHTS = (0.0, 0.001, 0.01, 0.1, 0.3)
_PERPLEXITIES = (10.0, 30.0, 60.0)
_RESOLUTIONS = (7, 14, 20, 28, 40)
_MIN_COUNTS = (1, 5, 20, 50)
_HORIZON_SHARES = (0.2, 0.5)
_EPISODE_SHARES = (0.125, 0.25, 0.5)
# The variants of a quick ablation.
_QUICK = {
    "score_weight=0.1",
    "perplexity=10",
    "resolution=20",
    "min_count=20",
    "horizon=half",
    "episodes=half",
}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A variant with one choice changed.

    Attributes:
        name: Its key.
        group: The choice.
        changes: Parameters that differ from those of the baseline.
        num_episodes: Number of training episodes; None for all.
        without: Omitted states and features.
    """

    name: str
    group: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    num_episodes: int | None = None
    without: Sequence[str] = ()

    def parameters(self, base: AssessmentParameters) -> AssessmentParameters:
        """The parameters of the baseline with the changes."""
        return replace(copy.deepcopy(base), **self.changes)

    def recut(self, episodes: Episodes, horizon: int) -> Episodes:
        """The episodes with the inputs of the variant.

        A shorter horizon uses the beginning of the recorded preview.

        Args:
            episodes: The recorded episodes.
            horizon: Horizon of the variant, at most the recorded one.
        """
        info = episodes.info
        states = _kept(info.state_names, self.without)
        features = _kept(info.feature_names, self.without)
        num_preview = horizon * len(info.output_names)
        return Episodes(
            replace(
                info,
                horizon=horizon,
                state_names=[info.state_names[i] for i in states],
                feature_names=[info.feature_names[i] for i in features],
            ),
            [
                replace(
                    episode,
                    state=episode.state[:, states],
                    true_state=episode.true_state[:, states],
                    features=episode.features[:, features],
                    desired_preview=episode.desired_preview[:, :num_preview],
                )
                for episode in episodes
            ],
        )


def _kept(names: Sequence[str], without: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if name not in without]


def list_variants(
    base: AssessmentParameters,
    num_episodes: int,
    *,
    state_names: Sequence[str],
    rate_names: Sequence[str],
    quick: bool = False,
) -> tuple[list[Variant], dict[str, str]]:
    """The variants, the baseline first, and the choices that cannot be varied.

    Args:
        base: Parameters of the baseline.
        num_episodes: Number of training episodes.
        state_names: Columns of the state.
        rate_names: States and features that depend on velocities.
        quick: Whether to list one variant per choice.

    Returns:
        The variants, and the reasons of omitted choices.
    """
    found = [Variant(name=BASELINE, group=BASELINE)]

    def vary(group: str, name: str, values: Sequence[Any], **more: Sequence[Any]) -> None:
        for i, value in enumerate(values):
            if value != getattr(base, name):
                changes = {name: value, **{key: one[i] for key, one in more.items()}}
                found.append(Variant(name=f"{name}={value:g}", group=group, changes=changes))

    vary("score weight δ", "score_weight", _SCORE_WEIGHTS)
    shortened = {max(1, round(share * base.horizon)): share for share in _HORIZON_SHARES}
    for horizon, share in shortened.items():
        if horizon < base.horizon:
            found.append(
                Variant(
                    name="horizon=half" if share == 0.5 else f"horizon={horizon}",
                    group="horizon H",
                    changes={
                        "horizon": horizon,
                        "shortest_segment": min(base.shortest_segment, horizon),
                    },
                )
            )
    vary("perplexity", "perplexity", _PERPLEXITIES)
    width = base.resolution * base.cell_length
    lengths = [width / resolution for resolution in _RESOLUTIONS]
    vary("resolution", "resolution", _RESOLUTIONS, cell_length=lengths)
    vary("k_min", "min_count", _MIN_COUNTS)
    for share in _EPISODE_SHARES:
        count = round(share * num_episodes)
        name = "episodes=half" if share == 0.5 else f"episodes={count}"
        if count:
            found.append(Variant(name=name, group="episodes", num_episodes=count))
    left_out = {"horizon H": "longer horizons need a longer recorded preview"}
    rates = [name for name in rate_names if name in state_names]
    if rates:
        found.append(Variant(name="state_without_velocities", group="velocities", without=rates))
        if len(rates) < len(rate_names):
            found.append(
                Variant(name="without_velocities", group="velocities", without=list(rate_names))
            )
    else:
        left_out["velocities"] = "none of the states is known to be a velocity"
    if base.is_sharpened:
        found.append(Variant(name="paper", group="mode", changes={"mode": "paper"}))
        # The paper's mode depends strongly on its score weight.
        found.append(
            Variant(
                name="paper_score_weight=0.1",
                group="mode",
                changes={"mode": "paper", "score_weight": 0.1},
            )
        )
    if quick:
        groups = ("baseline", "velocities", "mode")
        found = [one for one in found if one.name in _QUICK or one.group in groups]
    return found, left_out


@dataclass(frozen=True, kw_only=True)
class EpisodeSet:
    """The first episodes of a folder.

    Attributes:
        path: The folder.
        count: Number of episodes.
    """

    path: str | os.PathLike[str]
    count: int

    def load(self) -> Episodes:
        """Loads the episodes, once per process."""
        return _loaded(os.fspath(self.path))[: self.count]


@lru_cache(maxsize=3)
def _loaded(path: str) -> Episodes:
    return load_episodes(path)


@dataclass(frozen=True, kw_only=True, eq=False)
class VariantScores:
    """Unsafe scores 1 - Γ of a variant on fresh segments.

    Attributes:
        calibration: Scores of the calibration set, 1 - safe share of the belief, (M,).
        test: Scores of the test set, likewise, (N,).
        calibrated: Scores of the test set by the probability, (N,).
    """

    calibration: np.ndarray
    test: np.ndarray
    calibrated: np.ndarray


@dataclass(frozen=True, kw_only=True)
class AblationSets:
    """The episodes of all variants.

    Attributes:
        training: Training episodes.
        calibration: Fresh episodes for thresholds.
        test: Other fresh episodes.
    """

    training: EpisodeSet
    calibration: EpisodeSet
    test: EpisodeSet


def unsafe_scores(
    variant: Variant, base: AssessmentParameters, sets: AblationSets
) -> VariantScores:
    """Trains a variant and scores the fresh segments.

    Args:
        variant: The variant.
        base: Parameters of the baseline.
        sets: The episodes.

    Raises:
        ValueError: There are too few episodes to train the variant.
    """
    parameters = variant.parameters(base)
    training = sets.training.load()
    if variant.num_episodes is not None:
        training = training[: variant.num_episodes]
    assessment = SafetyAssessment(parameters).fit(variant.recut(training, parameters.horizon))
    found = []
    for episodes in (sets.calibration.load(), sets.test.load()):
        # All variants are evaluated at the rows of the baseline.
        segments = judged_segments(episodes, base)
        info = episodes.info
        states = _kept(info.state_names, variant.without)
        features = _kept(info.feature_names, variant.without)
        state = segments.state if parameters.is_sharpened else segments.true_state
        result = assessment.predict(
            state[:, states],
            segments.desired_preview[:, : parameters.horizon * len(info.output_names)],
            segments.features[:, features] if assessment.uses_features else None,
        )
        found.append(result)
    seen, judged = found
    return VariantScores(
        calibration=1.0 - safe_share(seen.belief),
        test=1.0 - safe_share(judged.belief),
        calibrated=1.0 - judged.probability,
    )


def judged_segments(episodes: Episodes, base: AssessmentParameters) -> Segments:
    """The segments of fresh episodes at which all variants are evaluated."""
    return split(episodes, stride=1, discount=1.0, shortest=base.shortest)


def variant_estimates(
    scores: VariantScores,
    baseline_score: np.ndarray,
    calibration: Segments,
    test: Segments,
    *,
    bootstrap: Bootstrap | None = None,
) -> dict[str, Estimate]:
    """Estimates of a variant, and of its gain over the baseline.

    Args:
        scores: Unsafe scores of M and N segments.
        baseline_score: Unsafe scores of the baseline on the test set, (N,).
        calibration: The M segments.
        test: The N segments.
        bootstrap: Settings of the intervals.

    Returns:
        `auc`, `safe_recall`, `unsafe_recall`, `brier` and `auc_gain` of all segments, and "k0.…" of
        the first of each episode; `calibrated_auc` is that of the probability. Recalls are at
        the threshold of best balanced accuracy.
    """
    bootstrap = bootstrap or Bootstrap()
    calibration_score, score = scores.calibration, scores.test
    estimates: dict[str, Estimate] = {}
    rows_of = {
        "": (np.ones(len(test), dtype=bool), np.ones(len(calibration), dtype=bool)),
        "k0.": (test.is_first, calibration.is_first),
    }
    for prefix, (rows, seen) in rows_of.items():
        threshold = threshold_at(calibration_score[seen], calibration.is_unsafe[seen])
        found = segment_estimates(
            test.take(rows), score[rows], threshold=threshold, bootstrap=bootstrap
        )
        found["auc_gain"] = auc_difference(
            score[rows],
            baseline_score[rows],
            test.is_unsafe[rows],
            test.episode[rows],
            bootstrap=bootstrap,
        )
        found["calibrated_auc"] = auc(
            scores.calibrated[rows], test.is_unsafe[rows], test.episode[rows], bootstrap=bootstrap
        )
        estimates |= {f"{prefix}{key}": estimate for key, estimate in found.items()}
    return estimates
