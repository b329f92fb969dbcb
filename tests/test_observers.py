import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.robots.robot import ObservationNoise
from drake_safety.simulation.observers import Observers, combined
from legged_robots import robot_kinematics

NOISE = ObservationNoise(position=0.01, velocity=0.02)


class Bench:
    """A robot that stands still, looked at without noise, with noise, and with the same again."""

    def __init__(self, name="laikago", **options):
        kinematics = robot_kinematics(name)
        n_v = kinematics.num_velocities
        q = kinematics.standing_positions()
        builder = DiagramBuilder()
        source = builder.AddSystem(ConstantVectorSource(np.concatenate([q, np.zeros(n_v)])))
        self.observers = Observers(builder, kinematics, source.get_output_port(), 0.01, **options)
        self.exact = self.observers.add("exact", ObservationNoise())
        self.noisy = self.observers.add("noisy", NOISE)
        self.same = self.observers.add("same", NOISE)
        self.diagram = builder.Build()

    def states(self, seed):
        """What the exact and the noisy observer see once the noise has a seed."""
        return self.seen(self.seeded(seed))

    def seeded(self, seed):
        context = self.diagram.CreateDefaultContext()
        self.observers.reseed(context, np.random.default_rng(seed))
        return context

    def seen(self, context):
        return [
            observer.GetOutputPort("state").Eval(observer.GetMyContextFromRoot(context)).copy()
            for observer in (self.exact, self.noisy)
        ]


@pytest.fixture(scope="module")
def bench():
    return Bench()


def test_an_observer_is_shared_by_all_that_have_the_same_noise(bench):
    assert bench.same is bench.noisy
    names = [system.get_name() for system in bench.diagram.GetSystems()]
    assert names[1:] == ["exact", "noisy", "noisy_noise"]


def test_noise_follows_from_the_generator_alone(bench):
    exact, noisy = bench.states(seed=0)
    again_exact, again = bench.states(seed=0)
    np.testing.assert_array_equal(noisy, again)
    np.testing.assert_array_equal(exact, again_exact)
    assert not np.array_equal(noisy, bench.states(seed=1)[1])
    assert not np.array_equal(noisy, exact)


def test_silence_lasts_until_the_next_draw(bench):
    context = bench.seeded(0)
    bench.observers.silence(context)
    exact, noisy = bench.seen(context)
    np.testing.assert_array_equal(noisy, exact)
    simulator = Simulator(bench.diagram, context)
    simulator.AdvanceTo(0.02)
    assert not np.array_equal(bench.seen(context)[1], exact)


def test_independent_noise_adds_in_squares():
    both = combined(ObservationNoise(position=3.0), ObservationNoise(position=4.0, velocity=2.0))
    assert both == ObservationNoise(position=5.0, velocity=2.0)
    assert combined(NOISE, ObservationNoise()) == NOISE


def test_options_are_those_of_every_observer():
    bench = Bench("porter", hand="right")
    for observer in (bench.exact, bench.noisy):
        assert observer.output_names == ["hand_x", "hand_y", "hand_z"]


def test_noise_is_new_every_period_and_held_in_between(bench):
    context = bench.seeded(0)
    simulator = Simulator(bench.diagram, context)
    seen = []
    for time in (0.001, 0.009, 0.011):
        simulator.AdvanceTo(time)
        seen.append(bench.seen(context)[1])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[1], seen[2])
