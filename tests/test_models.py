"""The robots' models agree with the figures their makers published, and touch what they should.

The figures stand in ``laikago_figures.py`` and ``atlas_figures.py``, the mechanics that they are
put into in ``published_robots.py``: plain numpy over every published link, fixed ones by
themselves.
"""

import itertools
import re

import numpy as np
import pytest
from pydrake.geometry import Role, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.models import load_robot, robot_names
from package_models import PUBLISHED, Scene

ROBOTS = sorted(PUBLISHED)


@pytest.fixture(scope="module", params=ROBOTS)
def scene(request) -> Scene:
    return Scene(request.param)


@pytest.fixture(autouse=True)
def standing(scene):
    scene.stand()


def test_every_robot_described_in_the_package_is_compared_with_its_published_figures():
    own = "package://drake_safety_models/"
    assert [name for name in robot_names() if load_robot(name).urdf.startswith(own)] == ROBOTS


def test_each_body_has_the_inertia_of_all_links_that_are_fixed_to_it(scene):
    published = scene.published
    assert sorted(scene.bodies) == sorted(published.bodies)
    assert scene.plant.num_velocities() == 6 + len(published.movable)
    mass = scene.plant.CalcTotalMass(scene.context, [scene.instance])
    assert mass == pytest.approx(published.total_mass, abs=1e-9)
    for body_name, body in scene.bodies.items():
        M_BBo_B = body.default_spatial_inertia()
        mass, moment, inertia = published.body_inertia(body_name)
        assert M_BBo_B.get_mass() == pytest.approx(mass, rel=1e-13), body_name
        exact = {"rtol": 0, "atol": 1e-12, "err_msg": body_name}
        np.testing.assert_allclose(M_BBo_B.get_mass() * M_BBo_B.get_com(), moment, **exact)
        rotational = M_BBo_B.CalcRotationalInertia().CopyToFullMatrix3()
        np.testing.assert_allclose(rotational, inertia, **exact)


def test_every_frame_is_where_the_published_joints_carry_it(scene):
    published, rng = scene.published, np.random.default_rng(100)
    R_WB, p_WB = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    positions = {joint: rng.uniform(*published.joints[joint].limits) for joint in published.movable}
    scene.set_base(RigidTransform(RotationMatrix(R_WB), p_WB))
    scene.set_joints(positions)
    compared = set()
    for link, (R_WL, p_WL) in published.poses((R_WB, p_WB), positions).items():
        if scene.plant.HasFrameNamed(link, scene.instance):
            pose, expected = scene.pose(link).GetAsMatrix34(), np.column_stack([R_WL, p_WL])
            np.testing.assert_allclose(pose, expected, rtol=0, atol=1e-12, err_msg=link)
            compared.add(link)
    assert set(scene.bodies) <= compared


def test_joints_stop_move_push_and_damp_as_published(scene):
    for joint_name in scene.published.movable:
        figures = scene.published.joints[joint_name]
        joint = scene.plant.GetJointByName(joint_name)
        actuator = scene.plant.GetJointActuatorByName(joint_name)
        stops = (joint.position_lower_limit(), joint.position_upper_limit())
        speeds = (joint.velocity_lower_limit(), joint.velocity_upper_limit())
        assert (stops, speeds) == (figures.limits, (-figures.speed, figures.speed)), joint_name
        published = (figures.damping, figures.effort)
        assert (joint.default_damping(), actuator.effort_limit()) == published, joint_name


def test_robot_yaml_stands_in_the_published_posture_at_the_published_height(scene):
    published = scene.published
    kinematics = RobotKinematics(scene.robot)
    expected = [published.posture.get(joint, 0.0) for joint in kinematics.joint_names]
    np.testing.assert_allclose(kinematics.posture, expected, rtol=0, atol=1e-15)
    error = kinematics.standing_height - published.standing_height
    assert abs(error) <= published.standing_height_tolerance
    q = kinematics.standing_positions()
    p_WC, p_WCm = kinematics.contact_positions(q), kinematics.center_of_mass(q)[:2]
    np.testing.assert_allclose(p_WC[:, 2], kinematics.foot_radii, rtol=0, atol=1e-12)
    # The contact points are the corners of a rectangle along x and y.
    assert (p_WC[:, :2].min(axis=0) < p_WCm).all() and (p_WCm < p_WC[:, :2].max(axis=0)).all()
    torques = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, dtype=bool))
    for joint_name, torque in zip(kinematics.joint_names, torques, strict=True):
        assert abs(torque) < published.joints[joint_name].effort, joint_name


def partners_of(published, names) -> dict[str, str]:
    """Each name's partner on the other side; what stands in the middle is its own."""
    pattern, template = published.partner
    partners = {}
    for one in names:
        if match := re.fullmatch(pattern, one):
            other = match.expand(template)
            partners |= {one: other, other: one}
    return {one: partners.get(one, one) for one in names}


