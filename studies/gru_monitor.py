"""A recurrent monitor after RAPT (Munn et al., arXiv 2602.01515), with forward dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from drake_safety.simulation.worker_processes import Progress

_HIDDEN, _WINDOW, _BATCH, _EPOCHS, _MOST_STEPS = 256, 50, 64, 120, 6000
_RATE, _DECAY, _LARGEST_GRADIENT, _INPUT_NOISE = 2e-3, 1e-2, 1.0, 0.01
_LARGEST_LOG = 6.0  # Of a variance.
_LEAST_SPREAD, _LARGEST_INPUT = 1e-4, 10.0  # [unit of the column], in standard deviations.
_HELD_OUT = 5  # Of so many motions, one is for the limits.
_EPISODE = 1000  # Rows.


class GruMonitor:
    """Predicts mean and variance of the next change of each state from all inputs so far.

    RAPT predicts the state itself, by more layers before and after its GRU. The level of a state is
    its squared error by the variance, in units of the largest of held-out motion plus five standard
    deviations. A last level is the mean over states, in units of the mean of these largest plus
    three standard deviations of that of an episode.

    Args:
        motions: Inputs (K, n_u), whose first columns are the states; two motions at least.
        num_states: n_w.
        progress: Called with the number of steps done and wanted.

    Raises:
        ValueError: There is one motion of 51 rows or none.
    """

    def __init__(
        self, motions: Sequence[np.ndarray], num_states: int, progress: Progress | None = None
    ):
        motions = [one for one in motions if len(one) > _WINDOW]
        if len(motions) < 2:
            raise ValueError(
                f"GRU: {len(motions)} motions have {_WINDOW + 1} rows; two are needed, one to "
                "learn from and one for the limits"
            )
        held_out = motions[::_HELD_OUT]
        learned = [one for i, one in enumerate(motions) if i % _HELD_OUT]
        every = np.concatenate(learned)
        self._num_states = num_states
        self._mean = every.mean(axis=0)
        self._scale = np.maximum(every.std(axis=0), _LEAST_SPREAD)
        change = np.concatenate([np.diff(one[:, :num_states], axis=0) for one in learned])
        self._unit = np.maximum(change.std(axis=0), 1e-9)
        self._network = self._learned(learned, progress)
        losses = np.concatenate([self._losses(one) for one in held_out])
        pieces = [losses[i : i + _EPISODE] for i in range(0, len(losses), _EPISODE)]
        largest = losses.max(axis=0)
        of_episodes = [one.max(axis=0).mean() for one in pieces]
        self._limits = largest + 5.0 * losses.std(axis=0)
        self._limit_of_mean = largest.mean() + 3.0 * float(np.std(of_episodes))

    def levels(self, x: np.ndarray) -> np.ndarray:
        """Levels of a motion's inputs (K, n_u), (K, n_w + 1); 0 in the first row."""
        losses = self._losses(x)
        mean = losses.mean(axis=1, keepdims=True) / self._limit_of_mean
        levels = np.concatenate([losses / self._limits, mean], axis=1)
        return np.concatenate([np.zeros((1, levels.shape[1])), levels])

    def _pairs(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scaled inputs (K - 1, n_u) and the changes of states after them (K - 1, n_w)."""
        z = np.clip((x[:-1] - self._mean) / self._scale, -_LARGEST_INPUT, _LARGEST_INPUT)
        y = np.diff(x[:, : self._num_states], axis=0) / self._unit
        return z.astype(np.float32), y.astype(np.float32)

    def _losses(self, x: np.ndarray) -> np.ndarray:
        """Squared errors by variances from the second row on, (K - 1, n_w)."""
        import torch

        z, y = self._pairs(x)
        if not len(z):
            return np.zeros((0, self._num_states))
        with torch.no_grad():
            middle, log_variance = self._network(torch.tensor(z)[None])
        errors: np.ndarray = np.exp(-log_variance[0].numpy()) * (y - middle[0].numpy()) ** 2
        return errors

    def _learned(self, motions: Sequence[np.ndarray], progress: Progress | None) -> Any:
        """Trains the network on random windows."""
        import torch

        from drake_safety.learning.maps import one_torch_thread

        pairs = [tuple(map(torch.tensor, self._pairs(one))) for one in motions]
        rows = np.array([len(z) for z, _ in pairs])
        per_epoch = max(1, round(int(rows.sum()) / (_WINDOW * _BATCH)))
        num_steps = min(_EPOCHS * per_epoch, _MOST_STEPS)
        rng = np.random.default_rng(0)
        with one_torch_thread():
            torch.manual_seed(0)
            network = _network(len(self._mean), self._num_states)
            optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
            schedule = torch.optim.lr_scheduler.OneCycleLR(
                optimiser, _RATE, total_steps=num_steps + 1
            )
            for step in range(num_steps):
                which = rng.choice(len(rows), size=_BATCH, p=rows / rows.sum())
                starts = rng.integers(rows[which] - _WINDOW + 1)
                x, y = (
                    torch.stack(
                        [pairs[i][k][s : s + _WINDOW] for i, s in zip(which, starts, strict=True)]
                    )
                    for k in range(2)
                )
                middle, log_variance = network(x + _INPUT_NOISE * torch.randn_like(x))
                loss = (torch.exp(-log_variance) * (y - middle) ** 2 + log_variance).mean()
                optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
                optimiser.step()
                schedule.step()
                if progress is not None:
                    progress(step + 1, num_steps)
        return network


def _network(num_inputs: int, num_states: int) -> Any:
    import torch

    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.encoder = torch.nn.Linear(num_inputs, _HIDDEN)
            self.memory = torch.nn.GRU(_HIDDEN, _HIDDEN, batch_first=True)
            self.decoder = torch.nn.Linear(_HIDDEN, 2 * num_states)

        def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            hidden, _ = self.memory(torch.relu(self.encoder(x)))
            middle, log_variance = self.decoder(hidden).chunk(2, dim=-1)
            return middle, log_variance.clamp(-_LARGEST_LOG, _LARGEST_LOG)

    return Network()
