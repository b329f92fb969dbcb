import numpy as np
import pytest

from drake_safety import load_scenario
from drake_safety.simulation.motion import Motion
from studies.walking import guard_estimates, push_estimates, recovery_estimates, speed_estimates
from studies.walking_motions import run_motions, run_push


def motion(values, *, changed=0.0, impact=0.0, **times):
    n = len(values)
    ports = {
        "features": np.array(values, dtype=float)[:, None],
        "output": np.tile([0.5, 0.0, 0.1], (n, 1)),
        "guard_active": np.full((n, 1), changed),
        "downward_m_s": np.full((n, 1), impact),
    }
    return Motion(time_s=0.1 * np.arange(n), ports=ports, **times)


def test_falls_and_their_times_are_those_of_motions_that_leave_after_the_push():
    falls = motion([1] * 8, push_time_s=0.2, leave_time_s=0.6, fall_time_s=0.7)
    before_push = motion([1, 1], push_time_s=0.5, leave_time_s=0.1, fall_time_s=0.1)
    pushed = [falls, falls, motion([1] * 6, push_time_s=0.1), before_push]
    found = push_estimates(pushed, push_s=0.2)
    assert found["pushes", "", "fallen"].value == pytest.approx(2 / 3)
    assert found["pushes", "", "push_to_fall_s"].value == pytest.approx(0.5)
    assert found["pushes", "", "fallen_soon"].value == 0.0
    assert push_estimates(pushed, push_s=0.4)["pushes", "", "fallen_soon"].value == 1.0


def test_guard_recovery_and_speeds_compare_the_same_motions():
    falls, stays = motion([1, 1], leave_time_s=0.1, fall_time_s=0.1, impact=3.0), motion([1, 1])
    softer = motion([1, 1], leave_time_s=0.1, fall_time_s=0.1, impact=2.0)
    guard = guard_estimates([falls, falls, stays], [stays, falls, stays], [motion([1], changed=1)])
    assert (guard["guard", "", "falls_without"].value, guard["guard", "", "falls_with"].value) == (
        2 / 3,
        1 / 3,
    )
    assert guard["guard", "", "unchanged_inside"].value == 0.0
    saved = recovery_estimates("slower", [falls, falls], [stays, softer])
    assert saved["recovery", "slower", "saved"].value == 0.5
    assert saved["recovery", "slower", "impact_m_s"].value == 2.0
    assert saved["recovery", "slower", "impact_without_m_s"].value == 3.0
    assert speed_estimates([stays], [stays])["speed", "", "difference_to_mujoco_m_s"].value == 0.0


def test_a_motion_that_is_kept_is_the_one_that_was_simulated(tmp_path):
    scenario, options = load_scenario("go2_walking"), {"seed": 3, "duration_s": 0.4}
    (kept,) = run_motions(scenario, "push", [2], folder=tmp_path, num_workers=1, **options)
    motion = run_push(scenario.make_loop(), 2, **options)
    np.testing.assert_array_equal(kept.time_s, motion.time_s)
    for name in ("index", "cause", "push_time_s", "leave_time_s", "fall_time_s"):
        assert getattr(kept, name) == getattr(motion, name)
    assert kept.ports.keys() == motion.ports.keys()
    for port, rows in motion.ports.items():
        np.testing.assert_array_equal(kept[port], rows.astype(np.float32))
