"""Pushes: constant forces on a body of a robot for a limited time."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(kw_only=True)
class Push:
    """A push on a body."""

    body: str = ""
    """The robot's body; the force acts at its centre of mass."""
    force_n: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """The force in the world, (3,) [N]."""
    time_s: float = 1.0
    """Start [s]."""
    duration_s: float = 0.1
    """Duration [s]."""

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
    """Random pushes at the start of episodes; only the rows after a push are training data."""

    share: float = 0.0
    """Share of the episodes with a push."""
    body: str = ""
    """The pushed body; the robot's base by default."""
    force_n: list[float] = field(default_factory=lambda: [100.0, 800.0])
    """Lowest and highest force, in a random horizontal direction [N]."""
    time_s: list[float] = field(default_factory=lambda: [0.1, 1.5])
    """Earliest and latest start [s]."""
    duration_s: float = 0.2
    """Duration [s]."""

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
        """Draws the push of an episode, on this body by default; None in ``1 - share`` of them."""
        return None if rng.random() >= self.share else self.draw(rng, body)

    def draw(self, rng: np.random.Generator, body: str) -> Push:
        """Draws a push, on this body by default."""
        direction = rng.uniform(-np.pi, np.pi)
        strength = rng.uniform(self.force_n[0], self.force_n[1])
        return Push(
            body=self.body or body,
            force_n=[strength * np.cos(direction), strength * np.sin(direction), 0.0],
            time_s=rng.uniform(self.time_s[0], self.time_s[1]),
            duration_s=self.duration_s,
        )
