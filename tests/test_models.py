"""The robots' models agree with the figures their makers published.

The figures stand in ``laikago_figures.py`` and ``atlas_figures.py``, the mechanics that they are
put into in ``published_robots.py``: plain numpy over every published link, fixed ones by
themselves.
"""

import re

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.models import load_robot, robot_names
from package_models import PUBLISHED, Scene

ROBOTS = sorted(PUBLISHED)


@pytest.fixture(scope="module", params=ROBOTS)
def name(request) -> str:
    return request.param


@pytest.fixture
def scene(name) -> Scene:
    return Scene(name)


def random_configuration(scene: Scene, rng: np.random.Generator):
    """A base pose of any orientation and joints anywhere within their limits, set in the scene."""
    published = scene.published
    R_WB = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    p_WB = rng.normal(size=3)
    limits = {joint: published.joints[joint].limits for joint in published.movable}
    positions = {joint: rng.uniform(lower, upper) for joint, (lower, upper) in limits.items()}
    scene.set_base(RigidTransform(RotationMatrix(R_WB), p_WB))
    scene.set_joints(positions)
    return (R_WB, p_WB), positions


def test_every_robot_described_in_the_package_is_compared_with_its_published_figures():
    own = "package://drake_safety_models/"
    assert [name for name in robot_names() if load_robot(name).urdf.startswith(own)] == ROBOTS


def test_the_robot_weighs_what_is_published(scene):
    published = scene.published
    mass = scene.plant.CalcTotalMass(scene.context, [scene.instance])
    assert mass == pytest.approx(published.total_mass, abs=1e-9)
    # The sum of the copied links, so that none of them was forgotten.
    copied = sum(link.mass for link in published.links.values())
    assert copied == pytest.approx(published.total_mass, abs=1e-9)


def test_a_body_moves_for_each_published_joint_and_the_base_floats(scene):
    assert sorted(scene.bodies) == sorted(scene.published.bodies)
    assert scene.base.is_floating_base_body()
    num_joints = len(scene.published.movable)
    assert scene.plant.num_positions() == 7 + num_joints
    assert scene.plant.num_velocities() == 6 + num_joints


def test_each_body_has_the_inertia_of_all_links_that_are_fixed_to_it(scene):
    for body_name, body in scene.bodies.items():
        M_BBo_B = body.default_spatial_inertia()
        mass, moment, inertia = scene.published.body_inertia(body_name)
        assert M_BBo_B.get_mass() == pytest.approx(mass, rel=1e-13), body_name
        exact = {"rtol": 0, "atol": 1e-12, "err_msg": body_name}
        np.testing.assert_allclose(M_BBo_B.get_mass() * M_BBo_B.get_com(), moment, **exact)
        found = M_BBo_B.CalcRotationalInertia().CopyToFullMatrix3()
        np.testing.assert_allclose(found, inertia, **exact)


@pytest.mark.parametrize("seed", range(5))
def test_mass_matrix_equals_that_of_the_published_links_each_by_itself(scene, seed):
    X_WB, positions = random_configuration(scene, np.random.default_rng(seed))
    order = scene.velocity_order()
    M = scene.plant.CalcMassMatrix(scene.context)[np.ix_(order, order)]
    published = scene.published.mass_matrix(X_WB, positions)
    np.testing.assert_allclose(M, published, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_every_frame_is_where_the_published_joints_carry_it(scene, seed):
    X_WB, positions = random_configuration(scene, np.random.default_rng(100 + seed))
    compared = []
    for link, (R_WL, p_WL) in scene.published.poses(X_WB, positions).items():
        if scene.plant.HasFrameNamed(link, scene.instance):
            found = scene.pose(link).GetAsMatrix34()
            expected = np.column_stack([R_WL, p_WL])
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12, err_msg=link)
            compared.append(link)
    assert set(scene.bodies) <= set(compared)


def test_joints_stop_move_push_and_damp_as_published(scene):
    for joint_name in scene.published.movable:
        figures = scene.published.joints[joint_name]
        joint = scene.plant.GetJointByName(joint_name)
        actuator = scene.plant.GetJointActuatorByName(joint_name)
        assert actuator.joint().name() == joint_name
        stops = (joint.position_lower_limit(), joint.position_upper_limit())
        speeds = (joint.velocity_lower_limit(), joint.velocity_upper_limit())
        assert (stops, speeds) == (figures.limits, (-figures.speed, figures.speed)), joint_name
        published = (figures.damping, figures.effort)
        assert (joint.default_damping(), actuator.effort_limit()) == published, joint_name


def test_actuators_are_the_joints_in_the_order_of_the_velocities(scene):
    plant = scene.plant
    names = [plant.get_joint_actuator(index).name() for index in plant.GetJointActuatorIndices()]
    starts = [plant.GetJointByName(joint_name).velocity_start() for joint_name in names]
    assert sorted(names) == sorted(scene.published.movable)
    assert starts == sorted(starts)


