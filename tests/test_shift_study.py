import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from drake_safety import (
    AssessmentParameters,
    SafetyAssessment,
    inputs_at,
    load_assessment,
    load_scenario,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.shift_study import (
    CONFIDENT,
    JudgedShift,
    motions_of,
    shift_estimates,
    shifts_figure,
    shifts_tables,
)
from drake_safety.evaluation.shifts import plant_shifts, shifted_scenario
from drake_safety.robots.robot_model import as_pattern
from lip_assessments import QUICK
from lip_episodes import make_episodes


@pytest.fixture(scope="module")
def training():
    return make_episodes(240, noise=0.002)


@pytest.fixture(scope="module")
def assessment(training):
    return SafetyAssessment(AssessmentParameters(**QUICK)).fit(training)


@pytest.fixture(scope="module")
def nominal():
    return motions_of(make_episodes(80, seed=5, noise=0.002))


def motion(num_rows, probability, *, is_unsafe):
    """A motion whose state is the probability that the double below returns, negative for none."""
    state = np.full((num_rows, 6), float(probability))
    rows = {"desired_preview": np.zeros((num_rows, 30)), "features": np.zeros((num_rows, 5))}
    return SimpleNamespace(
        state=state, **rows, margins=np.ones((num_rows, 2)), is_safe=not is_unsafe
    )


def told(state, preview, features, is_outside):
    return np.where(state[:, 0] < 0.0, np.nan, state[:, 0])


def rows_of(motion):
    is_outside = (motion.margins < 0.0).any(axis=1)
    return motion.state, motion.desired_preview, motion.features, is_outside


def judged(motions, **others):
    return JudgedShift({"gamma": told} | others, motions)


def test_a_confident_error_is_a_row_called_safe_in_a_motion_that_ends_unsafely():
    motions = [
        motion(10, 0.95, is_unsafe=True),  # sure and wrong
        motion(20, 0.95, is_unsafe=False),
        motion(30, CONFIDENT - 0.01, is_unsafe=True),
        motion(40, -1.0, is_unsafe=True),  # don't know
    ]
    shift = judged(motions)
    found = shift_estimates(shift)
    assert found["gamma.confident_error"].value == pytest.approx(0.1)
    assert found["gamma.unknown"].value == pytest.approx(0.4)
    assert found["unsafe"].value == 0.75
    assert found["gamma.confident_error"].n == 4


def test_the_catalogue_is_scaled_to_the_robot():
    scenario = load_scenario("laikago_balancing")
    shifts = plant_shifts(scenario, scenario.make_loop())
    force_n = shifts["side_force"].variation.shift.base_force_n
    mass_kg = shifts["payload"].variation.payload.mass_kg / 0.3
    assert math.isclose(force_n[1], 0.1 * 9.81 * mass_kg)
    assert {"slope", "hole", "weak_joint", "frozen", "variation actual"} <= set(shifts)
    assert all(one.kind in ("plant", "sensor") for one in shifts.values())
    shifted = shifted_scenario(scenario, "slope", shifts["slope"])
    assert "slope" in shifted.variations
    assert "slope" not in scenario.variations
    assert shifted.simulation_hash("slope") != scenario.simulation_hash("nominal")
    # A plant of its own has the scenario's variations alone.
    own = load_scenario("pendulum")
    shifts = plant_shifts(own, own.make_loop())
    assert list(shifts) == [f"variation {n}" for n in own.variations if n != "nominal"]


NAMES = ["friction+10%", "collision (arm)", "v1.heavy", "../up", "größe $a_1$ $", "0.5", "a%2Eb"]


def test_a_variation_may_have_any_name(tmp_path):
    scenario = load_scenario("pendulum")
    nominal = scenario.variation("nominal")
    scenario.variations = {"nominal": nominal} | dict.fromkeys(NAMES, nominal)
    shifts = plant_shifts(scenario, scenario.make_loop())
    found = {}
    for name in shifts:
        found[f"shifts.{name}.unsafe"] = proportion(1, 2)
        found[f"shifts.{name}.gamma.unknown"] = proportion(1, 4)
    Results(found).write(tmp_path / "shifts.json")
    read = Results.read(tmp_path / "shifts.json")
    (table,) = shifts_tables(read)
    assert [row.label for row in table.rows] == [f"variation {n}".replace("_", " ") for n in NAMES]
    assert all(None not in row.estimates for row in table.rows)
    unknown = [row.set for row in read.select(method="gamma", metric="unknown")]
    assert unknown == [f"shifts.{name}" for name in shifts]
    save(shifts_figure(found), tmp_path / "shifts")


@pytest.mark.parametrize("limit", [None, math.inf, 0.0])
def test_the_loaded_joint_may_have_no_motor_or_no_limit(monkeypatch, limit):
    scenario = load_scenario("laikago_balancing")
    loop = scenario.make_loop()
    usual = plant_shifts(scenario, loop)
    (pattern,) = usual["weak_joint"].variation.shift.joints
    plant = loop.kinematics.plant
    motors = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    others = [one for one in motors if as_pattern(one.joint().name()) != pattern]
    (own,) = set(motors) - set(others)
    if limit is not None:
        joint = own.joint()
        others.append(SimpleNamespace(joint=lambda: joint, effort_limit=lambda: limit))

    class Changed:
        get_joint_actuator = others.__getitem__

        def GetJointActuatorIndices(self):
            return range(len(others))

        def __getattr__(self, name):
            return getattr(plant, name)

    monkeypatch.setattr(loop.kinematics, "plant", Changed())
    found = plant_shifts(scenario, loop)
    if limit == math.inf:
        assert usual.keys() - found.keys() == {"weak_joint"}
    else:
        (other,) = found["weak_joint"].variation.shift.joints
        assert other != pattern


@pytest.mark.parametrize(("roll_rad", "height"), [(0.0, 1.5), (0.5 * math.pi, 0.3), (math.pi, 0.3)])
def test_a_robot_that_is_lifted_or_lies_is_dont_know(roll_rad, height):
    loop = load_scenario("laikago_balancing").make_loop()
    start = loop.standing_start()
    q = start.q.copy()
    q[:4], q[6] = RotationMatrix.MakeXRotation(roll_rad).ToQuaternion().wxyz(), height * q[6]
    inputs = inputs_at(loop, replace(start, q=q))
    assert load_assessment("laikago_balancing").predict_one(*inputs).belief[2] == 1.0
