"""Balls fly as free bodies and touch the robot when and where they were thrown to."""

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_safety.plants.balls import Ball, Throw, add_ball
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from legged_robots import robot_model

TIME_STEP_S = 0.0005


class Bench:
    """A robot that floats in its posture while a ball is thrown at it."""

    def __init__(self, name="laikago", height=0.5):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, TIME_STEP_S)
        robot = robot_model(name)
        self.robot = add_robot(self.plant, robot, scene_graph=scene_graph)
        self.instance = add_ball(self.plant)
        add_ground(self.plant, 1.0)
        # The robot hangs: without gravity it stays where it is until the ball comes.
        self.plant.set_gravity_enabled(self.robot, False)
        self.plant.Finalize()
        self.ball = Ball(self.plant, scene_graph, self.instance, robot.base)
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        base = self.plant.GetBodyByName(robot.base)
        self.plant.SetFreeBodyPose(self.context, base, RigidTransform([0.3, -0.2, height]))
        port = self.plant.get_desired_state_input_port(self.robot)
        indices = self.plant.GetJointActuatorIndices(self.robot)
        joints = [self.plant.get_joint_actuator(i).joint() for i in indices]
        q = [joint.GetOnePosition(self.context) for joint in joints]
        port.FixValue(self.context, np.concatenate([q, np.zeros(len(q))]))

    def velocity(self):
        return self.plant.GetVelocities(self.context, self.instance)[3:]

    def position(self):
        return self.plant.GetPositions(self.context, self.instance)[4:]

    def robot_momentum(self):
        momentum = self.plant.CalcSpatialMomentumInWorldAboutPoint
        return momentum(self.context, [self.robot], np.zeros(3)).translational()


@pytest.mark.parametrize("direction", [math.pi / 2, -math.pi / 3])
@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_the_ball_touches_at_its_time_and_the_robot_gains_its_momentum(name, direction):
    bench = Bench(name)
    throw = Throw(mass_kg=3.0, speed_m_s=5.0, direction_rad=direction)
    bench.ball.throw(bench.context, throw, 0.1)
    assert bench.plant.CalcTotalMass(bench.context, [bench.instance]) == pytest.approx(3.0)
    bench.simulator.AdvanceTo(0.1 - 3 * TIME_STEP_S)
    assert np.linalg.norm(bench.robot_momentum()) < 1e-6
    # It arrives horizontally at its speed.
    along = np.array([math.cos(direction), math.sin(direction), 0.0])
    np.testing.assert_allclose(bench.velocity(), 5.0 * along, atol=0.03)
    bench.simulator.AdvanceTo(0.13)
    assert bench.robot_momentum() @ along > 0.3 * 15
    # Horizontally nothing else acts: the robot hangs in the air.
    after = throw.mass_kg * bench.velocity() + bench.robot_momentum()
    np.testing.assert_allclose(after[:2], 15.0 * along[:2], atol=0.02 * 15)


def test_height_and_offset_move_the_line_of_flight_and_without_a_flight_it_touches_now():
    bench = Bench()
    positions = []
    for shift in ({}, {"height_m": 0.02, "offset_m": 0.03}):
        bench.ball.throw(bench.context, Throw(direction_rad=0.0, **shift), 0.0)
        positions.append(bench.position())
    np.testing.assert_allclose((positions[1] - positions[0])[1:], [0.03, 0.02], atol=1e-12)
    bench.simulator.AdvanceTo(5 * TIME_STEP_S)
    assert bench.robot_momentum()[0] > 1.0


def test_a_parked_ball_lies_still_on_the_ground_far_away():
    bench = Bench()
    bench.ball.throw(bench.context, Throw(), 0.1)
    bench.ball.park(bench.context)
    before = bench.position()
    assert np.linalg.norm(before[:2]) > 10
    assert before[2] == pytest.approx(bench.ball.radius_m)
    bench.simulator.AdvanceTo(0.1)
    np.testing.assert_allclose(bench.position(), before, atol=1e-3)


def test_an_impossible_flight_is_refused_and_the_ball_parked():
    bench = Bench(height=0.45)
    with pytest.raises(ValueError, match=r"ball of Throw\(.*height_m=3.0.* misses"):
        bench.ball.throw(bench.context, Throw(height_m=3.0), 0.1)
    assert np.linalg.norm(bench.position()[:2]) > 10
    # It would begin underground.
    with pytest.raises(ValueError, match=r"cannot fly for 0\.5 s"):
        bench.ball.throw(bench.context, Throw(), 0.5)