def test_robot_yaml_stands_in_the_published_posture_at_the_published_height(name):
    published = PUBLISHED[name]
    kinematics = RobotKinematics(load_robot(name))
    expected = [published.posture.get(joint, 0.0) for joint in kinematics.joint_names]
    np.testing.assert_allclose(kinematics.posture, expected, rtol=0, atol=1e-15)
    error = kinematics.standing_height - published.standing_height
    assert abs(error) <= published.standing_height_tolerance


def test_standing_soles_are_level_the_weight_is_between_them_and_joints_can_hold_it(name):
    kinematics = RobotKinematics(load_robot(name))
    q = kinematics.standing_positions()
    p_WC = kinematics.contact_positions(q)
    np.testing.assert_allclose(p_WC[:, 2], kinematics.foot_radii, rtol=0, atol=1e-12)
    p_WCm = kinematics.center_of_mass(q)[:2]
    # The contact points are the corners of a rectangle along x and y.
    assert (p_WC[:, :2].min(axis=0) < p_WCm).all()
    assert (p_WCm < p_WC[:, :2].max(axis=0)).all()
    lowest, highest = kinematics.position_limits.T
    assert ((lowest <= kinematics.posture) & (kinematics.posture <= highest)).all()
    torques = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, dtype=bool))
    for joint_name, torque in zip(kinematics.joint_names, torques, strict=True):
        assert abs(torque) < PUBLISHED[name].joints[joint_name].effort, joint_name


def partners_of(published, names) -> dict[str, str]:
    """Each name's partner on the other side; what stands in the middle is its own."""
    pattern, template = published.partner
    partners = {}
    for one in names:
        if match := re.fullmatch(pattern, one):
            other = match.expand(template)
            partners |= {one: other, other: one}
    return {one: partners.get(one, one) for one in names}


MIRROR = np.diag([1.0, -1.0, 1.0])


def mirror_signs(scene: Scene, partners: dict[str, str]) -> dict[str, float]:
    """By joint, its partner's angle in the mirrored posture, as a multiple of its own.

    A rotation about an axis is mirrored into one about the axis' mirror image, the other way.
    """
    published = scene.published
    zero = dict.fromkeys(published.movable, 0.0)
    poses = published.poses((np.eye(3), np.zeros(3)), zero)

    def axis(joint_name: str) -> np.ndarray:
        joint = published.joints[joint_name]
        return poses[joint.child][0] @ joint.axis

    signs = {one: -float(axis(other) @ MIRROR @ axis(one)) for one, other in partners.items()}
    assert {round(abs(sign), 9) for sign in signs.values()} == {1.0}
    return {one: np.sign(sign) for one, sign in signs.items()}


@pytest.mark.parametrize("mirrored", [name for name in ROBOTS if load_robot(name).mirror])
def test_a_robot_yaml_that_mirrors_pairs_the_joints_of_the_two_sides(mirrored):
    published = PUBLISHED[mirrored]
    expected = partners_of(published, published.movable)
    assert load_robot(mirrored).mirror_partners(published.movable) == expected
    assert any(one != other for one, other in expected.items())


def test_a_mirrored_posture_puts_every_body_where_its_partner_was(scene):
    published = scene.published
    partners = partners_of(published, published.movable)
    signs = mirror_signs(scene, partners)
    bodies = partners_of(published, published.bodies)
    rng = np.random.default_rng(0)
    offsets: dict[str, np.ndarray] = {}
    scene.set_base(RigidTransform())
    for trial in range(10):
        positions = {
            joint: 0.0 if trial == 0 else rng.uniform(*published.joints[joint].limits)
            for joint in published.movable
        }
        scene.set_joints(positions)
        poses = {body: scene.pose(body) for body in bodies}
        scene.set_joints({partners[j]: signs[j] * angle for j, angle in positions.items()})
        for one, other in bodies.items():
            X_WP = scene.pose(other)
            reflected = MIRROR @ poses[one].translation()
            np.testing.assert_allclose(X_WP.translation(), reflected, rtol=0, atol=1e-9)
            # Axes need not be each other's mirror images, but stay fixed to one another.
            R_WM = MIRROR @ poses[one].rotation().matrix() @ MIRROR
            R_PM = X_WP.rotation().matrix().T @ R_WM
            expected = offsets.setdefault(one, R_PM)
            np.testing.assert_allclose(R_PM, expected, rtol=0, atol=1e-9, err_msg=one)


def test_the_two_sides_have_mirrored_limits_and_equal_motors_and_masses(scene):
    published = scene.published
    partners = partners_of(published, published.movable)
    signs = mirror_signs(scene, partners)
    plant = scene.plant
    for one, other in partners.items():
        joint, mirrored = plant.GetJointByName(one), plant.GetJointByName(other)
        stops = (joint.position_lower_limit(), joint.position_upper_limit())
        ends = sorted(signs[one] * end for end in stops)
        assert ends == [mirrored.position_lower_limit(), mirrored.position_upper_limit()], one
        motors = [plant.GetJointActuatorByName(j).effort_limit() for j in (one, other)]
        assert motors[0] == motors[1], one
        assert joint.velocity_upper_limit() == mirrored.velocity_upper_limit(), one
    for one, other in partners_of(published, published.bodies).items():
        assert scene.bodies[one].default_mass() == scene.bodies[other].default_mass(), one
