import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_safety.plants.pushes import Push
from drake_safety.systems.push_source import PushSource

MASS_KG = 4.0
STEP_S = 2.0**-10  # Sums of it are exact: a push lasts a whole number of steps.
PERIOD_S = 2.0**-6
FORCE_N = np.array([6.0, -2.0, 1.0])


class FloatingBox(Diagram):
    """A box without gravity whose centre of mass is not its origin."""

    def __init__(self):
        super().__init__()
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, STEP_S)
        instance = self.plant.AddModelInstance("box")
        inertia = SpatialInertia.SolidBoxWithMass(MASS_KG, 0.2, 0.3, 0.4)
        self.body = self.plant.AddRigidBody(
            "trunk", instance, inertia.Shift(np.array([-0.1, 0.2, -0.3]))
        )
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self.plant.Finalize()
        self.source = builder.AddSystem(PushSource(self.plant, instance, period_s=PERIOD_S))
        builder.Connect(
            self.source.get_output_port(), self.plant.get_applied_spatial_force_input_port()
        )
        builder.BuildInto(self)

    def set_push(self, context, body="trunk", *, start_s=0.125, duration_s=0.25):
        source_context = self.source.GetMyMutableContextFromRoot(context)
        push = Push(body=body, force_n=FORCE_N.tolist(), time_s=start_s, duration_s=duration_s)
        self.source.set_push(source_context, push)

    def velocity(self, context):
        """Angular velocity and velocity of the centre of mass, (6,)."""
        plant_context = self.plant.GetMyContextFromRoot(context)
        p_BoC = self.body.CalcCenterOfMassInBodyFrame(plant_context)
        V_WB = self.body.EvalSpatialVelocityInWorld(plant_context)
        R_WB = self.body.EvalPoseInWorld(plant_context).rotation()
        return V_WB.Shift(R_WB @ p_BoC).get_coeffs()


@pytest.mark.parametrize("start_s", [0.0, 0.125, 0.13])  # The last between two updates.
def test_a_push_on_a_floating_body_changes_its_velocity_by_impulse_over_mass(start_s):
    loop = FloatingBox()
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.set_push(context, start_s=start_s)
    simulator.AdvanceTo(start_s)
    np.testing.assert_array_equal(loop.velocity(context), np.zeros(6))
    simulator.AdvanceTo(0.5)
    expected = [0.0, 0.0, 0.0, *FORCE_N * 0.25 / MASS_KG]
    np.testing.assert_allclose(loop.velocity(context), expected, rtol=0.0, atol=1e-10)


def test_contexts_of_one_source_are_pushed_each_by_its_own_and_a_cleared_push_never_comes():
    loop = FloatingBox()
    pushed, cleared, left_alone = simulators = [Simulator(loop) for _ in range(3)]
    for simulator in (pushed, cleared):
        loop.set_push(simulator.get_mutable_context())
    own = loop.source.GetMyMutableContextFromRoot(cleared.get_mutable_context())
    loop.source.clear_push(own)
    for simulator in simulators:
        simulator.AdvanceTo(0.5)
    assert np.abs(loop.velocity(pushed.get_context())).max() > 0.1
    for simulator in (cleared, left_alone):
        np.testing.assert_array_equal(loop.velocity(simulator.get_context()), np.zeros(6))
