import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.robots.robot import ObservationNoise
from drake_safety.simulation.observers import Observers
from legged_robots import robot_kinematics

NOISE = ObservationNoise(position=0.01, velocity=0.02)


class Bench:
    """A robot that stands still, observed without noise, with noise, and with the same again."""

    def __init__(self):
        kinematics = robot_kinematics("laikago")
        q, v = kinematics.standing_positions(), np.zeros(kinematics.num_velocities)
        builder = DiagramBuilder()
        source = builder.AddSystem(ConstantVectorSource(np.concatenate([q, v])))
        self.observers = Observers(builder, kinematics, source.get_output_port(), 0.01)
        self.exact = self.observers.add("exact", ObservationNoise())
        self.noisy = self.observers.add("noisy", NOISE)
        self.same = self.observers.add("same", NOISE)
        self.diagram = builder.Build()

    def seeded(self, seed):
        context = self.diagram.CreateDefaultContext()
        self.observers.reseed(context, np.random.default_rng(seed))
        return context

    def observed(self, context):
        return [
            observer.GetOutputPort("state").Eval(observer.GetMyContextFromRoot(context)).copy()
            for observer in (self.exact, self.noisy)
        ]


@pytest.fixture(scope="module")
def bench():
    return Bench()


def test_noise_follows_from_the_generator_is_held_for_a_period_and_can_be_silenced(bench):
    exact, noisy = bench.observed(bench.seeded(0))
    np.testing.assert_array_equal(bench.observed(bench.seeded(0)), [exact, noisy])
    assert not np.array_equal(noisy, bench.observed(bench.seeded(1))[1])
    assert not np.array_equal(noisy, exact)
    context = bench.seeded(0)
    bench.observers.silence(context)
    np.testing.assert_array_equal(bench.observed(context)[1], exact)
    simulator = Simulator(bench.diagram, context)
    values = []
    for time_s in (0.011, 0.019, 0.021):
        simulator.AdvanceTo(time_s)
        values.append(bench.observed(context)[1])
    np.testing.assert_array_equal(values[0], values[1])
    assert not np.array_equal(values[1], values[2]) and not np.array_equal(values[0], exact)
