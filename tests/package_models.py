"""The package's robots as plants on flat ground, for the tests of models."""

import numpy as np
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.models import load_robot
from drake_safety.robots.model_files import add_to_package_map


class Scene:
    """A robot of the package in its standing posture on a flat ground."""

    def __init__(self, name):
        self.robot = load_robot(name)
        self.kinematics = RobotKinematics(self.robot)
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        parser = Parser(self.plant)
        parser.SetStrictParsing()  # Takes every warning for an error.
        add_to_package_map(parser.package_map())
        (instance,) = parser.AddModelsFromUrl(self.robot.urdf)
        ground = RigidTransform(), HalfSpace(), "ground", CoulombFriction(0.8, 0.8)
        self.plant.RegisterCollisionGeometry(self.plant.world_body(), *ground)
        self.plant.Finalize()
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)
        bodies = map(self.plant.get_body, self.plant.GetBodyIndices(instance))
        self.bodies = {body.name(): body for body in bodies}

    def stand(self, sunk_m=0.0):
        height = self.kinematics.standing_height - sunk_m
        base = self.bodies[self.robot.base]
        self.plant.SetFreeBodyPose(self.context, base, RigidTransform([0.0, 0.0, height]))
        for name, q in zip(self.kinematics.joint_names, self.kinematics.posture, strict=True):
            self.plant.GetJointByName(name).set_angle(self.context, q)

    def query(self):
        context = self.scene_graph.GetMyContextFromRoot(self.root)
        return self.scene_graph.get_query_output_port().Eval(context)

    def geometry_name(self, geometry):
        """The geometry's body and name, as in `FR_calf/foot`."""
        inspector = self.scene_graph.model_inspector()
        body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        return f"{body.name()}/{inspector.GetName(geometry).split('::')[-1]}"

    def collision_geometries(self):
        """The robot's collision geometries by name."""
        shapes = map(self.plant.GetCollisionGeometriesForBody, self.bodies.values())
        return {self.geometry_name(one): one for of_body in shapes for one in of_body}

    def contact_spheres(self):
        """Those of them that stand at a contact point of robot.yaml."""
        inspector = self.scene_graph.model_inspector()
        points = [(foot.body, p) for foot in self.robot.feet.values() for p in foot.contact_points]

        def is_contact(name, geometry):
            centre = inspector.GetPoseInFrame(geometry).translation()
            near = (body for body, p in points if np.allclose(centre, p, rtol=0, atol=1e-9))
            return name.split("/")[0] in near

        return {n: g for n, g in self.collision_geometries().items() if is_contact(n, g)}

    def touching(self):
        """The sorted names of every pair of geometries that penetrate each other."""
        pairs = self.query().ComputePointPairPenetration()
        names = (map(self.geometry_name, (pair.id_A, pair.id_B)) for pair in pairs)
        return {tuple(sorted(pair)) for pair in names}
