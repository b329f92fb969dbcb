"""Default seeds of each purpose, and the seeds that an assessment has used.

Episode i of a set draws from `SeedSequence(seed, spawn_key=(i,))`: sets with one seed start in the
same states for every plant. Choices are made on the default seeds. A release is measured on other
seeds, `RELEASE` above them, which no choice has used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from drake_safety.learning.segments import EpisodesInfo

NOT_DRAWN = -1  # Seed of recorded episodes, whose starts no other set shares.
_SPAN = 20_000_000  # More than the seeds of development.
_RELEASES = {"0.1.0": _SPAN}  # Added for a version's figures; a span a version.
RELEASE = max(_RELEASES.values())  # The newest version's.


class SeedBlock(NamedTuple):
    """Consecutive seeds, the first one as a default, of the sets of episodes of a command."""

    first: int
    purposes: tuple[str, ...]

    def seeds(self, first: int | None = None) -> dict[str, int]:
        """Returns the seed of each purpose, starting at `first` or the default."""
        start = self.first if first is None else first
        return {purpose: start + i for i, purpose in enumerate(self.purposes)}

    def first_beside(self, seed: int) -> int:
        """Returns the default first seed, of the same release as a seed if it is of one."""
        return self.first + _RELEASES.get(_version(seed), 0)


TRAINING = SeedBlock(0, ("training", "training on the family"))
# Thresholds are chosen on other episodes, throws and pushes than the evaluation's.
EVALUATION = SeedBlock(
    1_000_000, ("evaluation", "disturbances", "disturbance thresholds", "thresholds")
)
CALIBRATION = SeedBlock(2_000_000, ("calibration", "calibration over the family"))
# Nominal twins have the seed of their actual episodes.
ADAPTATION = SeedBlock(4_000_000, ("adaptation", "evaluation of the adaptation"))
WALKING = SeedBlock(6_000_000, ("calibration", "tour", "push", "command"))
DEMONSTRATION = SeedBlock(7_000_000, ("demonstration",))  # For `run`, `play` and `check`.
SHIFTS = SeedBlock(8_000_000, ("shifts",))  # Conditions that training does not have.
# Undisturbed motion, from which a monitor learns; fresh motion shows how often it alarms.
MOTION = SeedBlock(9_000_000, ("motion", "motion of the actual robot"))
FRESH_MOTION = SeedBlock(9_100_000, ("fresh motion",))
GATE = SeedBlock(11_000_000, ("pairs of two loops",))
RATE = SeedBlock(12_000_000, ("failure rate",))
PUSHES = SeedBlock(14_000_000, ("pushes",))  # For the push card.
FALLS = SeedBlock(13_000_000, ("falls",))  # Episodes that go on outside the safe set.


def use_of(seed: int) -> str:
    """Returns "development", or "release" with the version whose figures a seed is for."""
    return f"release {version}" if (version := _version(seed)) else "development"


def _version(seed: int) -> str:
    return next((v for v, added in _RELEASES.items() if added <= seed < added + _SPAN), "")


@dataclass(frozen=True, kw_only=True)
class UsedEpisodes:
    """A set of episodes that an assessment has used for training, calibration or adaptation."""

    purpose: str
    variation: str
    scenario_hash: str
    seed: int
    num_episodes: int

    @classmethod
    def of(cls, purpose: str, info: EpisodesInfo, num_episodes: int) -> UsedEpisodes:
        """Returns the entry of a set with this `EpisodesInfo`."""
        return cls(
            purpose=purpose,
            variation=info.variation,
            scenario_hash=info.scenario_hash,
            seed=info.seed,
            num_episodes=num_episodes,
        )

    def __str__(self) -> str:
        return f"the {self.num_episodes} '{self.variation}' episodes of its {self.purpose}"


def check_unused(used: Sequence[UsedEpisodes], seeds: Iterable[int], who: str) -> None:
    """Raises ValueError if a seed was used, with its purpose and the next free seed."""
    wanted = sorted(seeds)
    spent = {episodes.seed: episodes for episodes in used if episodes.seed != NOT_DRAWN}
    for seed in (seed for seed in wanted if seed in spent):
        shift = 1
        while any(other + shift in spent for other in wanted):
            shift += 1
        raise ValueError(
            f"{who}: seed {seed} gives episodes that start as {spent[seed]}; "
            f"choose another seed, such as {wanted[0] + shift}"
        )
