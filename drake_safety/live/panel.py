"""Contents of a live page, and values of its controls; needs no library for pages."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

COLOURS = {
    "safe": (0.169, 0.424, 0.690),
    "unsafe": (0.820, 0.329, 0.106),
    "unknown": (0.788, 0.800, 0.820),
    "recovery": (0.106, 0.620, 0.467),
    "plain": (0.133, 0.149, 0.169),
}
"""RGB of each tone, in [0, 1]."""
HISTORY_S = 10.0
"""Duration of the curve of Γ [s]."""

_UNKNOWN = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Status:
    """The robot's state and a cause in words, a remark, and a key of `COLOURS`."""

    state: str = ""
    cause: str = ""
    note: str = ""
    tone: str = "plain"


@dataclass
class Slider:
    """Range of a slider, the distance of neighbouring values, and where it is."""

    low: float
    high: float
    step: float
    value: float


class LivePanel:
    """Values that every viewer of a session sees and controls.

    The session and a page share it. Each runs in its own thread and replaces whole values.
    """

    def __init__(self, *, title: str, threshold: float):
        self.title, self.threshold = title, threshold
        self.status = Status()
        self.probability = math.nan
        self.belief: tuple[float, ...] = _UNKNOWN
        self.buttons: dict[str, str] = {}  # Keys as `KeyboardEvent.code`, or "", by name.
        self.sliders: dict[str, Slider] = {}
        self.is_stopped = False
        self._clicks: set[str] = set()
        self.history: deque[tuple[float, float]] = deque()  # Times [s] and probabilities.

    def click(self, name: str) -> None:
        """Clicks a button; until it is taken, further clicks count as the same."""
        self._clicks.add(name)

    def take_click(self, name: str) -> bool:
        """Whether a button was clicked since the last call."""
        try:
            self._clicks.remove(name)  # Looks and removes at once: no click is lost.
        except KeyError:
            return False
        return True

    def set_value(self, name: str, value: Any) -> None:
        """Sets a slider, within its range, to a page's value; ignores other things than numbers."""
        slider = self.sliders[name]
        if isinstance(value, int | float) and math.isfinite(value):
            slider.value = float(min(max(value, slider.low), slider.high))

    def show_belief(
        self, probability: float, belief: np.ndarray, time_s: float | None = None
    ) -> None:
        """Shows a probability, or NaN, and a belief (3,), on the curve if there is a time [s]."""
        self.probability = float(probability)
        self.belief = tuple(belief.tolist()) if np.isfinite(belief).all() else _UNKNOWN
        if time_s is not None:
            shown = self.probability if math.isfinite(self.probability) else 0.0
            self.history.append((time_s, min(max(shown, 0.0), 1.0)))
            while self.history[0][0] < time_s - HISTORY_S:
                self.history.popleft()

    def curve(self) -> list[tuple[float, float]]:
        """Points (time before the last one [s], at most 0; probability in [0, 1]), oldest first."""
        points = list(self.history)
        return [(round(time_s - points[-1][0], 2), round(value, 3)) for time_s, value in points]

    def stop(self) -> None:
        """Shows that the session has ended."""
        self.is_stopped = True
        self.status = Status("stopped", note="The simulation has ended.")
