"""Which seeds each purpose draws its episodes with, and which an assessment has used up.

Episode i of a set draws from `SeedSequence(seed, spawn_key=(i,))`: sets of one seed begin alike,
whichever plant is simulated, and whether balls are thrown or not. What judges an assessment must
not have been drawn with a seed that it has learned from, been calibrated or adapted with. Here is
the one table of default seeds; those of two purposes are never the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from drake_safety.learning.segments import EpisodesInfo

NOT_DRAWN = -1
"""In place of a seed where episodes were recorded: nothing else can begin as they did."""


class SeedBlock(NamedTuple):
    """Seeds that follow each other, one for each set of episodes that a command draws.

    Attributes:
        first: The first of them by default; the blocks lie a million apart.
        purposes: What the sets are for, in the order of their seeds.
    """

    first: int
    purposes: tuple[str, ...]

    def seeds(self, first: int | None = None) -> dict[str, int]:
        """The seed of each purpose, from the default or from another first one on."""
        start = self.first if first is None else first
        return {purpose: start + i for i, purpose in enumerate(self.purposes)}


TRAINING = SeedBlock(0, ("training",))
EVALUATION = SeedBlock(
    1_000_000, ("evaluation", "disturbances", "disturbance thresholds", "thresholds")
)
"""Thresholds of recalls are chosen on other episodes than those that are judged, and thresholds of
alarms and triggers on other throws or pushes."""
CALIBRATION = SeedBlock(2_000_000, ("calibration",))
PLANNING = SeedBlock(3_000_000, ("planning",))
ADAPTATION = SeedBlock(4_000_000, ("adaptation", "evaluation of the adaptation", "oracle"))
"""Nominal twins have the seed of the actual episodes beside them."""
DEMONSTRATION = SeedBlock(7_000_000, ("demonstration",))
"""What `run`, `play` and `check` show."""
BLOCKS = (TRAINING, EVALUATION, CALIBRATION, PLANNING, ADAPTATION, DEMONSTRATION)


@dataclass(frozen=True, kw_only=True)
class UsedEpisodes:
    """A set of episodes that an assessment has used.

    Attributes:
        purpose: "training", "calibration" or "adaptation".
        variation: Which plant was simulated.
        scenario_hash: Of the simulation.
        seed: Seed of the set, or `NOT_DRAWN`.
        num_episodes: How many; None where an earlier version's file does not say.
    """

    purpose: str
    variation: str
    scenario_hash: str
    seed: int
    num_episodes: int | None

    @classmethod
    def of(cls, purpose: str, info: EpisodesInfo, num_episodes: int | None) -> UsedEpisodes:
        """A set, of which `info` is known."""
        return cls(
            purpose=purpose,
            variation=info.variation,
            scenario_hash=info.scenario_hash,
            seed=info.seed,
            num_episodes=num_episodes,
        )

    def __str__(self) -> str:
        count = "" if self.num_episodes is None else f"{self.num_episodes} "
        return f"the {count}'{self.variation}' episodes of its {self.purpose}"


def check_unused(used: Sequence[UsedEpisodes], seeds: Iterable[int], who: str) -> None:
    """Refuses seeds that an assessment has used.

    Args:
        used: What it has used.
        seeds: Of the sets that are to be drawn.
        who: Who draws them.

    Raises:
        ValueError: One is used; says for what, and the next seed that is free with all that go
            with it.
    """
    wanted = sorted(seeds)
    spent = {one.seed: one for one in used if one.seed != NOT_DRAWN}
    found = next((seed for seed in wanted if seed in spent), None)
    if found is None:
        return
    shift = 1
    while any(seed + shift in spent for seed in wanted):
        shift += 1
    raise ValueError(
        f"{who}: seed {found} would give episodes that begin as {spent[found]} did; "
        f"choose another seed, such as {wanted[0] + shift}"
    )
