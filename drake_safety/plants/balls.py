"""Balls, as free bodies, that are thrown at a robot."""

import math

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, SpatialInertia
from pydrake.systems.framework import Context

from drake_safety.files.schema import NotNegative, Positive, schema
from drake_safety.plants.obstacles import collision_geometries
from drake_safety.robots.model_files import package_parser
from drake_safety.robots.robot_size import GRAVITY_M_S2

_GRAVITY_W = np.array([0.0, 0.0, -GRAVITY_M_S2])
_TOUCH_M = 1e-4  # Distance in contact.
_BEFORE_M, _BEYOND_M = 2.0, 1.0  # Ends of the line of flight, relative to its aim.
_PARKED = np.array([50.0, 50.0, 0.0])  # Far from the robot [m].


@schema(kw_only=True)
class Throw:
    """A thrown ball."""

    time_s: NotNegative = 0.0  # Time of impact [s].
    mass_kg: Positive = 2.0
    speed_m_s: Positive = 6.0  # Horizontal speed at impact [m/s].
    direction_rad: float = math.pi / 2  # Angle of flight from the world's x axis [rad].
    offset_m: float = 0.0  # Lateral offset of the line of flight from the base's origin [m].
    height_m: float = 0.0  # Height of the line of flight over the base's origin [m].


def add_ball(plant: MultibodyPlant) -> ModelInstanceIndex:
    """Adds a ball to a plant that is not finalised."""
    return package_parser(plant).AddModels(url="package://drake_safety_models/scenes/ball.sdf")[0]


class Ball:
    """A ball in a finalised plant, thrown at a body of the robot."""

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        instance: ModelInstanceIndex,
        body: str,
    ):
        self._plant, self._hit_body = plant, plant.GetBodyByName(body)
        self._body = plant.get_body(plant.GetBodyIndices(instance)[0])
        (self._geometry,) = plant.GetCollisionGeometriesForBody(self._body)
        self.radius_m = scene_graph.model_inspector().GetShape(self._geometry).radius()
        self._robot_geometries = collision_geometries(plant, [self._hit_body.model_instance()])

    def park(self, context: Context) -> None:
        """Puts the ball at rest on the ground, far away, in the plant's Context."""
        p = _PARKED + [0.0, 0.0, self.radius_m]
        self._plant.SetFreeBodyPose(context, self._body, RigidTransform(p))
        self._plant.SetFreeBodySpatialVelocity(context, self._body, SpatialVelocity.Zero())

    def mass(self, context: Context) -> float:
        """Mass of the ball in the plant's Context [kg]."""
        return float(self._body.get_mass(context))

    def throw(self, context: Context, throw: Throw, lead_s: float) -> None:
        """Starts a flight that touches the robot's present pose horizontally after ``lead_s``."""
        inertia = SpatialInertia.SolidSphereWithMass(throw.mass_kg, self.radius_m)
        self._body.SetSpatialInertiaInBodyFrame(context, inertia)
        direction = np.array([math.cos(throw.direction_rad), math.sin(throw.direction_rad), 0.0])
        sideways = np.array([-direction[1], direction[0], 0.0])
        aim = self._plant.EvalBodyPoseInWorld(context, self._hit_body).translation()
        aim = aim + throw.offset_m * sideways + [0.0, 0.0, throw.height_m]
        # Sphere tracing: the signed distance is a step that cannot overshoot.
        p, distance = aim - _BEFORE_M * direction, math.inf
        while not distance < _TOUCH_M and (p - aim) @ direction <= _BEYOND_M:
            self._plant.SetFreeBodyPose(context, self._body, RigidTransform(p))
            query = self._plant.get_geometry_query_input_port().Eval(context)
            distance = min(
                query.ComputeSignedDistancePairClosestPoints(self._geometry, other).distance
                for other in self._robot_geometries
            )
            if not distance < _TOUCH_M:
                p = p + distance * direction
        velocity = throw.speed_m_s * direction - _GRAVITY_W * lead_s
        start = p - velocity * lead_s - 0.5 * _GRAVITY_W * lead_s**2
        if not (is_hit := distance < _TOUCH_M) or start[2] < self.radius_m:
            self.park(context)
            fault = f"cannot fly for {lead_s} s to {p[2]:.3f} m" if is_hit else "misses the robot"
            raise ValueError(f"throw: the ball of {throw} {fault}")
        self._plant.SetFreeBodyPose(context, self._body, RigidTransform(start))
        V_WB = SpatialVelocity(np.zeros(3), velocity)
        self._plant.SetFreeBodySpatialVelocity(context, self._body, V_WB)
