"""Pushes: constant forces on a body of a robot for a limited time."""

from dataclasses import field

import numpy as np

from drake_safety.files.schema import Bounds, NotNegative, Positive, ShareBelowOne, Triple, schema


@schema(kw_only=True)
class Push:
    """A push on a body at its centre of mass."""

    body: str = ""
    force_n: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])  # Force in the world [N].
    time_s: NotNegative = 1.0
    duration_s: Positive = 0.1

    @property
    def strength_n(self) -> float:
        """Magnitude of the force [N]."""
        return float(np.linalg.norm(self.force_n))


@schema(kw_only=True)
class RandomPushes:
    """Random pushes at the start of episodes; only the rows after a push are training data."""

    share: ShareBelowOne = 0.0  # Share of the episodes with a push.
    body: str = ""  # The pushed body; the robot's base by default.
    force_n: Bounds[NotNegative] = field(default_factory=lambda: [100.0, 800.0])
    """Lowest and highest force, in a random horizontal direction [N]."""
    time_s: Bounds[NotNegative] = field(default_factory=lambda: [0.1, 1.5])  # Range of starts [s].
    duration_s: Positive = 0.2

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
