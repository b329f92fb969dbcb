"""Survey and standing posture: legs, arms and feet are found, and the robot can stand on them."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yaml

from drake_safety.importing.standing_posture import solve_standing_posture
from drake_safety.importing.urdf_survey import Survey
from legged_robots import write_biped, write_hexapod, write_porter

WRITERS = {"hexapod": write_hexapod, "porter": write_porter}


@pytest.fixture(scope="module", params=WRITERS)
def surveyed(request, tmp_path_factory):
    """A made-up robot: what is found, and what its own robot.yaml says."""
    folder = tmp_path_factory.mktemp(request.param)
    path = WRITERS[request.param](folder)
    survey = Survey(folder / f"{request.param}.urdf")
    return survey, yaml.safe_load(path.read_text())


def test_the_limbs_are_those_that_the_robots_own_file_names(surveyed):
    survey, known = surveyed
    survey.set_joints({})
    assert survey.base == known["base"]
    legs = {leg.body: leg for leg in survey.legs()}
    assert set(legs) == {foot["body"] for foot in known["feet"].values()}
    for foot in known["feet"].values():
        leg = legs[foot["body"]]
        assert leg.joints == foot["joints"]
        assert leg.radius_m == pytest.approx(foot["radius_m"])
        points = [sorted(np.round(of, 6).tolist()) for of in (leg.points, foot["contact_points"])]
        assert points[0] == points[1]
    arms = {arm.body: arm.joints for arm in survey.arms(survey.legs())}
    frames = known.get("reaching_frames", {}).values()
    assert arms == {frame["body"]: frame["joints"] for frame in frames if "joints" in frame}


def test_feet_stand_level_and_flat_under_the_hips_off_the_stops(surveyed):
    survey, _ = surveyed
    survey.set_joints({})
    legs = survey.legs()
    hips = [survey.joint_origin(leg.joints[0]) for leg in legs]
    posture = solve_standing_posture(survey, legs)
    survey.set_joints(posture)
    points = np.concatenate([survey.positions(leg) for leg in legs])
    assert np.ptp(points[:, 2]) < 2e-3
    assert points[:, 2].max() < -0.05
    for name, value in posture.items():
        low, high = survey.limits[name]
        assert low < value < high
    for leg, hip in zip(legs, hips, strict=True):
        foot = survey.positions(leg).mean(axis=0)
        # Half of a leg that spreads is 0.175 m, after 0.05 m of its hip.
        assert np.linalg.norm(foot[:2] - hip[:2]) < 0.226


def test_feet_are_put_under_a_centre_of_mass_that_is_not_over_them(tmp_path):
    write_biped(tmp_path)
    urdf = tmp_path / "biped.urdf"
    survey = Survey(urdf)
    root = ElementTree.parse(urdf).getroot()
    origin = root.find(f"link[@name='{survey.base}']/inertial/origin")
    x, y, z = map(float, origin.get("xyz").split())
    origin.set("xyz", f"{x + 0.15} {y} {z}")
    urdf.write_text(ElementTree.tostring(root, encoding="unicode"))
    survey = Survey(urdf)
    legs = survey.legs()
    solve_standing_posture(survey, legs)
    points = np.concatenate([survey.positions(leg) for leg in legs])
    assert points[:, 0].min() < survey.center_of_mass()[0] < points[:, 0].max()
    assert np.ptp(points[:, 2]) < 2e-3


def test_feet_can_be_named_and_a_wrong_name_is_answered_with_those_that_exist(tmp_path):
    write_hexapod(tmp_path)
    survey = Survey(tmp_path / "hexapod.urdf")
    legs = survey.legs(["tibia_0", "tibia_2", "tibia_4"])
    assert {leg.body for leg in legs} == {"tibia_0", "tibia_2", "tibia_4"}
    with pytest.raises(ValueError, match=r"in links \['paw'\]; limbs end in \['tibia_0'"):
        survey.legs(["paw"])
    with pytest.raises(ValueError, match="found 1 feet, expected at least 2"):
        survey.legs(["tibia_0"])
