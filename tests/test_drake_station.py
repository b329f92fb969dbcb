"""A station as Drake's users write them, from a scenario YAML with directives, in a loop with Γ."""

import dataclasses
import logging
from collections.abc import Mapping

import numpy as np
import pytest
from pydrake.common import RandomGenerator
from pydrake.common.yaml import yaml_load_typed
from pydrake.lcm import DrakeLcmParams
from pydrake.manipulation import ApplyDriverConfigs, IiwaDriver, ZeroForceDriver
from pydrake.multibody.parsing import ModelDirective, ModelDirectives, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.lcm import ApplyLcmBusConfig
from pydrake.systems.primitives import AffineSystem
from pydrake.visualization import ApplyVisualizationConfig, VisualizationConfig

from drake_safety import AddSafetyAssessor, AssessmentParameters, SafetyAssessment, record_episodes
from drake_safety.logs.mcap_recorder import McapRecorder
from toy_tasks import declare_outputs

HORIZON, STEP_S, UPRIGHT = 4, 0.05, np.array([0.0, np.pi, 0.0, 0.0])
POLE_RAD, PUSH_RAD_S = 0.1, 3.0
SCENARIO = """
plant_config: {time_step: 0.002, use_sampled_output_ports: false}
directives:
- add_model:
    name: cart_pole
    file: package://drake/examples/multibody/cart_pole/cart_pole.sdf
    default_joint_positions: {PolePin: [3.141592653589793]}
- add_model:
    name: spare
    file: package://drake/examples/multibody/cart_pole/cart_pole.sdf
- add_frame:
    name: aside
    X_PF: {base_frame: world, translation: [0, 5, 0]}
model_drivers:
  spare: !ZeroForceDriver {}
lcm_buses:
  default: {lcm_url: "memq://null"}
visualization: {enable_meshcat_creation: false}
"""


@dataclasses.dataclass
class Scenario:
    plant_config: MultibodyPlantConfig = dataclasses.field(default_factory=MultibodyPlantConfig)
    directives: list[ModelDirective] = dataclasses.field(default_factory=list)
    model_drivers: Mapping[str, IiwaDriver | ZeroForceDriver] = dataclasses.field(
        default_factory=dict
    )
    lcm_buses: Mapping[str, DrakeLcmParams] = dataclasses.field(default_factory=dict)
    visualization: VisualizationConfig = dataclasses.field(default_factory=VisualizationConfig)


def make_station(text):
    """The station as a diagram: plant, drivers, LCM and visualisation of the scenario."""
    scenario = yaml_load_typed(schema=Scenario, data=text, defaults=Scenario())
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(scenario.plant_config, builder)
    models = ProcessModelDirectives(ModelDirectives(directives=scenario.directives), plant)
    plant.Finalize()
    buses = ApplyLcmBusConfig(scenario.lcm_buses, builder)
    ApplyDriverConfigs(
        driver_configs=scenario.model_drivers,
        sim_plant=plant,
        models_from_directives=models,
        lcm_buses=buses,
        builder=builder,
    )
    ApplyVisualizationConfig(scenario.visualization, builder, buses)
    cart_pole = plant.GetModelInstanceByName("cart_pole")
    builder.ExportOutput(plant.get_state_output_port(cart_pole), "cart_pole.state")
    builder.ExportInput(plant.get_actuation_input_port(cart_pole), "cart_pole.actuation")
    station = builder.Build()
    station.set_name("station")
    return station


class Balance(LeafSystem):
    """Γ's inputs from the station: z, its preview, and the pole's distance from falling."""

    def __init__(self):
        super().__init__()
        x = self.DeclareVectorInputPort("state", 4)
        ports = {
            "output": (1, lambda cart, *_: [cart]),
            "desired_preview": (HORIZON, lambda *_: np.zeros(HORIZON)),
            "margins": (1, lambda cart, pole, *_: [POLE_RAD - abs(pole - np.pi)]),
        }
        declare_outputs(self, ports, x.Eval)


def balancing_gain():
    """LQR of the upright cart-pole: 10 kg, 1 kg at 0.5 m."""
    A, B = np.zeros((4, 4)), np.array([[0.0], [0.0], [0.1], [0.2]])
    A[:2, 2:], A[2:, 1] = np.eye(2), [0.981, 21.6]
    return LinearQuadraticRegulator(A, B, np.diag([1.0, 10.0, 1.0, 1.0]), np.array([[0.1]]))[0]


def make_diagram(assessment=None, text=SCENARIO):
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(text))
    balance = builder.AddSystem(Balance())
    K = balancing_gain()
    controller = builder.AddSystem(AffineSystem(D=-K, y0=K @ UPRIGHT))
    state = station.GetOutputPort("cart_pole.state")
    for port in (balance.get_input_port(), controller.get_input_port()):
        builder.Connect(state, port)
    builder.Connect(controller.get_output_port(), station.GetInputPort("cart_pole.actuation"))
    builder.ExportOutput(state, "state")
    ports = {name: balance.GetOutputPort(name) for name in ("output", "desired_preview", "margins")}
    for name, port in ports.items():
        builder.ExportOutput(port, name)
    if assessment is not None:
        del ports["output"]
        assessor = AddSafetyAssessor(builder, assessment, state=state, **ports)
        builder.ExportOutput(assessor.GetOutputPort("belief"), "belief")
    return builder.Build()


def start(diagram, context, rate_rad_s):
    plant = diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
    cart_pole, plant_context = (
        plant.GetModelInstanceByName("cart_pole"),
        plant.GetMyMutableContextFromRoot(context),
    )
    plant.SetVelocities(plant_context, cart_pole, [0.0, rate_rad_s])


def reset(diagram, context, rng):
    diagram.SetRandomContext(context, RandomGenerator(int(rng.integers(2**31))))
    start(diagram, context, rng.uniform(-PUSH_RAD_S, PUSH_RAD_S))


@pytest.mark.train
def test_a_station_of_directives_is_recorded_learned_and_assessed(caplog, tmp_path):
    times = {"duration_s": 0.6, "step_s": STEP_S, "num_workers": 1}
    episodes = record_episodes(make_diagram, 40, reset=reset, constraint_names=["pole"], **times)
    assert 5 < episodes.num_unsafe < 35
    parameters = AssessmentParameters(
        horizon=HORIZON, ensemble_size=1, epochs=60, hidden_sizes=[32], perplexity=10.0, min_count=1
    )
    assessment = SafetyAssessment(parameters).fit(episodes)
    caplog.clear()
    diagram = make_diagram(assessment)
    assert not [one for one in caplog.messages if "later state" in one]
    beliefs = []
    for rate_rad_s in (0.2, 0.9 * PUSH_RAD_S):
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        start(diagram, context, rate_rad_s)
        with McapRecorder(diagram, tmp_path / "station.mcap") as recorder:
            simulator.set_monitor(recorder)
            simulator.AdvanceTo(0.01)
        beliefs.append(diagram.GetOutputPort("belief").Eval(context).copy())
    (calm, falls, _), (stays, fast, _) = beliefs
    assert calm > falls and fast > stays, beliefs
    assert (tmp_path / "station.mcap").stat().st_size > 1000


def test_a_station_whose_plant_has_sampled_ports_is_warned_of(caplog):
    text = SCENARIO.replace("use_sampled_output_ports: false", "use_sampled_output_ports: true")
    with caplog.at_level(logging.WARNING):
        record_episodes(
            lambda: make_diagram(text=text),
            2,
            reset=reset,
            duration_s=0.2,
            step_s=STEP_S,
            num_workers=1,
        )
    assert "plant 'plant' shows a later state" in caplog.text
