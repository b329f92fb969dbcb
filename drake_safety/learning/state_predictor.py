"""Prediction of the next measured state from the last two inputs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_safety.files.progress import ignore
from drake_safety.learning.maps import one_torch_thread

HIDDEN_SIZES = (256, 256)
_SMALLEST_SPREAD = 1e-4  # Least scale of a column [its unit]: a column may be constant.
LARGEST_INPUT = 10.0  # In standard deviations.
_OUTSIDE = 0.005  # Share of training below and above the usual range of an input.
_VECTORS = ("mean", "scale", "low", "high", "unit")
_EPOCHS, _MOST_STEPS, _BATCH, _RATE, _DECAY = 25, 6000, 512, 2e-3, 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class StatePredictor:
    """Predicts the change of the measured state in one step.

    A network of two hidden layers beside a linear map, both of the last two inputs. Outside the
    usual range of an input it extrapolates and its errors say less: they are divided by the square
    root of one plus the largest distance from that range, in standard deviations. Without it a
    rare stumble of a walking robot looks like a changed plant.
    """

    mean: np.ndarray
    scale: np.ndarray
    low: np.ndarray  # Usual range of a standardised input, (n_u,).
    high: np.ndarray
    unit: np.ndarray  # Standard deviations of the change, (n_w,).
    weights: Mapping[str, np.ndarray]

    @classmethod
    def fit(
        cls,
        inputs: Sequence[np.ndarray],
        states: Sequence[np.ndarray],
        progress: Callable[[float], object] = ignore,
    ) -> StatePredictor:
        """Learns from inputs (K, n_u) and states (K, n_w) of motions of at least three rows."""
        import torch
        from torch.nn import functional

        every = np.concatenate(inputs)
        mean, scale = every.mean(axis=0), np.maximum(every.std(axis=0), _SMALLEST_SPREAD)
        change = np.concatenate([np.diff(rows, axis=0)[1:] for rows in states])
        unit = np.maximum(change.std(axis=0), 1e-9)
        low, high = np.quantile((every - mean) / scale, [_OUTSIDE, 1.0 - _OUTSIDE], axis=0)
        start = cls(mean=mean, scale=scale, low=low, high=high, unit=unit, weights={})
        x = torch.tensor(np.concatenate([start._pairs(rows) for rows in inputs]))
        y = torch.tensor((change / unit).astype(np.float32))
        with one_torch_thread():
            torch.manual_seed(0)
            network = _network(x.shape[1], y.shape[1])
            per_epoch = max(1, len(x) // _BATCH)
            num_steps = min(_EPOCHS * per_epoch, _MOST_STEPS)
            optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
            schedule = torch.optim.lr_scheduler.OneCycleLR(
                optimiser, _RATE, total_steps=num_steps + 1
            )
            order = torch.randperm(len(x))
            for step in range(num_steps):
                if (batch := step % per_epoch) == 0:
                    order = torch.randperm(len(x))
                rows = order[batch * _BATCH : (batch + 1) * _BATCH]
                hidden = x[rows]
                for layer in network["hidden"]:
                    hidden = functional.silu(layer(hidden))
                predicted = network["output"](hidden) + network["linear"](x[rows])
                loss = functional.smooth_l1_loss(predicted, y[rows])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
                if step % 50 == 0:
                    progress(step / num_steps)
        progress(1.0)
        weights = {k: v.detach().numpy().T.copy() for k, v in network.state_dict().items()}
        return replace(start, weights=weights)

    def _standardised(self, inputs: np.ndarray) -> np.ndarray:
        return np.clip((inputs - self.mean) / self.scale, -LARGEST_INPUT, LARGEST_INPUT)

    def _pairs(self, inputs: np.ndarray) -> np.ndarray:
        """Standardised inputs (K, n_u) beside their predecessors, (K - 2, 2 n_u)."""
        z = self._standardised(inputs)
        return np.concatenate([z[1:-1], z[:-2]], axis=1).astype(np.float32)

    def _divisor(self, z: np.ndarray) -> np.ndarray:
        """Divisor of errors after standardised inputs (..., n_u); grows outside the range."""
        beyond = np.maximum(z - self.high, self.low - z).max(axis=-1)
        return np.sqrt(1.0 + np.maximum(beyond, 0.0))

    def _evaluated(self, z: np.ndarray) -> np.ndarray:
        """Predicted changes in their units of standardised pairs, (..., n_w)."""
        w, hidden = self.weights, z
        for i in range(len(HIDDEN_SIZES)):
            hidden = hidden @ w[f"hidden.{i}.weight"] + w[f"hidden.{i}.bias"]
            hidden = hidden / (1.0 + np.exp(-np.maximum(hidden, -80.0)))
        return hidden @ w["output.weight"] + (z @ w["linear.weight"] + w["linear.bias"])

    def errors(self, inputs: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Errors of a motion's predicted states from the third row on, (K - 2, n_w)."""
        divisor = self._divisor(self._standardised(inputs[1:-1]))
        return self._residuals(inputs, states) / divisor[:, None]

    def _residuals(self, inputs: np.ndarray, states: np.ndarray) -> np.ndarray:
        predicted = self.unit * self._evaluated(self._pairs(inputs))
        return np.diff(states, axis=0)[1:] - predicted

    def error(self, x: np.ndarray, previous: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The error (n_w,) of a change (n_w,) after an input and its predecessor, (n_u,) each."""
        z = np.array((x, previous))
        z -= self.mean
        z /= self.scale
        np.maximum(z, -LARGEST_INPUT, out=z)  # Twice as fast as `np.clip`.
        np.minimum(z, LARGEST_INPUT, out=z)
        error = change - self.unit * self._evaluated(z.ravel().astype(np.float32))
        return error / self._divisor(z[0])

    def corrected(
        self, inputs: Sequence[np.ndarray], states: Sequence[np.ndarray]
    ) -> StatePredictor:
        """Returns the predictor with its linear map fitted to another plant's motions."""
        from sklearn.linear_model import Ridge

        z = np.concatenate([self._pairs(rows) for rows in inputs])
        errors = np.concatenate([*map(self._residuals, inputs, states)])
        # Few rows: what they do not determine stays as it was.
        ridge = Ridge(alpha=len(z) / 10.0).fit(z, errors / self.unit)
        weights = dict(self.weights)
        weights["linear.weight"] = (weights["linear.weight"] + ridge.coef_.T).astype(np.float32)
        weights["linear.bias"] = (weights["linear.bias"] + ridge.intercept_).astype(np.float32)
        return replace(self, weights=weights)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all that `from_arrays` needs, by name."""
        return {name: getattr(self, name) for name in _VECTORS} | dict(self.weights)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> StatePredictor:
        """Makes the predictor of arrays written by `arrays`."""
        own = {name: arrays[name].astype(float) for name in _VECTORS}
        weights = {k: v.astype(np.float32) for k, v in arrays.items() if k not in own}
        return cls(**own, weights=weights)


def _network(num_inputs: int, num_outputs: int) -> Any:
    from torch import nn

    widths = (num_inputs, *HIDDEN_SIZES)
    linear = nn.Linear(num_inputs, num_outputs)
    hidden = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))
    output = nn.Linear(widths[-1], num_outputs, bias=False)
    return nn.ModuleDict({"linear": linear, "hidden": hidden, "output": output})
