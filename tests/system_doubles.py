"""A system alone in a simulator, and doubles of what systems need: assessments, a policy."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from cart_episodes import make_info
from drake_safety.diagrams.walking.command_guard import CommandGuard
from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.prediction import Correction, Prediction
from drake_safety.policies.policy import (
    CommandLimits,
    GaitClock,
    ObservationTerm,
    Policy,
    PolicyParameters,
)
from drake_safety.policies.policy_network import PolicyNetwork
from drake_safety.robots.robot_model import JointGains
from drake_safety.systems.policy_controller import PolicyController

NOVELTY, STEP_S = 0.7, 0.04
LIMITS = CommandLimits(lowest=[-1.0, -0.5, -1.0], highest=[1.0, 0.5, 1.0])
HORIZON, OUTLOOK = 4, 3
INFO = make_info(
    variation="actual",
    step_s=STEP_S,
    horizon=3,
    constraint_names=["right", "left"],
    state_names=["x"],
    output_names=["x", "y", "z"],
    feature_names=["f"],
)


class Bench:
    """A system alone in a simulator; its inputs are given by name."""

    def __init__(self, system, **inputs):
        self.system = system
        self.simulator = Simulator(system)
        self.context = self.simulator.get_mutable_context()
        self.fix(**inputs)

    def fix(self, **inputs):
        for name, value in inputs.items():
            values = np.ravel(np.asarray(value, dtype=float))
            self.system.GetInputPort(name).FixValue(self.context, values)

    def get(self, name):
        return np.copy(self.system.GetOutputPort(name).Eval(self.context))

    def outputs(self):
        ports = map(self.system.get_output_port, range(self.system.num_output_ports()))
        return {port.get_name(): self.get(port.get_name()) for port in ports}

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    def begin(self):
        self.simulator.Initialize()
        return self


class Played:
    """A system in a diagram that plays rows of the system's inputs, row k at step k."""

    def __init__(self, system, step_s, **inputs):
        builder = DiagramBuilder()
        self.system, self.step_s = builder.AddSystem(system), step_s
        for name, rows in inputs.items():
            self.num_rows = len(rows)
            times = step_s * (np.arange(len(rows) + 1) - 0.5)
            # A polynomial of values that are not finite has none.
            held = PiecewisePolynomial.ZeroOrderHold(times, np.vstack([rows, rows[-1:]]).T)
            source = builder.AddSystem(TrajectorySource(held))
            builder.Connect(source.get_output_port(), system.GetInputPort(name))
        self.simulator = Simulator(builder.Build())
        self.context = system.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def history(self, *names):
        """Returns the outputs after each row, by name."""
        found = {name: [] for name in names}
        for row in range(self.num_rows):
            self.simulator.AdvanceTo((row + 0.25) * self.step_s)
            for name, values in found.items():
                values.append(np.copy(self.system.GetOutputPort(name).Eval(self.context)))
        return {name: np.array(values) for name, values in found.items()}


def begun(loop, reset, *arguments):
    """Resets a loop; returns its initialised simulator and the root Context."""
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    reset(context, *arguments)
    simulator.Initialize()
    return simulator, context


def correction(size):
    """One of maps with three activations, for six cells."""
    return Correction(
        change=np.full(3, size),
        hidden=np.full((1, 4), size),
        hidden_range=np.array([-size, size]),
        guard=np.ones((1, 6)),
    )


class AssessmentDouble:
    """b_safe is the state's first entry times the first belief; it keeps what it was asked."""

    def __init__(self, uses_features=True):
        self.info_ = SimpleNamespace(
            state_names=["a", "b"],
            output_names=["x", "y", "z"],
            feature_names=["f", "g", "h"],
            constraint_names=["left", "right"],
            horizon=2,
        )
        self.beliefs_ = np.arange(1.0, 31.0).reshape(1, 6, 5)
        self.correction_ = correction(0.0)
        self.base_logit_ = object()
        self.fall_logit_ = object()
        self.novelty_ = Novelty(training=Moments.of(np.eye(3)), limits=np.ones(3), plan=slice(0))
        self.embedding_ = SimpleNamespace(is_same=lambda other: False)
        self.uses_features = uses_features
        self.asked, self.novelties = [], []

    def predict_one(self, state, desired_preview, features, *, beliefs, correction, novelty):
        self.novelties.append(novelty)
        self.asked.append((state.copy(), desired_preview.copy(), features, beliefs.copy()))
        if not np.isfinite(state).all():
            safe, belief = 0.0, [0.0, 0.0, 1.0]
        else:
            safe = state[0] * beliefs[0, 0, 0]
            belief = [safe, 0.9 - safe, 0.1]
        probability = safe + correction.hidden[0, 3] * correction.guard[0, 5]
        return Prediction(
            belief=np.array(belief),
            probability=probability,
            cause_probability=np.array([0.2, 0.3]),
            embedding=np.array([3.0, -4.0]),
            predicted_margins=np.array([0.01, np.nan]),
            novelty=NOVELTY,
            fall_probability=0.125 if np.isfinite(state).all() else np.nan,
        )


class SlowIsSafe:
    """Γ is 1 up to a forward speed, and 0 beyond; its features are the command."""

    parameters = SimpleNamespace(initial_uncertainty=0.3)
    info_ = SimpleNamespace(horizon=HORIZON, state_names=["s"], feature_names=["x", "y", "yaw"])

    def __init__(self, fastest=1.5, novelty=0.0):
        self.fastest, self.novelty = fastest, novelty
        self.seen = []

    def predict(self, state, desired_preview, features):
        np.testing.assert_array_equal(desired_preview, np.tile(features, HORIZON))
        self.seen.append(len(state))
        gamma = (features[:, 0] <= self.fastest + 1e-9).astype(float)
        n = len(gamma)
        if self.novelty > 1.0:
            gamma = np.zeros(n)
        return Prediction(
            belief=np.column_stack([0.7 * gamma, 0.7 * (1 - gamma), np.full(n, 0.3)]),
            embedding=np.zeros((n, 2)),
            cause_probability=np.zeros((n, 1)),
            probability=gamma,
            predicted_margins=np.zeros((n, 1)),
            novelty=np.full(n, self.novelty),
            fall_probability=np.zeros(n),
        )


def guard(assessment, **options):
    return CommandGuard(
        assessment,
        lambda features, commands: commands,
        LIMITS,
        **{"threshold": 0.5, "period_s": 0.1, "num_outlook": OUTLOOK, **options},
    )


class Kinematics:
    num_positions, num_velocities, num_states, num_joints = 9, 8, 17, 2


def controller(evaluate=lambda batch, parts: (batch[:, :2] + 1.0, {}), **start):
    network = PolicyNetwork(None, evaluate, (9, 2), start=start)
    terms = ["velocity_commands", "last_action", "sin_phase", "cos_phase"]
    parameters = PolicyParameters(
        network="net.onnx",
        joints=["b", "a"],
        default_positions={".*": 0.0},
        action_scale={".*": 0.5},
        gains={".*": JointGains(stiffness=1.0)},
        observation=[ObservationTerm(name=name) for name in terms],
        gait=GaitClock(period_s=0.2),
    )
    with mock.patch("drake_safety.policies.policy.load_network", lambda path: network):
        return PolicyController(Kinematics(), Policy(parameters, ["a", "b"]))
