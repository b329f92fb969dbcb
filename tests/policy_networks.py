"""A small network in a file, for tests."""

import warnings

import torch


class Linear(torch.nn.Module):
    """A matrix of ascending weights."""

    def __init__(self, num_inputs, num_outputs, scale):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.arange(num_inputs * num_outputs) * scale)
        self.num_outputs: int = num_outputs

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x @ self.weight.reshape(-1, self.num_outputs)


def save_network(path, num_inputs, num_outputs, scale=0.01):
    """Writes a TorchScript network of given widths; returns its path. With scale 0 it rests."""
    with warnings.catch_warnings():
        # Torch deprecates the format, in which policies are nevertheless published.
        warnings.simplefilter("ignore")
        torch.jit.script(Linear(num_inputs, num_outputs, scale)).save(str(path))
    return path
