"""The models agree with the figures their makers published.

Published figures: unitreerobotics/unitree_ros, robots/laikago_description/urdf/laikago.urdf.
Inertias are about the link's centre of mass, in the order ixx, iyy, izz, ixy, ixz, iyz.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import GeometryId, HalfSpace, QueryObject, Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
    WeldJoint,
)
from pydrake.systems.framework import DiagramBuilder

MODELS = Path(__file__).resolve().parent.parent / "models"
Triple = tuple[float, float, float]
LinkFigures = tuple[float, Triple, tuple[float, float, float, float, float, float]]

LAIKAGO = "package://drake_safety_models/laikago/laikago.urdf"

LEGS = ("FR", "FL", "RR", "RL")
LINKS = ("hip", "thigh", "calf")
STANDING = (0.0, 0.67, -1.3)
FOOT_RADIUS = 0.0265
FOOT_IN_CALF = (0.0, 0.0, -0.25)
TOTAL_MASS = 25.433

TRUNK = (
    13.733,
    (0.002284, -4.1e-05, 0.025165),
    (0.073348887, 0.250684593, 0.254469458, 0.00030338, 0.001918218, -7.5402e-05),
)
HIP = {
    "FR": (
        1.096,
        (-0.001568, 0.008134, 0.000864),
        (0.000822113, 0.000983196, 0.000864753, 4.982e-06, -3.672e-05, -2.811e-06),
    ),
    "FL": (
        1.096,
        (-0.001568, -0.008134, 0.000864),
        (0.000822113, 0.000983196, 0.000864753, -4.982e-06, -3.672e-05, 2.811e-06),
    ),
    "RR": (
        1.096,
        (0.001568, 0.008134, 0.000864),
        (0.000822113, 0.000983196, 0.000864753, -4.982e-06, 3.672e-05, -2.811e-06),
    ),
    "RL": (
        1.096,
        (0.001568, -0.008134, 0.000864),
        (0.000822113, 0.000983196, 0.000864753, 4.982e-06, 3.672e-05, 2.811e-06),
    ),
}
RIGHT_THIGH = (
    1.528,
    (-0.000482, -0.02001, -0.031996),
    (0.00991611, 0.009280083, 0.00178256, -1.0388e-05, 0.000250428, 8.511e-05),
)
LEFT_THIGH = (
    1.528,
    (-0.000482, 0.02001, -0.031996),
    (0.00991611, 0.009280083, 0.00178256, 1.0388e-05, 0.000250428, -8.511e-05),
)
THIGH = {"FR": RIGHT_THIGH, "FL": LEFT_THIGH, "RR": RIGHT_THIGH, "RL": LEFT_THIGH}
CALF = (
    0.241,
    (-0.002196, -0.000381, -0.12338),
    (0.006181961, 0.006196546, 3.4774e-05, 2.37e-07, -2.985e-06, 5.138e-06),
)
FOOT = (0.06, (0.0, 0.0, 0.0), (1.6854e-05, 1.6854e-05, 1.6854e-05, 0.0, 0.0, 0.0))

HIP_ORIGIN = {
    "FR": (0.21935, -0.0875, 0.0),
    "FL": (0.21935, 0.0875, 0.0),
    "RR": (-0.21935, -0.0875, 0.0),
    "RL": (-0.21935, 0.0875, 0.0),
}
THIGH_ORIGIN = {
    "FR": (0.0, -0.037, 0.0),
    "FL": (0.0, 0.037, 0.0),
    "RR": (0.0, -0.037, 0.0),
    "RL": (0.0, 0.037, 0.0),
}
CALF_ORIGIN = (0.0, 0.0, -0.25)

RIGHT_HIP_RANGE = (-1.0471975512, 0.872664625997)
LEFT_HIP_RANGE = (-0.872664625997, 1.0471975512)
HIP_RANGE = {
    "FR": RIGHT_HIP_RANGE,
    "FL": LEFT_HIP_RANGE,
    "RR": RIGHT_HIP_RANGE,
    "RL": LEFT_HIP_RANGE,
}
THIGH_RANGE = (-0.523598775598, 3.92699081699)
CALF_RANGE = (-2.77507351067, -0.610865238198)
EFFORT = {"hip": 20.0, "thigh": 55.0, "calf": 55.0}
SPEED = {"hip": 52.4, "thigh": 28.6, "calf": 28.6}

SAMPLED_LOWER = np.array([-0.4, 0.2, -2.0])
SAMPLED_UPPER = np.array([0.4, 1.3, -0.7])


def package_parser(plant: MultibodyPlant) -> Parser:
    """Returns a parser that knows the models' package and takes every warning for an error."""
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.package_map().Add("drake_safety_models", str(MODELS))
    return parser