def test_the_two_sides_are_mirrored(scene):
    published, plant = scene.published, scene.plant
    partners = partners_of(published, published.movable)
    if scene.robot.mirror:
        assert scene.robot.mirror_partners(published.movable) == partners
    signs = {}
    zero = dict.fromkeys(published.movable, 0.0)
    poses = published.poses((np.eye(3), np.zeros(3)), zero)
    axes = {j: poses[(joint := published.joints[j]).child][0] @ joint.axis for j in partners}
    mirror = np.diag([1.0, -1.0, 1.0])
    for one, other in partners.items():
        # A rotation is mirrored into one about the axis' mirror image, the other way.
        signs[one] = np.sign(-float(axes[other] @ mirror @ axes[one]))
        joint, mirrored = plant.GetJointByName(one), plant.GetJointByName(other)
        stops = (joint.position_lower_limit(), joint.position_upper_limit())
        ends = sorted(signs[one] * end for end in stops)
        assert ends == [mirrored.position_lower_limit(), mirrored.position_upper_limit()], one
    rng = np.random.default_rng(0)
    positions = {joint: rng.uniform(*published.joints[joint].limits) for joint in partners}
    scene.set_base(RigidTransform())
    scene.set_joints(positions)
    origins = {body: scene.pose(body).translation() for body in published.bodies}
    scene.set_joints({partners[j]: signs[j] * angle for j, angle in positions.items()})
    for one, other in partners_of(published, published.bodies).items():
        origin = scene.pose(other).translation()
        np.testing.assert_allclose(origin, mirror @ origins[one], rtol=0, atol=1e-9)


def test_the_contact_points_of_robot_yaml_are_published_grip_and_alone_touch_the_ground(scene):
    published, inspector = scene.published, scene.scene_graph.model_inspector()
    gripping = scene.contact_spheres()
    assert {foot.body for foot in scene.robot.feet.values()} == set(published.contact_centres)
    for foot in scene.robot.feet.values():
        expected = published.contact_centres[foot.body]
        np.testing.assert_allclose(foot.contact_points, expected, rtol=0, atol=1e-12)
        assert foot.radius_m == published.contact_radius
    assert len(gripping) == sum(map(len, published.contact_centres.values()))
    for name, geometry in scene.collision_geometries().items():
        friction = inspector.GetProximityProperties(geometry).GetProperty(
            "material", "coulomb_friction"
        )
        expected = published.foot_friction if name in gripping else published.other_friction
        assert friction.static_friction() == friction.dynamic_friction() == expected, name
        if name in gripping:
            assert inspector.GetShape(geometry).radius() == published.contact_radius
    query = scene.query()
    heights = [query.GetPoseInWorld(g).translation()[2] for g in gripping.values()]
    sunk = min(heights) - published.contact_radius + 0.0005
    scene.set_base(RigidTransform([0.0, 0.0, published.standing_height - sunk]))
    assert scene.touching() == {(name, "world/ground") for name in gripping}


def test_every_signed_distance_within_the_robot_can_be_computed_and_all_is_rendered(scene):
    scene.set_base(RigidTransform([0.0, 0.0, 2.0]))
    query, inspector = scene.query(), scene.scene_graph.model_inspector()
    for id_A, id_B in inspector.GetCollisionCandidates():
        names = {scene.geometry_name(id_A), scene.geometry_name(id_B)}
        if "world/ground" not in names:
            assert query.ComputeSignedDistancePairClosestPoints(id_A, id_B).distance > 0.0, names
    seen, rendered = map(inspector.NumGeometriesWithRole, (Role.kIllustration, Role.kPerception))
    assert rendered == seen > len(scene.bodies)


def test_limbs_are_chains_and_a_reaching_point_is_the_centre_of_the_hands_sphere(scene):
    inspector = scene.scene_graph.model_inspector()
    for frame in scene.robot.limbs():
        joints = [scene.plant.GetJointByName(name) for name in frame.joints]
        for parent, child in itertools.pairwise(joints):
            assert parent.child_body().name() == child.parent_body().name()
        assert joints[-1].child_body().name() == frame.body
    for frame in scene.robot.reaching_frames.values():
        shapes = scene.plant.GetCollisionGeometriesForBody(scene.bodies[frame.body])
        (sphere,) = (g for g in shapes if isinstance(inspector.GetShape(g), Sphere))
        assert inspector.GetShape(sphere).radius() == frame.radius_m
        centre = inspector.GetPoseInFrame(sphere).translation()
        np.testing.assert_allclose(centre, frame.point, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scene", ["atlas"], indirect=True)
def test_atlas_touches_the_world_by_spheres_only_but_for_forearms_and_never_itself(scene):
    inspector = scene.scene_graph.model_inspector()
    for pair in inspector.GetCollisionCandidates():
        assert "world/ground" in {scene.geometry_name(geometry) for geometry in pair}
    # Between a half space and any other shape Drake finds contact, but no signed distance.
    shapes = {name: inspector.GetShape(g) for name, g in scene.collision_geometries().items()}
    others = {name for name, shape in shapes.items() if not isinstance(shape, Sphere)}
    assert others == {"l_ufarm/forearm", "r_ufarm/forearm"}
