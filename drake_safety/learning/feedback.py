"""Feedback from an actual robot: its episodes paired with nominal twins, split into segments."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.mode_settings import mode_settings
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import (
    DIVERGED,
    Episode,
    Episodes,
    EpisodesInfo,
    Segments,
    split,
    unsafety_score,
)

START_TOLERANCE = 1e-2
"""Tolerance of a twin's first true state: logged positions are not exact."""
_SAME_TASK = (
    *("scenario", "step_s", "horizon", "preview_stride"),
    *("state_names", "output_names", "feature_names"),
)
_logger = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodePair:
    """An actual episode and its nominal twin, from the same state along the same plan.

    Attributes:
        info: That of the actual episode.
        nominal_hash: Scenario hash of the nominal plant.
        twin_seed: Seed of the twin's set.
    """

    info: EpisodesInfo
    actual: Episode
    twin: Episode
    nominal_hash: str
    twin_seed: int

    @property
    def differs(self) -> bool:
        """Whether exactly one of the two episodes is safe."""
        return self.actual.is_safe != self.twin.is_safe

    @cached_property
    def rows(self) -> Segments:
        """Segments from every row of the actual episode but those at its end."""
        return split(Episodes(self.info, [self.actual]), stride=1, discount=1.0, shortest=1)


def pair_episodes(
    actual: Episodes, nominal: Episodes, *, nominal_hash: str | None = None
) -> list[EpisodePair]:
    """Pairs actual episodes with their nominal twins by index, without diverged pairs.

    Args:
        nominal: The twins; further episodes are ignored.
        nominal_hash: Scenario hash of the nominal plant, if the twins' hash also covers the options
            of the pairs; the twins' hash by default.
    """
    who = f"feedback of '{actual.info.scenario}'"
    for name in _SAME_TASK:
        here, there = getattr(actual.info, name), getattr(nominal.info, name)
        if here != there:
            raise ValueError(
                f"feedback: actual and nominal episodes differ in {name}: {here} and {there}"
            )
    twins = {episode.index: episode for episode in nominal}
    pairs = []
    for episode in actual:
        if (twin := twins.get(episode.index)) is None:
            raise ValueError(
                f"{who}: episode {episode.index} of the variation '{actual.info.variation}' has no "
                f"nominal twin; there are {len(twins)} twins"
            )
        apart = np.abs(episode.true_state[0] - twin.true_state[0]).max(initial=0.0)
        if not apart <= START_TOLERANCE:
            raise ValueError(
                f"{who}: the twin of episode {episode.index} starts in another state; their first "
                f"states differ by {apart:.3g}"
            )
        if DIVERGED in (episode.cause, twin.cause):
            _logger.info("pair %d of '%s' diverged", episode.index, actual.info.scenario)
        elif all(one.num_steps > one.first_step for one in (episode, twin)):
            pairs.append(
                EpisodePair(
                    info=actual.info,
                    actual=episode,
                    twin=twin,
                    nominal_hash=nominal_hash or nominal.info.scenario_hash,
                    twin_seed=nominal.info.seed,
                )
            )
    return pairs


def check_feedback(feedback: Sequence[EpisodePair], learned: EpisodesInfo) -> None:
    """Checks that feedback is of the scenario that an assessment was trained on."""
    if not feedback:
        raise ValueError(f"feedback of '{learned.scenario}': got none, expected at least one pair")
    for pair in feedback:
        sides = {
            name: (getattr(pair.info, name), getattr(learned, name))
            for name in (*_SAME_TASK, "constraint_names")
        }
        sides["the nominal twin's scenario hash"] = (pair.nominal_hash, learned.scenario_hash)
        for what, (got, expected) in sides.items():
            if got != expected:
                raise ValueError(
                    f"pair {pair.actual.index} and the assessment differ in {what}: the feedback "
                    f"has {got}, the assessment was trained with {expected}"
                )


def used_episodes(feedback: Sequence[EpisodePair]) -> list[UsedEpisodes]:
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


@dataclass(kw_only=True, eq=False)
class FeedbackSegments(Segments):
    """Segments of actual episodes, beside what became of their twins.

    Attributes:
        nominal_score: lambda of the twin, (N,).
        nominal_is_unsafe: Whether the twin ended unsafely, (N,).
    """

    nominal_score: np.ndarray
    nominal_is_unsafe: np.ndarray


def feedback_segments(
    feedback: Sequence[EpisodePair], parameters: AssessmentParameters
) -> FeedbackSegments:
    """Splits actual episodes into segments as training episodes are split.

    A twin that has left the safe set before a segment starts scores 1 there. As in training, an
    unsafe episode has segments only where a complete one has them.
    """
    settings, discount = mode_settings(parameters), parameters.discount
    parts = []
    for position, pair in enumerate(feedback):
        rows, sample = pair.rows, pair.info.preview_stride
        since_start = rows.start_row - pair.actual.first_step
        left = rows.remaining_steps
        if not pair.actual.is_safe:
            left = np.maximum(left, pair.info.num_steps - since_start)
        is_taken = (since_start % settings.stride == 0) & (left >= settings.shortest * sample)
        taken = rows.take(is_taken)
        is_unsafe = np.full(len(taken), not pair.twin.is_safe)
        remaining = np.maximum(pair.twin.num_steps - taken.start_row, 0)
        taken = replace(
            taken,
            episode=np.full(len(taken), position),
            score=unsafety_score(taken.remaining_steps / sample, taken.is_unsafe, discount),
        )
        if settings.uses_true_state and pair.info.variation == "nominal":
            taken = replace(taken, state=taken.true_state)
        parts.append(
            FeedbackSegments(
                **vars(taken),
                nominal_score=unsafety_score(remaining / sample, is_unsafe, discount),
                nominal_is_unsafe=is_unsafe,
            )
        )
    segments = FeedbackSegments(
        **{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    )
    if not len(segments):
        raise ValueError(
            f"feedback of '{feedback[0].info.scenario}': none of {len(feedback)} pairs has a "
            f"segment of {settings.shortest} samples"
        )
    return segments
