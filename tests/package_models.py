"""The package's robots as plants on flat ground, for the tests of models."""

from pathlib import Path

import numpy as np
from pydrake.geometry import GeometryId, HalfSpace, QueryObject
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.models import load_robot

MODELS = Path(__file__).resolve().parent.parent / "models"


def package_parser(plant: MultibodyPlant) -> Parser:
    """Returns a parser that knows the models' package and takes every warning for an error."""
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.package_map().Add("drake_safety_models", str(MODELS))
    return parser


class Scene:
    """A robot of the package in its standing posture on a flat ground.

    Args:
        name: The robot.
        *scenes: Files of ``models/scenes``; what they leave free is welded to the world's origin.
    """

    def __init__(self, name: str, *scenes: str, time_step: float = 0.001) -> None:
        self.robot = load_robot(name)
        self.kinematics = RobotKinematics(self.robot)
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, time_step)
        parser = package_parser(self.plant)
        (self.instance,) = parser.AddModelsFromUrl(self.robot.urdf)
        for scene in scenes:
            (instance,) = parser.AddModelsFromUrl(f"package://drake_safety_models/scenes/{scene}")
            body = self.plant.get_body(self.plant.GetBodyIndices(instance)[0])
            self.plant.WeldFrames(self.plant.world_frame(), body.body_frame())
        world, friction = self.plant.world_body(), CoulombFriction(0.8, 0.8)
        X_WG, half_space = RigidTransform(), HalfSpace()
        self.plant.RegisterCollisionGeometry(world, X_WG, half_space, "ground", friction)
        self.plant.Finalize()
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)
        self.base = self.plant.GetBodyByName(self.robot.base, self.instance)
        self.bodies = {
            self.plant.get_body(index).name(): self.plant.get_body(index)
            for index in self.plant.GetBodyIndices(self.instance)
        }
        self.stand()

    def stand(self, sunk_m: float = 0.0) -> None:
        height = self.kinematics.standing_height - sunk_m
        self.plant.SetFreeBodyPose(self.context, self.base, RigidTransform([0.0, 0.0, height]))
        for name, q in zip(self.kinematics.joint_names, self.kinematics.posture, strict=True):
            self.plant.GetJointByName(name, self.instance).set_angle(self.context, q)

    def query(self) -> QueryObject:
        context = self.scene_graph.GetMyContextFromRoot(self.root)
        return self.scene_graph.get_query_output_port().Eval(context)

    def geometry_name(self, geometry: GeometryId) -> str:
        """The geometry's body and name, as in `FR_calf/foot`."""
        inspector = self.scene_graph.model_inspector()
        body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        return f"{body.name()}/{inspector.GetName(geometry).split('::')[-1]}"

    def collision_geometries(self) -> dict[str, GeometryId]:
        """The robot's collision geometries by name, as in `FR_calf/foot`."""
        return {
            self.geometry_name(geometry): geometry
            for body in self.bodies.values()
            for geometry in self.plant.GetCollisionGeometriesForBody(body)
        }

    def contact_spheres(self) -> dict[str, GeometryId]:
        """Those of them that stand at a contact point of robot.yaml."""
        inspector = self.scene_graph.model_inspector()
        points = [(foot.body, p) for foot in self.robot.feet.values() for p in foot.contact_points]

        def is_contact(name: str, geometry: GeometryId) -> bool:
            centre = inspector.GetPoseInFrame(geometry).translation()
            near = (body for body, p in points if np.allclose(centre, p, rtol=0, atol=1e-9))
            return name.split("/")[0] in near

        return {n: g for n, g in self.collision_geometries().items() if is_contact(n, g)}

    def touching(self) -> set[tuple[str, ...]]:
        """The sorted names of every pair of geometries that penetrate each other."""
        return {
            tuple(sorted((self.geometry_name(pair.id_A), self.geometry_name(pair.id_B))))
            for pair in self.query().ComputePointPairPenetration()
        }
