"""Pushes: forces that act on a body of a robot for a while."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(kw_only=True)
class Push:
    """One push: where, how hard, when."""

    body: str = ""
    """The robot's body that is pushed, at its centre of mass."""
    force_n: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """The force in the world, (3,) [N]."""
    time_s: float = 1.0
    """When it begins [s]."""
    duration_s: float = 0.1
    """How long it lasts [s]."""

    def __post_init__(self) -> None:
        if len(self.force_n) != 3 or not np.isfinite(self.force_n).all():
            raise ValueError(f"push: force_n must be three numbers [N]; got {self.force_n}")
        if not self.time_s >= 0:
            raise ValueError(f"push: time_s must not be negative; got {self.time_s}")
        if not self.duration_s > 0:
            raise ValueError(f"push: duration_s must be positive; got {self.duration_s}")

    @property
    def strength_n(self) -> float:
        """Magnitude of the force [N]."""
        return float(np.linalg.norm(self.force_n))


@dataclass(kw_only=True)
class RandomPushes:
    """Pushes that episodes may begin with: only what follows them is learned from."""

    share: float = 0.0
    """Share of the episodes that begin with one."""
    body: str = ""
    """The robot's body that is pushed; its base by default."""
    force_n: list[float] = field(default_factory=lambda: [100.0, 800.0])
    """Lowest and highest, in any horizontal direction [N]."""
    time_s: list[float] = field(default_factory=lambda: [0.1, 1.5])
    """Earliest and latest begin [s]."""
    duration_s: float = 0.2
    """How long each lasts [s]."""

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise ValueError(f"random pushes: share must be in [0, 1); got {self.share}")
        for name in ("force_n", "time_s"):
            bounds = getattr(self, name)
            if len(bounds) != 2 or not 0 <= bounds[0] <= bounds[1] < np.inf:
                raise ValueError(
                    f"random pushes: {name} must be [lowest, highest], not negative; got {bounds}"
                )
        if not self.duration_s > 0:
            raise ValueError(f"random pushes: duration_s must be positive; got {self.duration_s}")

    def sample(self, rng: np.random.Generator, body: str) -> Push | None:
        """The push of an episode, or None for an episode without.

        Args:
            rng: Source of every draw.
            body: The body that is pushed when :attr:`body` names none.
        """
        return None if rng.random() >= self.share else self.draw(rng, body)

    def draw(self, rng: np.random.Generator, body: str) -> Push:
        """A push, whatever the share of episodes that begin with one.

        Args:
            rng: Source of every draw.
            body: The body that is pushed when :attr:`body` names none.
        """
        direction = rng.uniform(-np.pi, np.pi)
        strength = rng.uniform(self.force_n[0], self.force_n[1])
        return Push(
            body=self.body or body,
            force_n=[strength * np.cos(direction), strength * np.sin(direction), 0.0],
            time_s=rng.uniform(self.time_s[0], self.time_s[1]),
            duration_s=self.duration_s,
        )
