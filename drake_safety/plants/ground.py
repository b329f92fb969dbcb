"""The ground that a robot stands on."""

from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant

from drake_safety.robots.robot import add_to_package_map


def add_ground(plant: MultibodyPlant, friction: float) -> None:
    """Adds level ground at z = 0 to a plant that is not finalised.

    Args:
        plant: The plant.
        friction: Coulomb's coefficient, static and dynamic.
    """
    parser = Parser(plant)
    add_to_package_map(parser.package_map())
    # What is seen; what is stood on is the half space, which has no edge.
    parser.AddModels(url="package://drake_safety_models/scenes/ground.urdf")
    plant.RegisterCollisionGeometry(
        plant.world_body(),
        RigidTransform(),
        HalfSpace(),
        "ground",
        CoulombFriction(friction, friction),
    )
