"""What of the robots can touch: contact points, hands, links, the ground."""

import itertools

import numpy as np
import pytest
from pydrake.geometry import Cylinder, Role, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from drake_safety.models import load_robot
from package_models import PUBLISHED, Scene

LEGS = ("FR", "FL", "RR", "RL")
LAIKAGO_LINKS = ("hip", "thigh", "calf")
LAIKAGO_STANDING = (0.0, 0.67, -1.3)
SAMPLED = ((-0.4, 0.4, 5), (0.2, 1.3, 6), (-2.0, -0.7, 6))


@pytest.fixture(params=sorted(PUBLISHED))
def scene(request) -> Scene:
    return Scene(request.param)


@pytest.fixture
def laikago() -> Scene:
    return Scene("laikago")


@pytest.fixture
def atlas() -> Scene:
    return Scene("atlas")


def set_leg(scene: Scene, leg: str, angles) -> None:
    joints = (f"{leg}_{link}_joint" for link in LAIKAGO_LINKS)
    scene.set_joints(dict(zip(joints, angles, strict=True)))


def lowest_of(scene: Scene) -> float:
    """Height of the lowest contact point in the present configuration [m]."""
    query = scene.query()
    radius = scene.published.contact_radius
    heights = [query.GetPoseInWorld(g).translation()[2] for g in scene.contact_spheres().values()]
    return min(heights) - radius


def test_each_contact_point_of_robot_yaml_is_a_published_one_and_has_a_sphere(scene):
    published = scene.published
    inspector = scene.scene_graph.model_inspector()
    centres: dict[str, list[np.ndarray]] = {}
    for name, geometry in scene.contact_spheres().items():
        shape = inspector.GetShape(geometry)
        assert isinstance(shape, Sphere)
        assert shape.radius() == published.contact_radius
        centres.setdefault(name.split("/")[0], []).append(
            inspector.GetPoseInFrame(geometry).translation()
        )
    assert {foot.body for foot in scene.robot.feet.values()} == set(published.contact_centres)
    for foot in scene.robot.feet.values():
        expected = published.contact_centres[foot.body]
        np.testing.assert_allclose(foot.contact_points, expected, rtol=0, atol=1e-12)
        found = np.array(centres[foot.body])
        assert len(found) == len(expected)
        for point in expected:
            assert np.linalg.norm(found - point, axis=1).min() < 1e-12
        assert foot.radius_m == published.contact_radius


def test_the_joints_of_a_leg_and_of_an_arm_are_a_chain_that_ends_in_its_foot_or_hand(scene):
    frames = [*scene.robot.feet.values(), *scene.robot.reaching_frames.values()]
    for frame in frames:
        joints = [scene.plant.GetJointByName(name) for name in frame.joints]
        for parent, child in itertools.pairwise(joints):
            assert parent.child_body().name() == child.parent_body().name()
        assert joints[-1].child_body().name() == frame.body


def test_only_the_contact_points_touch_the_ground_when_standing(scene):
    lowest = lowest_of(scene)
    scene.set_base_height(scene.published.standing_height - lowest - 0.0005)
    expected = {(name, "world/ground") for name in scene.contact_spheres()}
    assert scene.touching() == expected


def test_nothing_touches_in_the_standing_posture(scene):
    scene.set_base_height(2.0)
    assert scene.touching() == set()


def test_the_contact_points_grip_and_the_rest_slides(scene):
    inspector = scene.scene_graph.model_inspector()
    gripping = scene.contact_spheres()
    assert scene.robot.foot_friction == scene.published.foot_friction
    for name, geometry in scene.collision_geometries().items():
        friction = inspector.GetProximityProperties(geometry).GetProperty(
            "material", "coulomb_friction"
        )
        published = scene.published
        expected = published.foot_friction if name in gripping else published.other_friction
        assert friction.static_friction() == expected, name
        assert friction.dynamic_friction() == expected, name


def test_every_signed_distance_within_the_robot_can_be_computed(scene):
    scene.set_base_height(2.0)
    query = scene.query()
    for id_A, id_B in scene.scene_graph.model_inspector().GetCollisionCandidates():
        names = {scene.geometry_name(id_A), scene.geometry_name(id_B)}
        if "world/ground" not in names:
            assert query.ComputeSignedDistancePairClosestPoints(id_A, id_B).distance > 0.0, names