class Scene:
    """Laikago in the standing pose, the trunk's frame 0.4245 m above a flat ground."""

    def __init__(self) -> None:
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        package_parser(self.plant).AddModelsFromUrl(LAIKAGO)
        self.plant.RegisterCollisionGeometry(
            self.plant.world_body(),
            RigidTransform(),
            HalfSpace(),
            "ground",
            CoulombFriction(0.6, 0.6),
        )
        self.plant.Finalize()
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)
        self.set_trunk_height(0.4245)
        for leg in LEGS:
            self.set_leg(leg, STANDING)

    def set_trunk_height(self, height: float) -> None:
        X_WT = RigidTransform([0.0, 0.0, height])
        self.plant.SetFreeBodyPose(self.context, self.plant.GetBodyByName("trunk"), X_WT)

    def set_leg(self, leg: str, angles: Sequence[float] | np.ndarray) -> None:
        for link, angle in zip(LINKS, angles, strict=True):
            self.plant.GetJointByName(f"{leg}_{link}_joint").set_angle(self.context, angle)

    def pose(self, frame: str) -> RigidTransform:
        return self.plant.GetFrameByName(frame).CalcPoseInWorld(self.context)

    def query(self) -> QueryObject:
        context = self.scene_graph.GetMyContextFromRoot(self.root)
        return self.scene_graph.get_query_output_port().Eval(context)

    def geometry_name(self, geometry: GeometryId) -> str:
        """The geometry's body and name, as in `FR_calf/foot`."""
        inspector = self.scene_graph.model_inspector()
        body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        return f"{body.name()}/{inspector.GetName(geometry).split('::')[-1]}"

    def touching(self) -> set[tuple[str, ...]]:
        """The sorted names of every pair of geometries that penetrate each other."""
        return {
            tuple(sorted((self.geometry_name(pair.id_A), self.geometry_name(pair.id_B))))
            for pair in self.query().ComputePointPairPenetration()
        }


@pytest.fixture
def scene() -> Scene:
    return Scene()


def spatial_inertia(figures: LinkFigures) -> SpatialInertia:
    mass, p_BBcm_B, moments = figures
    return SpatialInertia.MakeFromCentralInertia(mass, p_BBcm_B, RotationalInertia(*moments))


def published_plant() -> MultibodyPlant:
    """The published links one by one, every foot a body of its own, welded to its calf."""
    plant = MultibodyPlant(0.001)

    def add_link(name: str, figures: LinkFigures) -> RigidBody:
        return plant.AddRigidBody(name, spatial_inertia(figures))

    def add_joint(
        name: str, parent: RigidBody, p_PJ: Triple, child: RigidBody, axis: Triple
    ) -> None:
        origin = FixedOffsetFrame(f"{name}_origin", parent.body_frame(), RigidTransform(p_PJ))
        plant.AddJoint(
            RevoluteJoint(name, plant.AddFrame(origin), child.body_frame(), np.array(axis))
        )

    trunk = add_link("trunk", TRUNK)
    for leg in LEGS:
        hip = add_link(f"{leg}_hip", HIP[leg])
        thigh = add_link(f"{leg}_thigh", THIGH[leg])
        calf = add_link(f"{leg}_calf", CALF)
        foot = add_link(f"{leg}_foot", FOOT)
        add_joint(f"{leg}_hip_joint", trunk, HIP_ORIGIN[leg], hip, (1.0, 0.0, 0.0))
        add_joint(f"{leg}_thigh_joint", hip, THIGH_ORIGIN[leg], thigh, (0.0, 1.0, 0.0))
        add_joint(f"{leg}_calf_joint", thigh, CALF_ORIGIN, calf, (0.0, 1.0, 0.0))
        weld = WeldJoint(
            f"{leg}_foot_fixed",
            calf.body_frame(),
            foot.body_frame(),
            RigidTransform(FOOT_IN_CALF),
        )
        plant.AddJoint(weld)
    plant.Finalize()
    return plant


