"""Feedback from an actual robot: its episodes paired with nominal twins, split into segments."""

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
    joined,
    split,
    unsafety_score,
)

START_TOLERANCE = 1e-2  # Error of a twin's first true state: logged positions are not exact.
_SAME_TASK = (
    *("scenario", "step_s", "horizon", "preview_stride"),
    *("state_names", "output_names", "feature_names"),
)
_LOGGER = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodePair:
    """An actual episode, with its metadata, and its nominal twin, from the same state and plan."""

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
        """Segments from every row of the actual episode except rows at its end."""
        return split(Episodes(self.info, [self.actual]), stride=1, discount=1.0, shortest=1)


def pair_episodes(
    actual: Episodes, nominal: Episodes, *, nominal_hash: str | None = None
) -> list[EpisodePair]:
    """Pairs actual episodes with their nominal twins by index, without diverged pairs.

    `nominal_hash` is the scenario hash of the nominal plant, if it is not that of the twins.
    """
    who = f"feedback of '{actual.info.scenario}'"
    _check_same(who, actual.info, nominal.info, _SAME_TASK)
    twins = {episode.index: episode for episode in nominal}
    pairs = []
    for episode in actual:
        if (twin := twins.get(episode.index)) is None:
            raise ValueError(f"{who}: episode {episode.index} has no nominal twin")
        apart = np.abs(episode.true_state[0] - twin.true_state[0]).max(initial=0.0)
        if not apart <= START_TOLERANCE:
            raise ValueError(
                f"{who}: the twin of episode {episode.index} starts in another state, {apart:.3g} "
                "apart"
            )
        if DIVERGED in (episode.cause, twin.cause):
            _LOGGER.info("pair %d of '%s' diverged", episode.index, actual.info.scenario)
        elif episode.num_steps > episode.first_step and twin.num_steps > twin.first_step:
            pair = EpisodePair(
                info=actual.info,
                actual=episode,
                twin=twin,
                nominal_hash=nominal_hash or nominal.info.scenario_hash,
                twin_seed=nominal.info.seed,
            )
            pairs.append(pair)
    return pairs


def _check_same(
    who: str, feedback: EpisodesInfo, other: EpisodesInfo, names: Sequence[str]
) -> None:
    for name in names:
        if (own := getattr(feedback, name)) != (expected := getattr(other, name)):
            raise ValueError(f"{who}: {name} differs: it is {own}, expected {expected}")


def check_feedback(feedback: Sequence[EpisodePair], learned: EpisodesInfo) -> None:
    """Checks that feedback is of the scenario that an assessment was trained on."""
    if not feedback:
        raise ValueError(f"feedback of '{learned.scenario}': got none, expected at least one pair")
    for pair in feedback:
        who = f"pair {pair.actual.index} of the feedback for '{learned.scenario}'"
        _check_same(who, pair.info, learned, (*_SAME_TASK, "constraint_names"))
        # A pair's own hash is that of the actual plant.
        nominal = replace(pair.info, scenario_hash=pair.nominal_hash)
        _check_same(f"{who}, nominal twin", nominal, learned, ["scenario_hash"])


def used_episodes(feedback: Sequence[EpisodePair]) -> list[UsedEpisodes]:
    """Returns the sets of actual and twin episodes in feedback."""
    sets = [(pair.info.variation, pair.info.scenario_hash, pair.info.seed) for pair in feedback]
    sets += [("nominal", pair.nominal_hash, pair.twin_seed) for pair in feedback]
    return [
        UsedEpisodes(
            purpose="adaptation",
            variation=variation,
            scenario_hash=scenario_hash,
            seed=seed,
            num_episodes=count,
        )
        for (variation, scenario_hash, seed), count in Counter(sets).items()
    ]


@dataclass(kw_only=True, eq=False)
class FeedbackSegments(Segments):
    """Segments of actual episodes, and the unsafety scores of their twins, (N,)."""

    nominal_score: np.ndarray


def feedback_segments(
    feedback: Sequence[EpisodePair], parameters: AssessmentParameters
) -> FeedbackSegments:
    """Splits actual episodes into segments as training episodes are split.

    A twin that has left the safe set before a segment starts scores 1 there.
    """
    settings, discount = mode_settings(parameters), parameters.discount
    parts = []
    for position, pair in enumerate(feedback):
        rows, sample = pair.rows, pair.info.preview_stride
        since_start = rows.start_row - pair.actual.first_step
        left = rows.remaining_steps
        if not pair.actual.is_safe:
            left = np.maximum(left, pair.info.num_steps - since_start)
        segments = rows.take(
            (since_start % settings.stride == 0) & (left >= settings.shortest * sample)
        )
        segments.episode = segments.group = np.full(len(segments), position)
        segments.score = unsafety_score(
            segments.remaining_steps / sample, segments.is_unsafe, discount
        )
        if settings.is_paper and pair.info.variation == "nominal":
            segments.state = segments.true_state
        remaining = np.maximum(pair.twin.num_steps - segments.start_row, 0)
        twin_is_unsafe = np.full(len(segments), not pair.twin.is_safe)
        twin_score = unsafety_score(remaining / sample, twin_is_unsafe, discount)
        parts.append(FeedbackSegments(**vars(segments), nominal_score=twin_score))
    every = joined(parts)
    if not len(every):
        raise ValueError(
            f"feedback of '{feedback[0].info.scenario}': none of {len(feedback)} pairs has a "
            f"segment of {settings.shortest} samples"
        )
    return every
