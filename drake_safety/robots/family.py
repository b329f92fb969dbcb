"""Plant families: random plants around the nominal one, on which Γ learns beside it."""

from dataclasses import asdict, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from drake_safety.files.schema import Count, Share, load_typed, schema
from drake_safety.robots.robot import PlantVariation

FAMILY = "family"
"""Name of the variation whose episodes belong to the plants of a family."""
_SHARE = "share"  # Share of the plants that have an entry.
_DRAWS = ("uniform", "log_uniform", "one_of")
_TRIED = 32  # Choices of each list that are tried.


@schema(kw_only=True)
class PlantFamily:
    """Random plants (domain randomisation): entries of a `PlantVariation`, some of them ranges.

    A range takes the place of a value: ``{uniform: [a, b]}``, ``{log_uniform: [a, b]}`` or
    ``{one_of: [...]}``, whose items may hold ranges. A mapping with ``share: p`` is there in that
    share of the plants. Entries that are left out are the nominal plant's.
    """

    plants: Count = 64  # Number of plants in training.
    share: Share = 0.5  # Training episodes on these plants for each nominal one.
    ranges: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.ranges:
            raise ValueError("family: ranges must have an entry of a plant variation; got {}")
        for number in range(_TRIED):
            self.extreme(PlantVariation(), number)

    def extreme(self, nominal: PlantVariation, number: int) -> PlantVariation:
        """The plant with every entry, at one end of each range, the odd numbers at the highest."""
        # In place of a random generator: draws the ends of ranges, and the items of lists in turn.
        ends = SimpleNamespace(
            random=lambda: 0.0,
            uniform=lambda *bounds: bounds[number % 2],
            integers=lambda count: number % count,
        )
        return self._drawn_by(ends, nominal)

    def plant(self, nominal: PlantVariation, seed: int, number: int) -> PlantVariation:
        """Draws the plant of a number, the same for a seed."""
        return self._drawn_by(plant_rng(seed, number), nominal)

    def _drawn_by(self, rng: Any, nominal: PlantVariation) -> PlantVariation:
        drawn = _drawn(self.ranges, rng, "ranges")
        return load_typed(PlantVariation, asdict(nominal) | drawn, "family")


def plant_rng(seed: int, number: int) -> np.random.Generator:
    """Makes the generator of a plant, which depends on the seed and its number alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, 1)))


def _drawn(value: Any, rng: Any, place: str, *, has_share: bool = False) -> Any:
    """The value with numbers in place of ranges; absent mappings are left out."""
    if isinstance(value, dict) and _SHARE in value and not has_share:
        raise ValueError(f"family: {place} cannot have a share; only entries of a mapping have one")
    if isinstance(value, list):
        return [_drawn(one, rng, place) for one in value]
    if not isinstance(value, dict):
        return value
    kinds = [key for key in _DRAWS if key in value]
    if kinds and (len(kinds) > 1 or value.keys() - {kinds[0], _SHARE}):
        raise ValueError(f"family: {place} must have one of {list(_DRAWS)}; got {list(value)}")
    if kinds:
        return _of_range(kinds[0], value[kinds[0]], rng, f"{place}.{kinds[0]}")
    drawn = {}
    for key, part in value.items():
        if key == _SHARE:
            continue
        share = part.get(_SHARE, 1.0) if isinstance(part, dict) else 1.0
        if isinstance(share, bool) or not (isinstance(share, int | float) and 0 < share <= 1):
            raise ValueError(f"family: {place}.{key}.share must be in (0, 1]; got {share!r}")
        # Drawn in either case, so that a share changes no other entry.
        is_there, inner = rng.random() < share, _drawn(part, rng, f"{place}.{key}", has_share=True)
        if is_there:
            drawn[key] = inner
    return drawn


def _of_range(kind: str, bounds: Any, rng: Any, place: str) -> Any:
    if not isinstance(bounds, list) or not bounds:
        raise ValueError(f"family: {place} must be a list; got {bounds!r}")
    if kind == "one_of":
        return _drawn(bounds[rng.integers(len(bounds))], rng, place)
    is_number = all(isinstance(one, int | float) and abs(one) < 1e9 for one in bounds)
    least = 0.0 if kind == "log_uniform" else -np.inf
    if len(bounds) != 2 or not is_number or not least < bounds[0] <= bounds[1]:
        wanted = "[lowest, highest]" + (" above 0" if kind == "log_uniform" else "")
        raise ValueError(f"family: {place} must be {wanted}; got {bounds}")
    if kind == "uniform":
        return float(rng.uniform(*bounds))
    return float(np.exp(rng.uniform(*np.log(bounds))))
