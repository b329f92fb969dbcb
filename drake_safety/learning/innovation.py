"""Innovation: the error of a one-step prediction, and its charts over time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from drake_safety.learning.charts import averaged, limit_of, trimmed_whitening_of, whitening_of
from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.state_predictor import HIDDEN_SIZES, Predictor

TIME_CONSTANTS_S = (0.8, 4.0)
"""Memory of the two charts of the mean, a fast and a slow one."""
KINDS = ("", "frozen", "distance", "scatter", "fast", "slow")
"""What raises an alarm, "" for none: repeated inputs, the distance of x, the norm of the
innovations, and their two charts."""
_NUM_FOLDS = 3
_CLIP_SHARE = 0.99  # Of innovations that are not clipped, so that one impact is no lasting change.
_ALLOWANCE = 0.5  # Of the sums, in standard deviations.
_LARGEST_STEP = 5.0  # Of the sums, in standard deviations.
_LEAST_ROWS = 10  # Rows for each state, below which there is no alarm.
_FREE_REPEATS = 2  # Beyond the longest run of repeated inputs in training.
_OF_PREDICTOR = ("mean", "scale", "linear", "bias")
_OWN = ("offset", "whitening", "sums", "chart_limits", "chart_whitenings")
_T = TypeVar("_T")


@dataclass(frozen=True, kw_only=True, eq=False)
class Innovation:
    """The error of predicting the next measured state, on the nominal plant and since.

    A plant that changed cannot be seen in one input: it lies among those of training. It is seen in
    how the state follows from the last one. The innovation is whitened, limited in norm, and
    averaged by two charts with memory (MEWMA). Two further charts sum the distance of x and the
    norm of the innovation (CUSUM), another counts inputs that repeat the last one to the last bit.
    It is learned from the nominal episodes that stay safe, and needs no failure.

    Attributes:
        predictor: The prediction.
        offset: Mean of its errors, (n_s,).
        whitening: Whitens them, (n_s, n_s).
        clip: Largest norm of a whitened innovation.
        chart_whitenings: Whiten the charts' means on the nominal plant, (2, n_s, n_s).
        chart_limits: Largest norms of the whitened means; infinite if training had too little
            motion, (2,).
        sums: Mean, standard deviation and limit of the CUSUM of the distance of x, and of the norm
            of the innovation, (2, 3).
        longest_repeat: Longest known run of repeated inputs.
        step_s: Time between two inputs [s].
    """

    predictor: Predictor
    offset: np.ndarray
    whitening: np.ndarray
    clip: float
    chart_whitenings: np.ndarray
    chart_limits: np.ndarray
    sums: np.ndarray
    longest_repeat: int
    step_s: float

    def __deepcopy__(self, memo: dict[int, Any]) -> Innovation:
        return self

    @property
    def num_inputs(self) -> int:
        """n_x."""
        return len(self.predictor.mean)

    @property
    def num_states(self) -> int:
        """n_s."""
        return len(self.offset)

    @property
    def rates(self) -> tuple[float, ...]:
        """Weight of the newest innovation in each chart's mean."""
        return tuple(min(1.0, self.step_s / constant_s) for constant_s in TIME_CONSTANTS_S)

    @classmethod
    def fit(
        cls, x: Sequence[np.ndarray], num_states: int, step_s: float, novelty: Novelty
    ) -> Innovation:
        """Learns from nominal motions, each judged by a prediction learned from others.

        Args:
            x: Inputs of each motion in the order of time, (K + 1, n_x); the state is first.
        """
        x = [one for one in x if len(one) > 1]
        if not x:
            raise ValueError("Innovation: no motion has two inputs")

        def predictor_of(motions: Sequence[np.ndarray]) -> Predictor:
            return Predictor.fit(*_steps(motions, num_states))

        def novelty_of(motions: Sequence[np.ndarray]) -> Novelty:
            training = Moments.of(np.concatenate(motions))
            return Novelty(training=training, limits=novelty.limits, plan=novelty.plan)

        errors = _judged_by_others(x, predictor_of, _errors)
        distances = _judged_by_others(x, novelty_of, lambda known, one: known.of(one[1:]))
        whole = np.concatenate(errors)
        offset, whitening = trimmed_whitening_of(whole)
        norm = np.linalg.norm((whole - offset) @ whitening, axis=1)
        clip = float(np.quantile(norm, _CLIP_SHARE))
        summed = np.stack([np.concatenate(distances), np.minimum(norm, clip)])
        spreads = np.maximum(summed.std(axis=1), 1e-6)
        unlimited = cls(
            predictor=predictor_of(x),
            offset=offset,
            whitening=whitening,
            clip=clip,
            chart_whitenings=np.stack([np.eye(num_states)] * len(TIME_CONSTANTS_S)),
            chart_limits=np.full(len(TIME_CONSTANTS_S), np.inf),
            sums=np.stack([summed.mean(axis=1), spreads, np.full(2, np.inf)], axis=1),
            longest_repeat=max(map(_longest_repeat, x)) + _FREE_REPEATS,
            step_s=float(step_s),
        )
        if len(whole) < _LEAST_ROWS * num_states:
            return unlimited
        order = np.random.default_rng(0).permutation(len(x))
        limited = unlimited.limited(np.concatenate([errors[i] for i in order]))
        means = [averaged(limited, rate) for rate in unlimited.rates]
        whitened = replace(
            unlimited,
            chart_whitenings=np.stack([whitening_of(one, is_centred=True)[1] for one in means]),
        )
        return replace(
            whitened,
            chart_limits=whitened._limits(limited),
            sums=whitened._limited_sums(np.concatenate([distances[i] for i in order]), limited),
        )

    def with_feedback(self, x: Sequence[np.ndarray], novelty: Novelty) -> Innovation:
        """Returns the innovation of an actual robot: corrected prediction, no lower limits."""
        x = [one for one in x if len(one) > 1]
        if not x:
            return self

        def predictor_of(motions: Sequence[np.ndarray]) -> Predictor:
            return self.predictor.corrected(*_steps(motions, self.num_states))

        limited = self.limited(np.concatenate(_judged_by_others(x, predictor_of, _errors)))
        distance = np.concatenate([novelty.of(one[1:]) for one in x])
        summed = np.stack([distance, np.linalg.norm(limited, axis=1)])
        sums = self.sums.copy()
        sums[:, 0] = np.maximum(sums[:, 0], summed.mean(axis=1))
        sums[:, 1] = np.maximum(sums[:, 1], summed.std(axis=1))
        adapted = replace(
            self,
            predictor=predictor_of(x),
            chart_limits=np.maximum(self.chart_limits, self._limits(limited)),
            sums=sums,
            longest_repeat=max(self.longest_repeat, *map(_longest_repeat, x)),
        )
        sums = adapted._limited_sums(distance, limited)
        sums[:, 2] = np.maximum(sums[:, 2], self.sums[:, 2])
        return replace(adapted, sums=sums)

    def _chart_norms(self, innovations: np.ndarray) -> list[np.ndarray]:
        """Norms of both charts' whitened means of consecutive innovations, (N,) each."""
        return [
            np.linalg.norm(averaged(innovations, rate) @ whitening, axis=1)
            for rate, whitening in zip(self.rates, self.chart_whitenings, strict=True)
        ]

    def _limits(self, innovations: np.ndarray) -> np.ndarray:
        return np.array([limit_of(norm, self.step_s) for norm in self._chart_norms(innovations)])

    def _limited_sums(self, distance: np.ndarray, innovations: np.ndarray) -> np.ndarray:
        norm = np.linalg.norm(innovations, axis=1)
        limits = [
            limit_of(self._summed(i, one), self.step_s) for i, one in enumerate((distance, norm))
        ]
        return np.column_stack([self.sums[:, :2], limits])

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all that `from_arrays` needs, by name."""
        found = {name: getattr(self.predictor, name) for name in _OF_PREDICTOR}
        found |= {name: getattr(self, name) for name in _OWN}
        found["settings"] = np.array([self.clip, self.longest_repeat, self.step_s])
        for i, (weight, bias) in enumerate(self.predictor.layers):
            found |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
        return found

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], *, num_inputs: int, num_states: int
    ) -> Innovation:
        """Makes the innovation of arrays written by `arrays`."""
        n_s, n_charts = num_states, len(TIME_CONSTANTS_S)
        shapes: dict[str, tuple[int, ...]] = {
            "mean": (num_inputs,),
            "scale": (num_inputs,),
            "linear": (num_inputs, n_s),
            "bias": (n_s,),
            "offset": (n_s,),
            "whitening": (n_s, n_s),
            "sums": (2, 3),
            "chart_limits": (n_charts,),
            "chart_whitenings": (n_charts, n_s, n_s),
            "settings": (3,),
        }
        widths = (num_inputs, *HIDDEN_SIZES, n_s)
        for i, (width, next_width) in enumerate(itertools.pairwise(widths)):
            shapes |= {f"layer.{i}.weight": (width, next_width), f"layer.{i}.bias": (next_width,)}
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ValueError(
                    f"the shape of its innovation.{name} is {arrays[name].shape}, expected {shape}"
                )
        layers = tuple(
            (arrays[f"layer.{i}.weight"], arrays[f"layer.{i}.bias"])
            for i in range(len(HIDDEN_SIZES) + 1)
        )
        clip, longest_repeat, step_s = arrays["settings"].tolist()
        return cls(
            predictor=Predictor(layers=layers, **{name: arrays[name] for name in _OF_PREDICTOR}),
            **{name: arrays[name] for name in _OWN},
            clip=clip,
            longest_repeat=int(longest_repeat),
            step_s=step_s,
        )

    def of(self, x: np.ndarray, next_state: np.ndarray) -> np.ndarray:
        """Returns whitened innovations of limited norm, (N, n_s), of x and the next state."""
        return self.limited(next_state - x[:, : self.num_states] - self.predictor(x))

    def limited(self, errors: np.ndarray) -> np.ndarray:
        """Whitens errors of prediction (N, n_s) and limits their norm."""
        whitened = (errors - self.offset) @ self.whitening
        norm = np.sqrt(np.einsum("ij,ij->i", whitened, whitened))
        return whitened * np.minimum(1.0, self.clip / np.maximum(norm, 1e-12))[:, None]

    def next_sums(self, sums: np.ndarray, distance: float, innovation: np.ndarray) -> np.ndarray:
        """Returns both CUSUMs (2,) after one more step with a whitened innovation (n_s,)."""
        found = np.array([distance, math.sqrt(innovation @ innovation)])
        step = np.minimum((found - self.sums[:, 0]) / self.sums[:, 1], _LARGEST_STEP)
        added: np.ndarray = np.maximum(sums + step - _ALLOWANCE, 0.0)
        return added

    def _summed(self, which: int, values: np.ndarray) -> np.ndarray:
        """One CUSUM of consecutive values, (N,)."""
        mean, spread = self.sums[which, :2]
        steps = np.minimum((values - mean) / spread, _LARGEST_STEP) - _ALLOWANCE
        walk = np.concatenate([[0.0], np.cumsum(steps)])
        # The sum since its last reset to zero is the walk above its lowest value.
        summed: np.ndarray = (walk - np.minimum.accumulate(walk))[1:]
        return summed

    def levels(self, motions: Sequence[np.ndarray], distances: Sequence[np.ndarray]) -> np.ndarray:
        """Returns what the charts say at each row of consecutive motions, in units of their limits.

        Between motions the charts keep their values.

        Args:
            motions: Inputs of each motion, (K + 1, n_x).
            distances: Novelty of each input, (K + 1,).

        Returns:
            (sum of K + 1, 5), in the order of ``KINDS[1:]``.
        """
        found = np.zeros((sum(map(len, motions)), len(KINDS) - 1))
        is_step = np.concatenate([np.arange(len(one)) > 0 for one in motions])
        if is_step.any():
            innovations = np.concatenate(
                [self.of(one[:-1], one[1:, : self.num_states]) for one in motions if len(one) > 1]
            )
            repeats = np.concatenate([_repeats(one) for one in motions])
            found[is_step, 0] = repeats / self.longest_repeat
            norm = np.linalg.norm(innovations, axis=1)
            watched = (np.concatenate([one[1:] for one in distances]), norm)
            for i, values in enumerate(watched):
                found[is_step, 1 + i] = self._summed(i, values) / self.sums[i, 2]
            for column, means in enumerate(self._chart_norms(innovations), 3):
                found[is_step, column] = means / self.chart_limits[column - 3]
        # The first row of a motion shows the last values.
        last = np.maximum.accumulate(np.where(is_step, np.arange(len(found)), 0))
        return found[last]

    def deviations(self, kind: str, average: np.ndarray) -> np.ndarray:
        """Mean error of each state, (n_s,), in its standard deviations on the nominal plant.

        It is positive where the state grows more than predicted.
        """
        chart_whitening = self.chart_whitenings[("fast", "slow").index(kind)]
        unwhitening = np.linalg.inv(self.whitening)
        root = np.linalg.inv(chart_whitening) @ unwhitening
        return (average @ unwhitening) / np.linalg.norm(root, axis=0)


def describe(kind: str, deviations: np.ndarray, state_names: Sequence[str]) -> str:
    """Says what an alarm saw, as far as the errors tell; "" without one.

    Args:
        kind: One of ``KINDS``.
        deviations: Mean error of each state in standard deviations, (n_s,); for charts only.
    """
    if kind == "frozen":
        return "input frozen"
    if kind == "distance":
        return "inputs unlike those of training"
    if kind == "scatter":
        return "inputs noisier, or the motion less regular, than learned"
    if not kind:
        return ""
    strangest = int(np.argmax(np.abs(deviations)))
    name, deviation = state_names[strangest], deviations[strangest]
    joint = name.removesuffix("_rate")
    if joint in state_names and f"{joint}_rate" in state_names:
        seen = f"joint {joint} answers unlike the learned one"
    elif name.startswith(("velocity_", "base_")) and name[-1] in _SIDES:
        seen = f"pushed steadily {_SIDES[name[-1]][int(deviation < 0.0)]}"
    else:
        seen = f"{name} changes unlike what was learned"
    return f"{seen} ({name} {deviation:+.0f} standard deviations)"


_SIDES = {"x": ("forward", "backward"), "y": ("to the left", "to the right"), "z": ("up", "down")}


def _steps(x: Sequence[np.ndarray], num_states: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs of all motions but the last ones, and the changes of the state after them."""
    changes = [np.diff(one[:, :num_states], axis=0) for one in x]
    return np.concatenate([one[:-1] for one in x]), np.concatenate(changes)


def _errors(predictor: Predictor, x: np.ndarray) -> np.ndarray:
    return np.diff(x[:, : len(predictor.bias)], axis=0) - predictor(x[:-1])


def _judged_by_others(
    x: Sequence[np.ndarray],
    learn: Callable[[Sequence[np.ndarray]], _T],
    judge: Callable[[_T, np.ndarray], np.ndarray],
) -> list[np.ndarray]:
    """Judges each motion by what is learned from motions of other folds, or from all of few."""
    found = [np.empty(0)] * len(x)
    for part in range(_NUM_FOLDS):
        learned = learn([one for i, one in enumerate(x) if i % _NUM_FOLDS != part] or x)
        for i in range(part, len(x), _NUM_FOLDS):
            found[i] = judge(learned, x[i])
    return found


def _repeats(x: np.ndarray) -> np.ndarray:
    """Length of the run of inputs that repeat the one before, from the second input on, (K,)."""
    runs, run = np.zeros(len(x) - 1), 0
    for i, is_same in enumerate(np.all(x[1:] == x[:-1], axis=1)):
        run = run + 1 if is_same else 0
        runs[i] = run
    return runs


def _longest_repeat(x: np.ndarray) -> int:
    return int(_repeats(x).max(initial=0.0))