def test_the_robot_can_be_seen_and_what_is_seen_can_be_rendered(scene):
    inspector = scene.scene_graph.model_inspector()
    seen, rendered = map(inspector.NumGeometriesWithRole, (Role.kIllustration, Role.kPerception))
    assert rendered == seen > len(scene.bodies)


@pytest.mark.parametrize("name", [n for n in sorted(PUBLISHED) if load_robot(n).reaching_frames])
def test_a_reaching_point_is_the_centre_of_the_hands_sphere(name):
    scene = Scene(name)
    inspector = scene.scene_graph.model_inspector()
    for frame in scene.robot.reaching_frames.values():
        shapes = scene.plant.GetCollisionGeometriesForBody(scene.bodies[frame.body])
        (sphere,) = (g for g in shapes if isinstance(inspector.GetShape(g), Sphere))
        assert inspector.GetShape(sphere).radius() == frame.radius_m
        centre = inspector.GetPoseInFrame(sphere).translation()
        np.testing.assert_allclose(centre, frame.point, rtol=0, atol=1e-12)


def test_a_laikago_leg_never_touches_itself_or_the_trunk_where_legs_are_sampled(laikago):
    laikago.set_base_height(1.0)
    for leg in LEGS:
        for angles in itertools.product(*(np.linspace(*sampled) for sampled in SAMPLED)):
            set_leg(laikago, leg, angles)
            touching = laikago.touching()
            assert not any(all(n.startswith((leg, "trunk")) for n in p) for p in touching), angles
        set_leg(laikago, leg, LAIKAGO_STANDING)


def test_only_a_laikago_leg_with_itself_and_the_trunk_with_hips_and_thighs_are_filtered(laikago):
    candidates = {
        frozenset(laikago.geometry_name(geometry).split("/")[0] for geometry in pair)
        for pair in laikago.scene_graph.model_inspector().GetCollisionCandidates()
    }
    links = [f"{leg}_{link}" for leg in LEGS for link in LAIKAGO_LINKS]
    expected = {
        frozenset(pair) for pair in itertools.combinations(links, 2) if pair[0][:2] != pair[1][:2]
    }
    expected |= {frozenset(("trunk", f"{leg}_calf")) for leg in LEGS}
    expected |= {frozenset(("world", link)) for link in ("trunk", *links)}
    assert candidates == expected


def test_laikagos_calf_ends_short_of_its_foot(laikago):
    inspector = laikago.scene_graph.model_inspector()
    shapes = laikago.collision_geometries()
    shin, foot = shapes["FR_calf/shin"], shapes["FR_calf/foot"]
    capsule, radius = inspector.GetShape(shin), inspector.GetShape(foot).radius()
    shin_z, foot_z = (inspector.GetPoseInFrame(one).translation()[2] for one in (shin, foot))
    assert shin_z - capsule.length() / 2 - capsule.radius() > foot_z + radius
    assert capsule.radius() < radius


@pytest.mark.parametrize(("right", "left"), [("FR", "FL"), ("RR", "RL")])
def test_laikagos_feet_brought_together_collide(laikago, right, left):
    laikago.set_base_height(1.0)
    leg_length = 0.25 * np.cos(0.67) + 0.25 * np.cos(0.67 - 1.3)
    # The foot is under the trunk's centre line: 0.0875 + 0.037 cos(hip) = leg_length sin(hip).
    hip = np.arcsin(0.0875 / np.hypot(leg_length, 0.037)) + np.arctan2(0.037, leg_length)
    set_leg(laikago, right, (hip, *LAIKAGO_STANDING[1:]))
    set_leg(laikago, left, (-hip, *LAIKAGO_STANDING[1:]))
    assert laikago.pose(f"{right}_foot").translation()[1] == pytest.approx(0.0, abs=1e-12)
    assert (f"{left}_calf/foot", f"{right}_calf/foot") in laikago.touching()