def velocity_order(plant: MultibodyPlant) -> list[int]:
    """Indices into v: the trunk's six, then the joints leg by leg."""
    start = plant.GetBodyByName("trunk").floating_velocities_start_in_v()
    joints = [plant.GetJointByName(f"{leg}_{link}_joint") for leg in LEGS for link in LINKS]
    return [*range(start, start + 6), *(joint.velocity_start() for joint in joints)]


def test_laikago_weighs_what_is_published(scene: Scene) -> None:
    assert scene.plant.CalcTotalMass(scene.context) == pytest.approx(TOTAL_MASS, abs=1e-9)


def test_each_body_has_its_published_mass_and_the_calf_carries_the_foot(scene: Scene) -> None:
    expected = {"trunk": 13.733}
    for leg in LEGS:
        expected |= {f"{leg}_hip": 1.096, f"{leg}_thigh": 1.528, f"{leg}_calf": 0.241 + 0.06}
    laikago = scene.plant.GetModelInstanceByName("laikago")
    bodies = [scene.plant.get_body(index) for index in scene.plant.GetBodyIndices(laikago)]
    masses = {body.name(): body.default_mass() for body in bodies}
    assert masses == pytest.approx(expected, abs=1e-12)


def test_trunk_hips_and_thighs_have_their_published_inertias(scene: Scene) -> None:
    published = {"trunk": TRUNK}
    for leg in LEGS:
        published |= {f"{leg}_hip": HIP[leg], f"{leg}_thigh": THIGH[leg]}
    for name, figures in published.items():
        M_BBo_B = scene.plant.GetBodyByName(name).default_spatial_inertia().CopyToFullMatrix6()
        expected = spatial_inertia(figures).CopyToFullMatrix6()
        np.testing.assert_allclose(M_BBo_B, expected, rtol=0.0, atol=1e-14, err_msg=name)


@pytest.mark.parametrize("seed", range(5))
def test_mass_matrix_equals_that_of_the_published_links_with_welded_feet(
    scene: Scene, seed: int
) -> None:
    published = published_plant()
    context = published.CreateDefaultContext()
    rng = np.random.default_rng(seed)
    X_WT = RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, size=3)), rng.normal(size=3))
    scene.plant.SetFreeBodyPose(scene.context, scene.plant.GetBodyByName("trunk"), X_WT)
    published.SetFreeBodyPose(context, published.GetBodyByName("trunk"), X_WT)
    for leg in LEGS:
        angles = rng.uniform(SAMPLED_LOWER, SAMPLED_UPPER)
        scene.set_leg(leg, angles)
        for link, angle in zip(LINKS, angles, strict=True):
            published.GetJointByName(f"{leg}_{link}_joint").set_angle(context, angle)
    ours = velocity_order(scene.plant)
    theirs = velocity_order(published)
    np.testing.assert_allclose(
        scene.plant.CalcMassMatrix(scene.context)[np.ix_(ours, ours)],
        published.CalcMassMatrix(context)[np.ix_(theirs, theirs)],
        rtol=0.0,
        atol=1e-10,
    )


@pytest.mark.parametrize("leg", LEGS)
def test_joints_stop_move_and_push_as_published(scene: Scene, leg: str) -> None:
    ranges = {"hip": HIP_RANGE[leg], "thigh": THIGH_RANGE, "calf": CALF_RANGE}
    for link in LINKS:
        joint = scene.plant.GetJointByName(f"{leg}_{link}_joint")
        assert joint.position_lower_limit() == ranges[link][0]
        assert joint.position_upper_limit() == ranges[link][1]
        assert joint.velocity_lower_limit() == -SPEED[link]
        assert joint.velocity_upper_limit() == SPEED[link]
        assert joint.default_damping() == 0.0
        actuator = scene.plant.GetJointActuatorByName(f"{leg}_{link}_joint")
        assert actuator.joint().name() == joint.name()
        assert actuator.effort_limit() == EFFORT[link]


def test_actuators_are_the_twelve_joints_leg_by_leg(scene: Scene) -> None:
    names = [
        scene.plant.get_joint_actuator(index).name()
        for index in scene.plant.GetJointActuatorIndices()
    ]
    assert names == [f"{leg}_{link}_joint" for leg in LEGS for link in LINKS]


