"""A task of one's own without goal, ball and robot on legs: a cart that balances a pole."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import MeshcatVisualizer
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem

from drake_safety.simulation.closed_loop import ClosedLoop

_LINK = (
    '<link name="{0}"><inertial><origin xyz="0 0 {1}"/><mass value="{2}"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
    '<visual><origin xyz="0 0 {1}"/><geometry><box size="{3}"/></geometry></visual></link>'
)
CART_POLE = (
    '<robot name="cart_pole"><link name="world"/>'
    + _LINK.format("cart", 0, 1.0, "0.3 0.2 0.1")
    + _LINK.format("pole", 0.4, 0.2, "0.03 0.03 0.8")
    + '<joint name="x" type="prismatic"><parent link="world"/><child link="cart"/>'
    '<axis xyz="1 0 0"/><limit effort="100"/></joint>'
    '<joint name="tilt" type="continuous"><parent link="cart"/><child link="pole"/>'
    '<axis xyz="0 1 0"/></joint>'
    '<transmission><type>SimpleTransmission</type><joint name="x"/><actuator name="x"/>'
    "</transmission></robot>"
)
GAINS = np.array([-3.0, -60.0, -5.0, -12.0])  # Of x, tilt and their rates.


@dataclass(kw_only=True)
class CartPoleParameters:
    """What a scenario may say."""

    tilt_rad: float = 0.5
    """Largest tilt at the start."""


class Balancer(LeafSystem):
    """A force on the cart by feedback of the state, and what the task exports of it."""

    def __init__(self, horizon):
        super().__init__()
        self.DeclareVectorInputPort("plant_state", 4)
        ports = {
            "force": (1, lambda s: [np.clip(-GAINS @ s, -15.0, 15.0)]),
            "state": (4, lambda s: s),
            "true_state": (4, lambda s: s),
            "output": (3, lambda s: [s[0], 0.0, 0.0]),
            "desired_output": (3, lambda s: np.zeros(3)),
            "desired_preview": (3 * horizon, lambda s: np.zeros(3 * horizon)),
            "features": (2, self.margins),
            "margins": (2, self.margins),
            "safe": (1, lambda s: [float(min(self.margins(s)) >= 0)]),
        }
        for name, (size, calc) in ports.items():
            self.DeclareVectorOutputPort(
                name,
                BasicVector(size),
                lambda context, output, calc=calc: output.SetFromVector(
                    calc(self.get_input_port().Eval(context))
                ),
            )

    @staticmethod
    def margins(s):
        return [1.0 - abs(s[0]), 0.6 - abs(s[1])]


class CartPole(ClosedLoop):
    """The whole task."""

    Parameters = CartPoleParameters
    angular_constraints = ("tilt",)

    def __init__(self, scenario, variation="nominal", *, assessment=None, meshcat=None):
        super().__init__(scenario, variation, assessment)
        self.state_names = ["x", "tilt", "x_rate", "tilt_rate"]
        self.output_names = ["x", "y", "z"]
        self.feature_names = ["x_margin", "tilt_margin"]
        self.constraint_names = ["rail", "tilt"]
        builder = DiagramBuilder()
        self.cart, scene_graph = AddMultibodyPlantSceneGraph(builder, scenario.time_step_s)
        Parser(self.cart).AddModelsFromString(CART_POLE, "urdf")
        self.cart.Finalize()
        balancer = builder.AddSystem(Balancer(scenario.assessment.horizon))
        builder.Connect(self.cart.get_state_output_port(), balancer.get_input_port())
        builder.Connect(balancer.GetOutputPort("force"), self.cart.get_actuation_input_port())
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        ports = map(balancer.get_output_port, range(1, balancer.num_output_ports()))
        self.export(builder, {port.get_name(): port for port in ports}, period_s=scenario.step_s)
        builder.BuildInto(self)

    def reset(self, context, rng):
        tilt = self.scenario.parameters.tilt_rad
        start = rng.uniform([-0.5, -tilt, -1.0, -1.0], [0.5, tilt, 1.0, 1.0])
        context.SetTime(0.0)
        cart_context = self.cart.GetMyMutableContextFromRoot(context)
        self.cart.SetPositionsAndVelocities(cart_context, start)
        return 0


SCENARIO = """
task: cart_pole_task:CartPole
robot: none
episode_duration_s: 2.0
step_s: 0.1
time_step_s: 0.005
control_period_s: 0.02
variations: {nominal: {}, actual: {}}
assessment: {horizon: 8}
"""
