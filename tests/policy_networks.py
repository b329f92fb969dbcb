"""A small network in a file, for tests."""

import warnings


def save_network(path, num_inputs, num_outputs, scale=0.01):
    """Writes a TorchScript network, a matrix of ascending weights; with scale 0 it rests.

    Returns its path.
    """
    import torch

    linear = torch.nn.Linear(num_inputs, num_outputs, bias=False)
    weight = torch.arange(num_inputs * num_outputs) * scale
    linear.weight = torch.nn.Parameter(weight.reshape(num_inputs, num_outputs).T)
    with warnings.catch_warnings():
        # Torch deprecates the format, in which policies are nevertheless published.
        warnings.simplefilter("ignore")
        torch.jit.script(linear).save(str(path))
    return path