def test_standing_pose_rests_on_its_feet_at_the_published_height(scene: Scene) -> None:
    scene.set_trunk_height(0.0)
    soles = [scene.pose(f"{leg}_foot").translation()[2] - FOOT_RADIUS for leg in LEGS]
    assert soles == pytest.approx([-0.4245] * 4, abs=0.001)
    by_hand = 0.25 * np.cos(0.67) + 0.25 * np.cos(0.67 - 1.3) + FOOT_RADIUS
    assert soles == pytest.approx([-by_hand] * 4, abs=1e-12)


def test_foot_frames_are_the_centres_of_the_foot_spheres(scene: Scene) -> None:
    inspector = scene.scene_graph.model_inspector()
    for leg in LEGS:
        calf = scene.plant.GetBodyByName(f"{leg}_calf")
        (foot,) = [
            geometry
            for geometry in scene.plant.GetCollisionGeometriesForBody(calf)
            if scene.geometry_name(geometry) == f"{leg}_calf/foot"
        ]
        assert inspector.GetShape(foot).radius() == FOOT_RADIUS
        p_BF = inspector.GetPoseInFrame(foot).translation()
        np.testing.assert_allclose(p_BF, FOOT_IN_CALF, rtol=0.0, atol=1e-12)
        X_BF = scene.plant.GetFrameByName(f"{leg}_foot").GetFixedPoseInBodyFrame()
        assert X_BF.IsNearlyEqualTo(RigidTransform(FOOT_IN_CALF), 1e-12)


def test_left_legs_mirror_right_legs(scene: Scene) -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    rng = np.random.default_rng(0)
    for right, left in (("FR", "FL"), ("RR", "RL")):
        for _ in range(10):
            hip, thigh, calf = rng.uniform(SAMPLED_LOWER, SAMPLED_UPPER)
            scene.set_leg(right, (hip, thigh, calf))
            scene.set_leg(left, (-hip, thigh, calf))
            for frame in (*LINKS, "foot"):
                X_WR = scene.pose(f"{right}_{frame}")
                X_WL = scene.pose(f"{left}_{frame}")
                p_expected = mirror @ X_WR.translation()
                R_expected = mirror @ X_WR.rotation().matrix() @ mirror
                np.testing.assert_allclose(X_WL.translation(), p_expected, rtol=0.0, atol=1e-12)
                np.testing.assert_allclose(
                    X_WL.rotation().matrix(), R_expected, rtol=0.0, atol=1e-12
                )


def test_only_the_four_feet_touch_the_ground_when_standing(scene: Scene) -> None:
    scene.set_trunk_height(0.423)
    assert scene.touching() == {(f"{leg}_calf/foot", "world/ground") for leg in LEGS}


def test_nothing_touches_in_the_standing_pose(scene: Scene) -> None:
    scene.set_trunk_height(1.0)
    assert scene.touching() == set()


def test_a_leg_never_touches_itself_or_the_trunk_where_legs_are_sampled(scene: Scene) -> None:
    scene.set_trunk_height(1.0)
    hips = np.linspace(SAMPLED_LOWER[0], SAMPLED_UPPER[0], 5)
    thighs = np.linspace(SAMPLED_LOWER[1], SAMPLED_UPPER[1], 6)
    calves = np.linspace(SAMPLED_LOWER[2], SAMPLED_UPPER[2], 6)
    for leg in LEGS:
        for angles in itertools.product(hips, thighs, calves):
            scene.set_leg(leg, angles)
            own = {
                pair
                for pair in scene.touching()
                if all(name.startswith((leg, "trunk")) for name in pair)
            }
            assert own == set(), angles
        scene.set_leg(leg, STANDING)


def test_only_a_leg_with_itself_and_the_trunk_with_hips_and_thighs_are_filtered(
    scene: Scene,
) -> None:
    candidates = {
        frozenset(scene.geometry_name(geometry).split("/")[0] for geometry in pair)
        for pair in scene.scene_graph.model_inspector().GetCollisionCandidates()
    }
    links = [f"{leg}_{link}" for leg in LEGS for link in LINKS]
    expected = {
        frozenset(pair) for pair in itertools.combinations(links, 2) if pair[0][:2] != pair[1][:2]
    }
    expected |= {frozenset(("trunk", f"{leg}_calf")) for leg in LEGS}
    expected |= {frozenset(("world", link)) for link in ("trunk", *links)}
    assert candidates == expected


