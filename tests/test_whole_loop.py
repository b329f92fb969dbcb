import numpy as np
import pytest

from drake_safety import load_assessment, load_scenario
from drake_safety.diagrams.balancing.throws import VIOLATIONS, run_throw
from drake_safety.plants.balls import Throw
from drake_safety.robots.robot import PlantVariation

HARD = Throw(time_s=0.4, mass_kg=3.0, speed_m_s=8.0, direction_rad=-1.2)


def test_gamma_in_the_diagram_is_gamma_on_the_log():
    scenario, assessment = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    # Without measurement noise, of which every reading at an instant may be a fresh draw.
    scenario.variations["quiet"] = PlantVariation(joint_friction_nm=0.4)
    loop = scenario.make_loop("quiet", assessment=assessment, recovery=False, ball=True)
    ports = ("safety_probability", "belief")
    log = run_throw(loop, 0, seed=8, throws=[HARD], duration_s=1.0, ports=ports)
    result = assessment.predict(log["state"], log["desired_preview"], log["features"])
    # Outside the safe set nothing is safe.
    is_outside = log["margins"].min(axis=1) < 0.0
    assert is_outside.any() and not is_outside.all()
    belief = result.belief.copy()
    belief[is_outside, 1] += belief[is_outside, 0]
    belief[is_outside, 0] = 0.0
    probability = result.probability[:, None] * ~is_outside[:, None]
    # A row shows the state before the updates of its instant: Γ of a row is published in the next.
    np.testing.assert_allclose(log["safety_probability"][1:], probability[:-1], atol=1e-5)
    np.testing.assert_allclose(log["belief"][1:], belief[:-1], atol=1e-5)
    assert np.ptp(result.belief[:, 0]) > 0.35


@pytest.mark.slow
def test_gamma_falls_at_the_hit_and_recovery_saves_the_robot():
    scenario, assessment = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    alone = scenario.make_loop("actual", assessment=assessment, recovery=False, ball=True)
    log = run_throw(alone, 0, seed=8, throws=[HARD], duration_s=2.5)
    assert log.has_fallen
    loop = scenario.make_loop("actual", assessment=assessment, ball=True)
    log = run_throw(loop, 0, seed=8, throws=[HARD], duration_s=3.0)
    assert not log.has_fallen
    assert HARD.time_s < log.recovery_intervals_s[0][0] < HARD.time_s + 0.1
    violated = dict(zip(VIOLATIONS, log["violations"].any(axis=0), strict=True))
    assert not (violated["legs_collide"] or violated["joint_position"] or violated["joint_effort"])
