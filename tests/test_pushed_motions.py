import math

import numpy as np
import pytest

from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.learning.inputs import is_rate
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import shuttling
from studies.pushed_motions import run_pushed_motion, run_pushed_motions


def test_every_motion_is_safe_until_somebody_pushes_and_the_same_until_then():
    scenario = shuttling()
    loop = scenario.make_loop()
    motions = run_pushed_motions(scenario, 12, seed=4, variation="nominal", num_workers=1)
    assert [motion.index for motion in motions] == sorted(2 * list(range(12)))
    calm, pushed = motions[::2], motions[1::2]
    for one, other in zip(calm, pushed, strict=True):
        assert not one.has_left and one.push_time_s == math.inf
        before = other.time_s <= other.push_time_s + 1e-9
        assert 0.1 <= other.push_time_s <= 0.3 + 1e-9
        np.testing.assert_array_equal(one["state"][: before.sum()], other["state"][before])
        assert not other.leave_time_s <= other.push_time_s
    assert 0 < sum(motion.has_left for motion in pushed) < 12
    # A motion follows from its seed and index alone.
    for again, before in zip(run_pushed_motion(loop, 5, seed=4), motions[10:12], strict=True):
        np.testing.assert_array_equal(again["state"], before["state"])
        assert again.push_time_s == before.push_time_s


def test_goals_that_nobody_reaches_safely_are_no_place_to_be_pushed_on_the_way_to(monkeypatch):
    loop = shuttling().make_loop()
    monkeypatch.setattr(type(loop), "target_box", np.array([[1.3, 0.0, 0.2], [1.4, 0.1, 0.3]]))
    with pytest.raises(ValueError, match="none of 50 random goals is reached safely"):
        run_pushed_motion(loop, 0, seed=4)


@pytest.mark.parametrize("name", ["laikago_balancing", "atlas_reaching"])
def test_what_one_would_watch_and_what_is_made_of_velocities_is_told_by_name(name):
    loop = load_scenario(name).make_loop()
    q = loop.kinematics.standing_positions()
    v = np.zeros(loop.kinematics.num_velocities)
    pushed = v.copy()
    pushed[:] = np.linspace(0.2, 0.4, len(pushed))
    preview = np.tile([0.0, 0.0, loop.kinematics.standing_height], (5, 1))
    safe_set = getattr(loop, "safe_set", None)
    if safe_set is None:
        safe_set = BalanceSafeSet(loop.kinematics, loop.scenario.parameters.safe_set)
    still, moving = (safe_set.features(q, one, preview) for one in (v, pushed))
    # Exactly the features that velocities enter change with them; gravity's are appended.
    names = loop.feature_names[: len(still)]
    changed = {f for f, a, b in zip(names, still, moving, strict=True) if a != b}
    assert changed == set(loop.rate_features) & set(loop.feature_names)
    rates = [*filter(is_rate, loop.state_names)]
    assert len(rates) == len(loop.state_names) / 2
    watched = {
        what: still[loop.feature_names.index(f)] for what, f in loop.watched_features.items()
    }
    # At rest the capture point lies under the centre of mass: both are inside.
    assert watched.keys() == {"capture_point_margin", "support_margin"}
    assert min(watched.values()) > 0.02
    assert watched["support_margin"] == pytest.approx(safe_set.margins(q, v)[0])