def test_the_calf_ends_short_of_its_foot(scene: Scene) -> None:
    inspector = scene.scene_graph.model_inspector()
    shapes = {
        scene.geometry_name(geometry): geometry
        for geometry in scene.plant.GetCollisionGeometriesForBody(
            scene.plant.GetBodyByName("FR_calf")
        )
    }
    shin, foot = shapes["FR_calf/shin"], shapes["FR_calf/foot"]
    capsule = inspector.GetShape(shin)
    shin_end = (
        inspector.GetPoseInFrame(shin).translation()[2] - capsule.length() / 2 - capsule.radius()
    )
    foot_top = inspector.GetPoseInFrame(foot).translation()[2] + FOOT_RADIUS
    assert shin_end > foot_top
    assert capsule.radius() < FOOT_RADIUS


@pytest.mark.parametrize(("right", "left"), [("FR", "FL"), ("RR", "RL")])
def test_feet_brought_together_collide(scene: Scene, right: str, left: str) -> None:
    scene.set_trunk_height(1.0)
    leg_length = 0.25 * np.cos(0.67) + 0.25 * np.cos(0.67 - 1.3)
    # The foot is under the trunk's centre line: 0.0875 + 0.037 cos(hip) = leg_length sin(hip).
    hip = np.arcsin(0.0875 / np.hypot(leg_length, 0.037)) + np.arctan2(0.037, leg_length)
    scene.set_leg(right, (hip, *STANDING[1:]))
    scene.set_leg(left, (-hip, *STANDING[1:]))
    assert scene.pose(f"{right}_foot").translation()[1] == pytest.approx(0.0, abs=1e-12)
    assert (f"{left}_calf/foot", f"{right}_calf/foot") in scene.touching()


def test_a_front_foot_reaching_back_collides_with_the_hind_leg(scene: Scene) -> None:
    scene.set_trunk_height(1.0)
    scene.set_leg("FR", (0.0, 1.3, -0.7))
    scene.set_leg("RR", (0.0, 0.2, -2.0))
    assert any(
        first.startswith("FR") and second.startswith("RR") for first, second in scene.touching()
    )


def test_feet_grip_and_the_rest_slides_as_published(scene: Scene) -> None:
    inspector = scene.scene_graph.model_inspector()
    laikago = scene.plant.GetModelInstanceByName("laikago")
    for index in scene.plant.GetBodyIndices(laikago):
        body = scene.plant.get_body(index)
        for geometry in scene.plant.GetCollisionGeometriesForBody(body):
            friction = inspector.GetProximityProperties(geometry).GetProperty(
                "material", "coulomb_friction"
            )
            expected = 0.6 if scene.geometry_name(geometry).endswith("/foot") else 0.2
            assert friction.static_friction() == expected
            assert friction.dynamic_friction() == expected


def test_every_signed_distance_within_the_robot_can_be_computed(scene: Scene) -> None:
    scene.set_trunk_height(1.0)
    query = scene.query()
    for id_A, id_B in scene.scene_graph.model_inspector().GetCollisionCandidates():
        names = {scene.geometry_name(id_A), scene.geometry_name(id_B)}
        if "world/ground" not in names:
            assert query.ComputeSignedDistancePairClosestPoints(id_A, id_B).distance > 0.0, names


def test_the_ball_is_a_solid_sphere_of_two_kilograms() -> None:
    plant = MultibodyPlant(0.001)
    package_parser(plant).AddModelsFromUrl("package://drake_safety_models/scenes/ball.sdf")
    plant.Finalize()
    ball = plant.GetBodyByName("ball").default_spatial_inertia()
    assert ball.get_mass() == 2.0
    np.testing.assert_array_equal(ball.get_com(), np.zeros(3))
    moment = 2.0 / 5.0 * 2.0 * 0.08**2
    np.testing.assert_allclose(
        ball.CalcRotationalInertia().CopyToFullMatrix3(), moment * np.eye(3), rtol=0.0, atol=1e-15
    )


def test_the_ground_is_only_to_be_seen() -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    package_parser(plant).AddModelsFromUrl("package://drake_safety_models/scenes/ground.urdf")
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    assert plant.num_velocities() == 0
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 0
    assert inspector.NumGeometriesWithRole(Role.kIllustration) > 0
