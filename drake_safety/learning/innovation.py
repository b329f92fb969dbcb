"""Innovation: the error of a one-step prediction, and its charts over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_safety.learning.charts import (
    Chart,
    averaged,
    limit_of,
    trimmed_whitening_of,
    whitening_of,
)
from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.state_predictor import HIDDEN_SIZES, Predictor

TIME_CONSTANTS_S = (0.8, 4.0)
"""Memory of the charts."""
KINDS = ("", "frozen", "distance", "scatter", "fast", "slow")
"""What raises an alarm, "" for none: repeated inputs, the distance of x, the norm of the
innovations, and their two charts."""
_NUM_FOLDS = 3
_CLIP_SHARE = 0.99  # Of innovations that are not clipped, so that one impact is no lasting change.
_ALLOWANCE = 0.5  # Of the sums, in standard deviations.
_LARGEST_STEP = 5.0  # Of the sums, in standard deviations.
_LEAST_ROWS = 10  # Rows for each state, below which there is no alarm.
_FREE_REPEATS = 2  # Beyond the longest run of repeated inputs in training.


class Innovation:
    """The error of predicting the next measured state, on the nominal plant and since.

    A plant that changed cannot be seen in one input: it lies among those of training. It is seen in
    how the state follows from the last one. The innovation is whitened, limited in norm, and
    averaged by two charts with memory. Two further charts sum the distance of x and the norm of the
    innovation (CUSUM), another counts inputs that repeat the last one to the last bit. It is
    learned from the nominal episodes that stay safe, and needs no failure. The object is immutable.

    Args:
        predictor: The prediction.
        offset: Mean of its errors, (n_s,).
        whitening: Whitens them, (n_s, n_s).
        clip: Largest norm of a whitened innovation.
        charts: The charts, a fast and a slow one.
        sums: Mean, standard deviation and limit of the CUSUM of the distance of x, and of the norm
            of the innovation, (2, 3).
        longest_repeat: Longest known run of repeated inputs.
        step_s: Time between two inputs [s].
    """

    def __init__(
        self,
        *,
        predictor: Predictor,
        offset: np.ndarray,
        whitening: np.ndarray,
        clip: float,
        charts: Sequence[Chart],
        sums: np.ndarray,
        longest_repeat: int,
        step_s: float,
    ):
        self.predictor, self.offset, self.whitening = predictor, offset, whitening
        self.clip, self.charts, self.sums = float(clip), tuple(charts), np.asarray(sums)
        self.longest_repeat, self.step_s = int(longest_repeat), float(step_s)
        self.num_inputs, self.num_states = len(predictor.mean), len(offset)
        self.rates = tuple(min(1.0, step_s / chart.time_constant_s) for chart in self.charts)

    def __deepcopy__(self, memo: dict[int, Any]) -> Innovation:
        return self

    @classmethod
    def fit(
        cls, x: Sequence[np.ndarray], num_states: int, step_s: float, novelty: Novelty
    ) -> Innovation:
        """Learns from nominal motions, each judged by a prediction learned from others.

        Args:
            x: Inputs of each motion in the order of time, (K + 1, n_x); the state is first.
            num_states: n_s.
            step_s: Time between two rows [s].
            novelty: Its limits scale the distance.
        """
        x = [one for one in x if len(one) > 1]
        if not x:
            raise ValueError("Innovation: no motion has two inputs")
        errors: list[np.ndarray] = [np.empty(0)] * len(x)
        distances = list(errors)
        for part in range(_NUM_FOLDS):
            own = range(part, len(x), _NUM_FOLDS)
            others = [one for i, one in enumerate(x) if i % _NUM_FOLDS != part] or x
            predictor = Predictor.fit(*_steps(others, num_states))
            known = Novelty(
                training=Moments.of(np.concatenate(others)),
                limits=novelty.limits,
                plan=novelty.plan,
            )
            for i in own:
                errors[i] = _errors(predictor, x[i], num_states)
                distances[i] = known.of(x[i][1:])
        whole = np.concatenate(errors)
        offset, whitening = trimmed_whitening_of(whole)
        norm = np.linalg.norm((whole - offset) @ whitening, axis=1)
        distance = np.concatenate(distances)
        summed = np.stack([distance, np.minimum(norm, np.quantile(norm, _CLIP_SHARE))])
        spreads = np.maximum(summed.std(axis=1), 1e-6)
        unlimited = cls(
            predictor=Predictor.fit(*_steps(x, num_states)),
            offset=offset,
            whitening=whitening,
            clip=float(np.quantile(norm, _CLIP_SHARE)),
            charts=[
                Chart(time_constant_s=t, whitening=np.eye(num_states), limit=np.inf)
                for t in TIME_CONSTANTS_S
            ],
            sums=np.stack([summed.mean(axis=1), spreads, np.full(2, np.inf)], axis=1),
            longest_repeat=max(_longest_repeat(one) for one in x) + _FREE_REPEATS,
            step_s=step_s,
        )
        if len(whole) < _LEAST_ROWS * num_states:
            return unlimited
        order = np.random.default_rng(0).permutation(len(x))
        limited = unlimited.limited(np.concatenate([errors[i] for i in order]))
        charts = []
        for rate, chart in zip(unlimited.rates, unlimited.charts, strict=True):
            means = averaged(limited, rate)
            whitening = whitening_of(means, is_centred=True)[1]
            limit = limit_of(np.linalg.norm(means @ whitening, axis=1), step_s)
            charts.append(
                Chart(time_constant_s=chart.time_constant_s, whitening=whitening, limit=limit)
            )
        distance = np.concatenate([distances[i] for i in order])
        return unlimited._with(charts, unlimited._sums_with_limits(distance, limited))

    def with_feedback(self, x: Sequence[np.ndarray], novelty: Novelty) -> Innovation:
        """Returns the innovation of an actual robot: corrected prediction, no lower limits.

        Args:
            x: Inputs of each motion of the robot, (K + 1, n_x).
            novelty: The novelty adapted to them.
        """
        x = [one for one in x if len(one) > 1]
        if not x:
            return self
        errors: list[np.ndarray] = [np.empty(0)] * len(x)
        for part in range(_NUM_FOLDS):
            others = [one for i, one in enumerate(x) if i % _NUM_FOLDS != part] or x
            predictor = self.predictor.corrected(*_steps(others, self.num_states))
            for i in range(part, len(x), _NUM_FOLDS):
                errors[i] = _errors(predictor, x[i], self.num_states)
        limited = self.limited(np.concatenate(errors))
        charts = []
        for rate, chart in zip(self.rates, self.charts, strict=True):
            norm = np.linalg.norm(averaged(limited, rate) @ chart.whitening, axis=1)
            limit = max(chart.limit, limit_of(norm, self.step_s))
            charts.append(
                Chart(time_constant_s=chart.time_constant_s, whitening=chart.whitening, limit=limit)
            )
        distance = np.concatenate([novelty.of(one[1:]) for one in x])
        summed = np.stack([distance, np.linalg.norm(limited, axis=1)])
        sums = self.sums.copy()
        sums[:, 0] = np.maximum(sums[:, 0], summed.mean(axis=1))
        sums[:, 1] = np.maximum(sums[:, 1], summed.std(axis=1))
        adapted = Innovation(
            predictor=self.predictor.corrected(*_steps(x, self.num_states)),
            offset=self.offset,
            whitening=self.whitening,
            clip=self.clip,
            charts=charts,
            sums=sums,
            longest_repeat=max(self.longest_repeat, *map(_longest_repeat, x)),
            step_s=self.step_s,
        )
        limited_sums = adapted._sums_with_limits(distance, limited)
        limited_sums[:, 2] = np.maximum(limited_sums[:, 2], self.sums[:, 2])
        return adapted._with(charts, limited_sums)

    def _sums_with_limits(self, distance: np.ndarray, limited: np.ndarray) -> np.ndarray:
        norm = np.linalg.norm(limited, axis=1)
        limits = [
            limit_of(self._summed(i, one), self.step_s) for i, one in enumerate((distance, norm))
        ]
        return np.column_stack([self.sums[:, :2], limits])

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all that `from_arrays` needs, by name."""
        predictor = self.predictor
        found = {
            "mean": predictor.mean,
            "scale": predictor.scale,
            "linear": predictor.linear,
            "bias": predictor.bias,
            "offset": self.offset,
            "whitening": self.whitening,
            "sums": self.sums,
            "chart_limits": np.array([chart.limit for chart in self.charts]),
            "chart_whitenings": np.stack([chart.whitening for chart in self.charts]),
            "settings": np.array([self.clip, self.longest_repeat, self.step_s]),
        }
        for i, (weight, bias) in enumerate(predictor.layers):
            found |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
        return found

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], *, num_inputs: int, num_states: int
    ) -> Innovation:
        """Makes the innovation of arrays written by `arrays`.

        Args:
            arrays: The arrays by name.
            num_inputs: n_x.
            num_states: n_s.

        Raises:
            KeyError: One is missing.
            ValueError: A shape is wrong, or a number is not finite.
        """
        widths = (num_inputs, *HIDDEN_SIZES, num_states)
        square, n_charts = (num_states, num_states), len(TIME_CONSTANTS_S)
        shapes: dict[str, tuple[int, ...]] = {
            "mean": (num_inputs,),
            "scale": (num_inputs,),
            "linear": (num_inputs, num_states),
            "bias": (num_states,),
            "offset": (num_states,),
            "whitening": square,
            "sums": (2, 3),
            "chart_limits": (n_charts,),
            "chart_whitenings": (n_charts, *square),
            "settings": (3,),
        }
        for i in range(len(HIDDEN_SIZES) + 1):
            shapes[f"layer.{i}.weight"] = (widths[i], widths[i + 1])
            shapes[f"layer.{i}.bias"] = (widths[i + 1],)
        for name, shape in shapes.items():
            array = arrays[name]
            # A limit may be infinite.
            if array.shape != shape or np.isnan(array).any():
                raise ValueError(
                    f"the shape of its innovation.{name} is {array.shape}, expected {shape} of "
                    "numbers"
                )
        layers = [
            (arrays[f"layer.{i}.weight"], arrays[f"layer.{i}.bias"])
            for i in range(len(HIDDEN_SIZES) + 1)
        ]
        clip, longest_repeat, step_s = arrays["settings"]
        return cls(
            predictor=Predictor(
                layers=tuple(layers),
                **{name: arrays[name] for name in ("mean", "scale", "linear", "bias")},
            ),
            offset=arrays["offset"],
            whitening=arrays["whitening"],
            clip=clip,
            charts=[
                Chart(time_constant_s=t, whitening=whitening, limit=float(limit))
                for t, whitening, limit in zip(
                    TIME_CONSTANTS_S,
                    arrays["chart_whitenings"],
                    arrays["chart_limits"],
                    strict=True,
                )
            ],
            sums=arrays["sums"],
            longest_repeat=int(longest_repeat),
            step_s=step_s,
        )

    def _with(self, charts: Sequence[Chart], sums: np.ndarray) -> Innovation:
        return Innovation(
            predictor=self.predictor,
            offset=self.offset,
            whitening=self.whitening,
            clip=self.clip,
            charts=charts,
            sums=sums,
            longest_repeat=self.longest_repeat,
            step_s=self.step_s,
        )

    def of(self, x: np.ndarray, next_state: np.ndarray) -> np.ndarray:
        """Returns whitened innovations of limited norm, (N, n_s).

        Args:
            x: Inputs, (N, n_x).
            next_state: State one step later, (N, n_s).
        """
        return self.limited(next_state - x[:, : self.num_states] - self.predictor(x))

    def limited(self, errors: np.ndarray) -> np.ndarray:
        """Whitens errors of prediction (N, n_s) and limits their norm."""
        whitened = (errors - self.offset) @ self.whitening
        norm = np.sqrt(np.einsum("ij,ij->i", whitened, whitened))
        return whitened * np.minimum(1.0, self.clip / np.maximum(norm, 1e-12))[:, None]

    def next_sums(self, sums: np.ndarray, distance: float, innovation: np.ndarray) -> np.ndarray:
        """Returns both CUSUMs (2,) after one more step.

        Args:
            sums: The CUSUMs before it, (2,).
            distance: Novelty of the input.
            innovation: Whitened innovation of limited norm, (n_s,).
        """
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
            for column, (chart, rate) in enumerate(zip(self.charts, self.rates, strict=True), 3):
                averages = averaged(innovations, rate)
                found[is_step, column] = (
                    np.linalg.norm(averages @ chart.whitening, axis=1) / chart.limit
                )
        # The first row of a motion shows the last values.
        last = np.maximum.accumulate(np.where(is_step, np.arange(len(found)), 0))
        return found[last]

    def deviations(self, kind: str, average: np.ndarray) -> np.ndarray:
        """Returns the mean error of each state, in its standard deviations on the nominal plant.

        Args:
            kind: The chart, "fast" or "slow".
            average: The chart's mean of whitened innovations, (n_s,).

        Returns:
            (n_s,), positive where the state grows more than predicted.
        """
        chart = self.charts[("fast", "slow").index(kind)]
        unwhitening = np.linalg.inv(self.whitening)
        root = np.linalg.inv(chart.whitening) @ unwhitening
        return (average @ unwhitening) / np.linalg.norm(root, axis=0)


def describe(kind: str, deviations: np.ndarray, state_names: Sequence[str]) -> str:
    """Says what an alarm saw, as far as the errors tell; "" without one.

    Args:
        kind: One of ``KINDS``.
        deviations: Mean error of each state in standard deviations, (n_s,); for charts only.
        state_names: Names of the states.
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


def _errors(predictor: Predictor, x: np.ndarray, num_states: int) -> np.ndarray:
    return np.diff(x[:, :num_states], axis=0) - predictor(x[:-1])


def _repeats(x: np.ndarray) -> np.ndarray:
    """Length of the run of inputs that repeat the one before, from the second input on, (K,)."""
    runs, run = np.zeros(len(x) - 1), 0
    for i, is_same in enumerate(np.all(x[1:] == x[:-1], axis=1)):
        run = run + 1 if is_same else 0
        runs[i] = run
    return runs


def _longest_repeat(x: np.ndarray) -> int:
    return int(_repeats(x).max(initial=0.0))
