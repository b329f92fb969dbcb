"""A robot on flat ground under whole-body torques, as small as a diagram can be."""

import numpy as np
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    DiscreteContactApproximation,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot import actuation_matrix, add_robot
from drake_safety.systems.whole_body_controller import WholeBodyController

TIME_STEP_S = 0.002
PERIOD_S = 0.004


class WholeBodyLoop:
    """Plant, controller and a simulator that stands in the standing posture at time zero.

    A variation with joint friction gets the desired state that arms its friction.
    """

    def __init__(self, robot, hand=None, variation=None, offset_s=0.5 * TIME_STEP_S):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, TIME_STEP_S)
        self.plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        instance = add_robot(self.plant, robot, variation, scene_graph=scene_graph, servos=False)
        friction = CoulombFriction(robot.foot_friction, robot.foot_friction)
        self.plant.RegisterCollisionGeometry(
            self.plant.world_body(), RigidTransform(), HalfSpace(), "ground", friction
        )
        self.plant.Finalize()
        self.kinematics = RobotKinematics(robot)
        B = actuation_matrix(self.plant, robot, self.kinematics.joint_names)
        options = {"actuation_matrix": B, "period_s": PERIOD_S, "offset_s": offset_s}
        self.controller = builder.AddSystem(
            WholeBodyController(self.kinematics, hand=hand, **options)
        )
        builder.Connect(
            self.plant.get_state_output_port(instance), self.controller.GetInputPort("plant_state")
        )
        builder.Connect(
            self.controller.GetOutputPort("actuation"),
            self.plant.get_actuation_input_port(instance),
        )
        if variation is not None and variation.joint_friction_nm:
            port = self.plant.get_desired_state_input_port(instance)
            rest = builder.AddSystem(ConstantVectorSource(np.zeros(port.size())))
            builder.Connect(rest.get_output_port(), port)
        self.simulator = Simulator(builder.Build())
        root = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(root)
        self.context = self.controller.GetMyMutableContextFromRoot(root)
        self.start(self.kinematics.standing_positions())

    def start(self, q, v=None):
        """Back to time zero, in the given state, which is also the one to stand in."""
        self.simulator.get_mutable_context().SetTime(0.0)
        self.plant.SetPositions(self.plant_context, q)
        self.plant.SetVelocities(
            self.plant_context, np.zeros(self.plant.num_velocities()) if v is None else v
        )
        reference = self.controller.model.reference(q)
        self.controller.set_reference(self.context, reference)
        self.lead((reference.reaching or reference.center_of_mass).position, np.zeros(3))
        self.simulator.Initialize()

    def lead(self, position, rate):
        """Where the hand (or, without one, the centre of mass) shall be, and how fast it moves."""
        self.controller.GetInputPort("desired_output").FixValue(self.context, position)
        self.controller.GetInputPort("desired_output_rate").FixValue(self.context, rate)

    @property
    def q(self):
        return self.plant.GetPositions(self.plant_context)

    @property
    def v(self):
        return self.plant.GetVelocities(self.plant_context)

    def num_failures(self):
        return self.controller.GetOutputPort("num_failures").Eval(self.context)[0]

    def follow(self, trajectory, until_s):
        """Simulates with the hand (or the centre of mass) led along a trajectory."""
        derivative = trajectory.MakeDerivative()
        time = self.simulator.get_context().get_time()
        while time < until_s - 1e-9:
            inside = min(time, trajectory.end_time())
            self.lead(trajectory.value(inside)[:, 0], derivative.value(inside)[:, 0])
            time += PERIOD_S
            self.simulator.AdvanceTo(time)
