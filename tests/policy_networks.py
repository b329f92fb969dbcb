"""Small networks in files, for tests, and robots that are made of them."""

import warnings

import yaml
from typer.testing import CliRunner

from drake_safety.cli import make_app
from legged_robots import write_hexapod

TERMS = ["projected_gravity", "velocity_commands", "joint_pos_rel", "last_action"]
"""42 entries of observation of a hexapod."""
LEGS = [f"{part}_{i}" for i in range(6) for part in ("swing", "lift", "knee")]
GAINS = {"stiffness": 200.0, "damping": 4.0}


def new(folder, policy, *more):
    """`new` of a hexapod that walks by a policy: its folder, and what the command said."""
    write_hexapod(folder)
    urdf, out = folder / "hexapod.urdf", folder / "walker"
    words = ["new", "walker", "--urdf", str(urdf), "--out", str(out), "--task", "walking"]
    result = CliRunner().invoke(make_app(), [*words, "--policy", str(policy), *more])
    return out, result


def walker(folder, network):
    """The scenario of a hexapod that walks by a network."""
    out, _ = new(folder, network)
    stated = {
        "network": network.name,
        "joints": LEGS,
        "default_positions": yaml.safe_load((out / "robot.yaml").read_text())["posture"],
        "action_scale": {".*": 0.25},
        "gains": {".*": GAINS},
        "observation": [{"name": name} for name in TERMS],
    }
    (out / "policy.yaml").write_text(yaml.safe_dump(stated))
    return out / "walking.yaml"


def save_script(path, module, batch=None):
    """Writes a module as TorchScript, after an evaluation of a batch if one is given."""
    import torch

    with warnings.catch_warnings():
        # Torch deprecates the format, in which policies are nevertheless published.
        warnings.simplefilter("ignore")
        script = torch.jit.script(module.eval())
        if batch is not None:
            script(batch)
        script.save(str(path))
    return path


def save_network(path, num_inputs, num_outputs, scale=0.01):
    """Writes a TorchScript network, a matrix of ascending weights; with scale 0 it rests."""
    import torch

    linear = torch.nn.Linear(num_inputs, num_outputs, bias=False)
    weight = torch.arange(num_inputs * num_outputs) * scale
    linear.weight = torch.nn.Parameter(weight.reshape(num_inputs, num_outputs).T)
    return save_script(path, linear)


def recurrent_module(num_inputs, num_outputs, *, size=4, is_replaced=False):
    """An LSTM of random weights whose memory is in buffers, which it writes to or replaces."""
    import torch

    class Recurrent(torch.nn.Module):
        def __init__(self):
            super().__init__()
            torch.manual_seed(0)
            self.rnn = torch.nn.LSTM(num_inputs, size)
            self.out = torch.nn.Linear(size, num_outputs)
            self.is_replaced = is_replaced
            self.register_buffer("mean", torch.zeros(num_inputs))
            self.register_buffer("hidden_state", torch.zeros(1, 1, size))
            self.register_buffer("cell_state", torch.zeros(1, 1, size))

        def forward(self, x):
            memory = (self.hidden_state, self.cell_state)
            y, (h, c) = self.rnn((x - self.mean).unsqueeze(0), memory)
            if self.is_replaced:
                self.hidden_state, self.cell_state = h, c
            else:
                self.hidden_state[:], self.cell_state[:] = h.detach(), c.detach()
            return self.out(y.squeeze(0))

        @torch.jit.export
        def reset_memory(self):
            self.hidden_state[:] = 0.0
            self.cell_state[:] = 0.0

    return Recurrent()


def save_onnx(
    path, num_inputs, num_outputs, *, size=4, memory=(), shape=None, metadata=None, files=()
):
    """Writes an ONNX network of random weights: an LSTM, a GRU or, without memory, a matrix.

    Args:
        memory: Pairs of names of the memory's inputs and outputs: two for an LSTM, one for a GRU.
        files: Paths, from the file's folder, of files for the first weights.
    """
    import numpy as np
    import onnx
    from onnx import TensorProto, external_data_helper, helper, numpy_helper

    rng = np.random.default_rng(0)
    gates = {0: 0, 1: 3, 2: 4}[len(memory)] * size
    width = size if memory else num_inputs
    shapes = {"out": (width, num_outputs)}
    if memory:
        shapes |= {"W": (1, gates, num_inputs), "R": (1, gates, size), "B": (1, 2 * gates)}
    weights = {name: rng.normal(0, 0.5, s).astype(np.float32) for name, s in shapes.items()}
    weights |= {"sequence": np.array([1, 1, num_inputs]), "row": np.array([1, width])}
    nodes, last = [], "obs"
    if memory:
        nodes.append(helper.make_node("Reshape", ["obs", "sequence"], ["x"]))
        given = ["x", "W", "R", "B", "", *(name for name, _ in memory)]
        kind = "LSTM" if len(memory) == 2 else "GRU"
        new_memory = ["", *(name for _, name in memory)]
        nodes.append(helper.make_node(kind, given, new_memory, hidden_size=size))
        last = memory[0][1]
    nodes.append(helper.make_node("Reshape", [last, "row"], ["y"]))
    nodes.append(helper.make_node("MatMul", ["y", "out"], ["actions"]))

    def tensor(name, shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    observation = tensor("obs", shape or [1, num_inputs])
    inner = [1, 1, size]
    graph = helper.make_graph(
        nodes,
        "policy",
        [observation, *(tensor(name, inner) for name, _ in memory)],
        [tensor("actions", [1, num_outputs]), *(tensor(name, inner) for _, name in memory)],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    for key, value in (metadata or {}).items():
        model.metadata_props.append(onnx.StringStringEntryProto(key=key, value=value))
    for name, weight in zip(files, model.graph.initializer, strict=False):
        external_data_helper.set_external_data(weight, name)
        (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(path))
    return path
