"""A push changes a body's momentum by force times time, and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_safety.simulation.pushes import Push, begin_push, end_push

MASS_KG = 4.0
STEP_S = 2.0**-10  # Sums of it are exact: a push lasts a whole number of steps.


class FloatingBox(Diagram):
    """A box without gravity whose centre of mass is not its origin."""

    def __init__(self):
        super().__init__()
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, STEP_S)
        self.robot = SimpleNamespace(name="box")
        self.robot_instance = self.plant.AddModelInstance("box")
        inertia = SpatialInertia.SolidBoxWithMass(MASS_KG, 0.2, 0.3, 0.4)
        self.body = self.plant.AddRigidBody(
            "trunk", self.robot_instance, inertia.Shift(np.array([-0.1, 0.2, -0.3]))
        )
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self.plant.Finalize()
        builder.ExportInput(
            self.plant.get_applied_spatial_force_input_port(), "applied_spatial_force"
        )
        builder.BuildInto(self)

    def velocity(self, context):
        """Angular velocity and velocity of the centre of mass, (6,)."""
        plant_context = self.plant.GetMyContextFromRoot(context)
        p_BoC = self.body.CalcCenterOfMassInBodyFrame(plant_context)
        V_WB = self.body.EvalSpatialVelocityInWorld(plant_context)
        R_WB = self.body.EvalPoseInWorld(plant_context).rotation()
        return V_WB.Shift(R_WB @ p_BoC).get_coeffs()


def test_a_push_on_a_floating_body_changes_its_velocity_by_impulse_over_mass():
    loop = FloatingBox()
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    push = Push(body="trunk", force_n=[6.0, -2.0, 1.0], duration_s=0.25)
    end_push(loop, context)
    simulator.AdvanceTo(0.125)
    np.testing.assert_array_equal(loop.velocity(context), np.zeros(6))
    begin_push(loop, context, push)
    simulator.AdvanceTo(0.125 + push.duration_s)
    pushed = loop.velocity(context)
    np.testing.assert_allclose(
        pushed,
        [0.0, 0.0, 0.0, *np.array(push.force_n) * push.duration_s / MASS_KG],
        rtol=0.0,
        atol=1e-10,
    )
    end_push(loop, context)
    simulator.AdvanceTo(0.5)
    np.testing.assert_allclose(loop.velocity(context), pushed, rtol=0.0, atol=1e-12)


def test_a_body_that_the_robot_does_not_have_is_answered_with_those_it_has():
    loop = FloatingBox()
    with pytest.raises(ValueError, match=r"'box' has no body 'head'; its bodies are \['trunk'\]"):
        begin_push(loop, loop.CreateDefaultContext(), Push(body="head"))


def test_a_push_is_as_strong_as_its_force_is_long():
    assert Push(force_n=[3.0, 0.0, -4.0]).strength_n == 5.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"force_n": [1.0, 2.0]}, r"force_n must be three numbers \[N\]; got \[1.0, 2.0\]"),
        ({"force_n": [1.0, 2.0, float("nan")]}, "force_n must be three numbers"),
        ({"time_s": -0.1}, "time_s must not be negative; got -0.1"),
        ({"duration_s": 0.0}, "duration_s must be positive; got 0.0"),
    ],
)
def test_a_push_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Push(**change)