def test_a_front_foot_of_laikago_reaching_back_collides_with_the_hind_leg(laikago):
    laikago.set_base_height(1.0)
    set_leg(laikago, "FR", (0.0, 1.3, -0.7))
    set_leg(laikago, "RR", (0.0, 0.2, -2.0))
    assert any(one[:2] == "FR" and other[:2] == "RR" for one, other in laikago.touching())


def test_atlas_touches_the_world_only_and_never_itself(atlas):
    for pair in atlas.scene_graph.model_inspector().GetCollisionCandidates():
        assert "world/ground" in {atlas.geometry_name(geometry) for geometry in pair}


def test_only_the_forearms_of_atlas_are_anything_but_spheres(atlas):
    # Between a half space and any other shape Drake finds contact, but no signed distance.
    inspector = atlas.scene_graph.model_inspector()
    shapes = {name: inspector.GetShape(g) for name, g in atlas.collision_geometries().items()}
    others = {name for name, shape in shapes.items() if not isinstance(shape, Sphere)}
    assert others == {"l_ufarm/forearm", "r_ufarm/forearm"}


@pytest.mark.parametrize("side", ["l", "r"])
def test_no_board_fits_between_the_hand_and_the_forearm_of_atlas(atlas, side):
    board = 0.05
    inspector = atlas.scene_graph.model_inspector()
    shapes = atlas.collision_geometries()
    forearm, hand = shapes[f"{side}_ufarm/forearm"], shapes[f"{side}_hand/hand"]
    cylinder = inspector.GetShape(forearm)
    assert isinstance(cylinder, Cylinder)
    rng = np.random.default_rng(0)
    for _ in range(50):
        for joint in (f"{side}_arm_mwx", f"{side}_arm_lwy"):
            atlas.set_joints({joint: rng.uniform(*atlas.published.joints[joint].limits)})
        query = atlas.query()
        X_WF, X_WH = query.GetPoseInWorld(forearm), query.GetPoseInWorld(hand)
        p_FH = X_WF.inverse() @ X_WH.translation()
        beside = max(np.hypot(*p_FH[:2]) - cylinder.radius(), 0.0)
        beyond = max(abs(p_FH[2]) - cylinder.length() / 2, 0.0)
        gap = np.hypot(beside, beyond) - inspector.GetShape(hand).radius()
        assert 0.0 < gap < board


@pytest.mark.parametrize("side", ["l", "r"])
def test_the_forearms_cylinder_of_atlas_lies_along_the_line_from_elbow_to_wrist(atlas, side):
    forearm = atlas.collision_geometries()[f"{side}_ufarm/forearm"]
    shape = atlas.scene_graph.model_inspector().GetShape(forearm)
    X_WF = atlas.query().GetPoseInWorld(forearm)
    wrist = X_WF.inverse() @ atlas.pose(f"{side}_lfarm").translation()
    elbow = X_WF.inverse() @ atlas.pose(f"{side}_larm").translation()
    for p_F in (wrist, elbow):
        # The published forearm turns about a line 9.2 mm beside the elbow's axis.
        assert np.hypot(*p_F[:2]) < 0.01
    ends = sorted((wrist[2], elbow[2]))
    assert ends[0] < shape.length() / 2 and -shape.length() / 2 < ends[1]
    # It covers the wrist, and most of the forearm.
    assert abs(wrist[2]) < shape.length() / 2
    assert shape.length() > 0.9 * (ends[1] - ends[0])


@pytest.mark.parametrize("tilt", [(0.0, 0.6, 0.0), (0.0, -0.6, 0.0), (0.6, 0.0, 0.0)])
def test_atlas_without_torques_falls_on_the_ground_and_not_through_it(tilt):
    atlas = Scene("atlas", time_step=0.002)
    atlas.set_base(RigidTransform(RollPitchYaw(tilt), [0.0, 0.0, 0.9]))
    atlas.plant.get_actuation_input_port().FixValue(atlas.context, np.zeros(30))
    simulator = Simulator(atlas.diagram, atlas.root)
    simulator.AdvanceTo(1.5)
    pelvis, torso = atlas.pose("pelvis").translation(), atlas.pose("utorso").translation()
    assert 0.05 < pelvis[2] < 0.5
    assert torso[2] > 0.05
