"""Feedback from an actual robot: its episodes paired with nominal twins, split into segments."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import DIVERGED, Episodes, EpisodesInfo, split, unsafety_score

START_TOLERANCE = 1e-2
"""Tolerance of a twin's first true state: logged positions are not exact."""
_logger = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True, eq=False)
class FeedbackSet:
    """An actual episode and its nominal twin from the same state along the same plan.

    Holds what adaptation needs: the inputs x at every start row of the actual episode and at the
    twin's first row, and the end of both.

    Attributes:
        state: Measured state, (N, n_s).
        true_state: State without observation noise, (N, n_s).
        desired_preview: Desired outputs over the horizon, (N, H*n_z).
        features: Features, (N, n_f).
        steps_since_start: Rows from the episode's `first_step` to each start, (N,).
        remaining_steps: Rows until the actual episode ends, (N,).
        nominal_remaining_steps: Rows until the twin ends, (N,); 0 after its end.
        twin_state: Measured state at the twin's first row, (n_s,).
        twin_desired_preview: Desired preview at the twin's first row, (H*n_z,).
        twin_features: Features at the twin's first row, (n_f,).
        cause: Column of the constraint that ended the actual episode, -1 when safe.
    """

    info: EpisodesInfo
    nominal_hash: str
    twin_seed: int
    index: int
    state: np.ndarray
    true_state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    steps_since_start: np.ndarray
    remaining_steps: np.ndarray
    nominal_remaining_steps: np.ndarray
    twin_state: np.ndarray
    twin_desired_preview: np.ndarray
    twin_features: np.ndarray
    is_unsafe: bool
    nominal_is_unsafe: bool
    cause: int

    def __len__(self) -> int:
        return len(self.remaining_steps)

    @property
    def differs(self) -> bool:
        """Whether exactly one of the two episodes is safe."""
        return self.is_unsafe != self.nominal_is_unsafe


def feedback_sets(
    actual: Episodes, nominal: Episodes, *, nominal_hash: str | None = None
) -> list[FeedbackSet]:
    """Pairs actual episodes with their nominal twins by index, without diverged pairs.

    Args:
        nominal: The twins; further episodes are ignored.
        nominal_hash: Scenario hash of the nominal plant, if the twins' hash also covers the options
            of the pairs; the twins' hash by default.
    """
    _check_same_task(actual.info, nominal.info)
    twins = {episode.index: episode for episode in nominal}
    sets = []
    for episode in actual:
        twin = twins.get(episode.index)
        if twin is None:
            raise ValueError(
                f"feedback of '{actual.info.scenario}': episode {episode.index} of the variation "
                f"'{actual.info.variation}' has no nominal twin; there are {len(twins)} twins"
            )
        apart = np.abs(episode.true_state[0] - twin.true_state[0]).max(initial=0.0)
        if not apart <= START_TOLERANCE:
            raise ValueError(
                f"feedback of '{actual.info.scenario}': the twin of episode {episode.index} starts "
                f"in another state; their first states differ by {apart:.3g}"
            )
        if DIVERGED in (episode.cause, twin.cause):
            _logger.info("pair %d of '%s' diverged", episode.index, actual.info.scenario)
            continue
        if any(one.num_steps == one.first_step for one in (episode, twin)):
            continue
        segments = split(Episodes(actual.info, [episode]), stride=1, discount=1.0, shortest=1)
        sets.append(
            FeedbackSet(
                info=actual.info,
                nominal_hash=nominal_hash or nominal.info.scenario_hash,
                twin_seed=nominal.info.seed,
                index=episode.index,
                state=segments.state,
                true_state=segments.true_state,
                desired_preview=segments.desired_preview,
                features=segments.features,
                steps_since_start=segments.start_row - episode.first_step,
                remaining_steps=segments.remaining_steps,
                nominal_remaining_steps=np.maximum(twin.num_steps - segments.start_row, 0),
                twin_state=twin.state[twin.first_step],
                twin_desired_preview=twin.desired_preview[twin.first_step],
                twin_features=twin.features[twin.first_step],
                is_unsafe=not episode.is_safe,
                nominal_is_unsafe=not twin.is_safe,
                cause=int(segments.cause[0]),
            )
        )
    return sets


def _check_same_task(actual: EpisodesInfo, nominal: EpisodesInfo) -> None:
    for name in (
        "scenario",
        "step_s",
        "horizon",
        "preview_stride",
        "state_names",
        "output_names",
        "feature_names",
    ):
        here, there = getattr(actual, name), getattr(nominal, name)
        if here != there:
            raise ValueError(
                f"feedback: actual and nominal episodes differ in {name}: {here} and {there}"
            )


