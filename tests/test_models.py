"""The robots of the package have their published figures, and touch what they should."""

import itertools

import numpy as np
import pytest
from pydrake.geometry import Role, Sphere

from package_models import Scene

# Total mass [kg] and standing height [m] as published, with the height's tolerance.
PUBLISHED = {"laikago": (25.433, 0.4245, 1e-3), "atlas": (175.117964, 0.7407, 5e-5)}
ROBOTS = sorted(PUBLISHED)


@pytest.fixture(scope="module", params=ROBOTS)
def scene(request) -> Scene:
    return Scene(request.param)


@pytest.fixture(autouse=True)
def standing(scene):
    scene.stand()


def test_a_robot_has_its_published_mass_and_stands_over_its_feet_at_its_height(scene):
    mass, height, tolerance = PUBLISHED[scene.robot.name]
    kinematics = scene.kinematics
    assert kinematics.total_mass == pytest.approx(mass, abs=1e-9)
    assert kinematics.standing_height == pytest.approx(height, abs=tolerance)
    q = kinematics.standing_positions()
    p_WC, p_WCm = kinematics.contact_positions(q), kinematics.center_of_mass(q)[:2]
    np.testing.assert_allclose(p_WC[:, 2], kinematics.foot_radii, rtol=0, atol=1e-12)
    assert (p_WC[:, :2].min(axis=0) < p_WCm).all() and (p_WCm < p_WC[:, :2].max(axis=0)).all()
    torques = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, dtype=bool))
    for name, torque in zip(kinematics.joint_names, torques, strict=True):
        assert abs(torque) < scene.plant.GetJointActuatorByName(name).effort_limit(), name


def test_the_contact_points_of_robot_yaml_grip_and_alone_touch_the_ground(scene):
    inspector, gripping = scene.scene_graph.model_inspector(), scene.contact_spheres()
    other = {"laikago": 0.2, "atlas": 0.5}[scene.robot.name]
    assert len(gripping) == scene.kinematics.num_contacts
    for name, geometry in scene.collision_geometries().items():
        friction = inspector.GetProximityProperties(geometry).GetProperty(
            "material", "coulomb_friction"
        )
        expected = scene.robot.foot_friction if name in gripping else other
        assert friction.static_friction() == friction.dynamic_friction() == expected, name
    scene.stand(sunk_m=0.0005)
    assert scene.touching() == {(name, "world/ground") for name in gripping}


def test_every_signed_distance_within_the_robot_can_be_computed_and_all_is_rendered(scene):
    scene.stand(sunk_m=-2.0)
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