def check_feedback(feedback: Sequence[FeedbackSet], learned: EpisodesInfo) -> None:
    """Checks that feedback is of the scenario that an assessment was trained on."""
    if not feedback:
        raise ValueError(f"feedback of '{learned.scenario}': got none, expected at least one set")
    for one in feedback:
        sides = {
            name: (getattr(one.info, name), getattr(learned, name))
            for name in (
                "scenario",
                "step_s",
                "horizon",
                "preview_stride",
                "constraint_names",
                "state_names",
                "output_names",
                "feature_names",
            )
        }
        sides["the nominal twin's scenario hash"] = (one.nominal_hash, learned.scenario_hash)
        for what, (got, expected) in sides.items():
            if got != expected:
                raise ValueError(
                    f"feedback set {one.index} and the assessment differ in {what}: the feedback "
                    f"has {got}, the assessment was trained with {expected}"
                )


def used_episodes(feedback: Sequence[FeedbackSet]) -> list[UsedEpisodes]:
    """Returns the sets of actual and twin episodes in feedback."""
    sides = [(one.info.variation, one.info.scenario_hash, one.info.seed) for one in feedback]
    sides += [("nominal", one.nominal_hash, one.twin_seed) for one in feedback]
    return [
        UsedEpisodes(
            purpose="adaptation",
            variation=variation,
            scenario_hash=scenario_hash,
            seed=seed,
            num_episodes=count,
        )
        for (variation, scenario_hash, seed), count in Counter(sides).items()
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class FeedbackSegments:
    """Segments of several feedback sets.

    Attributes:
        state: State in x, (N, n_s).
        desired_preview: Desired outputs over the horizon, (N, H*n_z).
        features: Features, (N, n_f).
        score: lambda of the actual episode, (N,).
        nominal_score: lambda of the twin, (N,).
        is_unsafe: Whether the actual episode ended unsafely, (N,).
        nominal_is_unsafe: Whether the twin ended unsafely, (N,).
        cause: Column of the constraint that ended the actual episode, -1 when safe, (N,).
    """

    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    score: np.ndarray
    nominal_score: np.ndarray
    is_unsafe: np.ndarray
    nominal_is_unsafe: np.ndarray
    cause: np.ndarray

    def __len__(self) -> int:
        return len(self.score)


def segments_of(
    feedback: Sequence[FeedbackSet], *, stride: int, shortest: int, discount: float, plain: bool
) -> FeedbackSegments:
    """Splits feedback sets into segments as training episodes are split.

    A twin that has left the safe set before a segment starts scores 1 there.

    Args:
        shortest: Least number of samples of a safe episode's segment.
        plain: Whether to use the state without noise for "actual" episodes of the nominal plant, as
            in training in the paper's mode.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in FeedbackSegments.__annotations__}
    for one in feedback:
        sample = one.info.preview_stride
        is_taken = one.steps_since_start % stride == 0
        left = one.remaining_steps
        if one.is_unsafe:
            # As in training, an unsafe episode has segments only where a complete one has them.
            left = np.maximum(left, one.info.num_steps - one.steps_since_start)
        is_taken &= left >= shortest * sample
        rows = np.flatnonzero(is_taken)
        is_unsafe = np.full(rows.size, one.is_unsafe)
        nominal_is_unsafe = np.full(rows.size, one.nominal_is_unsafe)
        state = one.true_state if plain and one.info.variation == "nominal" else one.state
        piece = {
            "state": state[rows],
            "desired_preview": one.desired_preview[rows],
            "features": one.features[rows],
            "score": unsafety_score(one.remaining_steps[rows] / sample, is_unsafe, discount),
            "nominal_score": unsafety_score(
                one.nominal_remaining_steps[rows] / sample, nominal_is_unsafe, discount
            ),
            "is_unsafe": is_unsafe,
            "nominal_is_unsafe": nominal_is_unsafe,
            "cause": np.full(rows.size, one.cause),
        }
        for name, values in piece.items():
            parts[name].append(values)
    segments = FeedbackSegments(**{name: np.concatenate(values) for name, values in parts.items()})
    if not len(segments):
        raise ValueError(
            f"feedback of '{feedback[0].info.scenario}': none of {len(feedback)} sets has a "
            f"segment of {shortest} samples"
        )
    return segments
