import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from drake_safety.control.kinematics import fit_stance
from drake_safety.control.recovery_step import RecoveryStepParameters, capture_point, gait_groups
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from legged_robots import base_over, robot_kinematics, standing_feet
from system_doubles import Bench

PERIOD_S = 0.01


class Stepping(Bench):
    """A planner that sees a robot standing (or gliding) in its posture at a stance pose."""

    def __init__(
        self, name="laikago", stance_pose=(0.0, 0.0, 0.0), speed=(0.0, 0.0), active=1.0, **numbers
    ):
        self.kinematics = k = robot_kinematics(name)
        self.parameters = RecoveryStepParameters(**numbers)
        options = {"period_s": PERIOD_S, "horizon": 4, "num_outlook": 3}
        super().__init__(RecoveryStepPlanner(k, self.parameters, **options))
        self.stance_pose, self.speed = np.array(stance_pose), np.array([*speed, 0.0])
        self.feet = standing_feet(k, stance_pose)
        self.base = base_over(k, stance_pose)
        self.see(self.base)
        self.fix(recovery_active=active, nominal_desired_output=self.base)
        self.begin()

    def see(self, p_WB, turned=0.0, yaw_rate=0.0):
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(self.stance_pose[2] + turned), p_WB)
        v = np.zeros(self.kinematics.num_velocities)
        v[2], v[3:6] = yaw_rate, self.speed
        q = self.kinematics.positions_at(X_WB, self.kinematics.posture)
        self.fix(plant_state=np.concatenate([q, v]))

    def feet_now(self):
        return self.get("desired_foot_positions").reshape(-1, 3)

    def lifted(self):
        """Which feet are commanded off the ground."""
        over = self.feet_now()[:, 2] - self.kinematics.foot_radii > 1e-3
        slices = self.kinematics.foot_slices
        return [i for i, rows in enumerate(slices) if over[rows].all()]

    def groups(self):
        contacts, slices = self.kinematics.nominal_contacts, self.kinematics.foot_slices
        return gait_groups(np.array([contacts[rows].mean(axis=0) for rows in slices]))


def test_at_rest_the_feet_stay_where_they_were_seen_first():
    bench = Stepping(stance_pose=(1.0, 2.0, 0.5), active=0.0)
    bench.advance(0.3)
    np.testing.assert_allclose(bench.feet_now(), bench.feet, atol=1e-12)
    np.testing.assert_allclose(bench.get("stance_pose"), [1.0, 2.0, 0.5], atol=1e-12)
    assert bench.get("desired_yaw")[0] == bench.get("stance_pose")[2]
    assert bench.get("recovery_done")[0] == 0


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_one_group_swings_at_a_time_and_the_groups_alternate(name):
    bench = Stepping(name, speed=(0.5, 0.0), min_steps=4)
    swung = []
    for _ in range(4):
        bench.advance(0.5 * bench.parameters.step_duration_s)
        swung.append(bench.lifted())
        bench.advance(0.5 * bench.parameters.step_duration_s)
    assert swung[0] in bench.groups()
    assert swung[0] == swung[2]
    assert swung[1] == swung[3]
    assert sorted(swung[0] + swung[1]) == list(range(len(bench.kinematics.foot_names)))


@pytest.mark.parametrize(("heading", "turned"), [(0.5, 0.1), (3.1, 0.1), (-3.1, -0.2)])
def test_a_base_that_has_turned_is_told_the_heading_in_which_the_recovery_began(heading, turned):
    bench = Stepping(stance_pose=(0.0, 0.0, heading), speed=(1.0, 0.0), max_twist_rad=0.3)
    for _ in range(3):  # Footholds turn with the base; the heading does not.
        bench.see(bench.base, turned=turned)
        bench.advance(bench.parameters.step_duration_s)
        error = np.remainder(bench.get("desired_yaw")[0] - heading + np.pi, 2 * np.pi) - np.pi
        assert error == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("damping_s", "twist", "turned", "rate", "yaw"),
    [
        (0.1, 0.3, 0.0, 1.0, -0.1),  # Against the turning.
        (0.1, 0.3, 0.0, -0.5, 0.05),
        (None, 0.2, 1.0, 2.0, 0.8),  # Never further than it can twist.
        (None, 0.0, 0.5, 3.0, 0.0),  # A blow has not turned the feet.
    ],
)
def test_a_turning_base_is_told_a_yaw_against_it(damping_s, twist, turned, rate, yaw):
    options = {} if damping_s is None else {"yaw_damping_s": damping_s}
    bench = Stepping(speed=(1.0, 0.0), max_twist_rad=twist, **options)
    bench.see(bench.base, turned=turned, yaw_rate=rate)
    bench.advance(2 * PERIOD_S)
    assert bench.get("desired_yaw")[0] == pytest.approx(yaw, abs=1e-9 if twist else 0.1)


def test_a_robot_that_holds_no_heading_stops_wherever_it_has_turned_to():
    bench = Stepping(max_twist_rad=0.0)
    bench.see(bench.base, turned=1.5)
    settled(bench)
    assert bench.get("recovery_done")[0] == 1
    assert bench.get("stance_pose")[2] == pytest.approx(1.5, abs=0.05)


def test_a_robot_far_from_its_heading_steps_on():
    bench = Stepping(settle_heading_rad=0.35)
    bench.see(bench.base, turned=0.5)
    bench.advance(10.5 * bench.parameters.step_duration_s)
    assert bench.lifted()
    bench.see(bench.base, turned=0.2)
    bench.advance(2 * bench.parameters.step_duration_s)
    assert not bench.lifted()


@pytest.mark.parametrize("max_steps", [20, 2])
def test_a_robot_that_cannot_stand_after_all_steps_on_up_to_its_last_step(max_steps):
    bench = Stepping(min_steps=2, max_steps=max_steps)
    bench.advance(2 * bench.parameters.step_duration_s + 3 * PERIOD_S)
    assert not bench.lifted()
    assert bench.get("recovery_done")[0] == 0
    bench.speed = np.array([2.0, 0.0, 0.0])
    bench.see(bench.base)
    bench.advance(0.5 * bench.parameters.step_duration_s)
    assert bool(bench.lifted()) == (max_steps > 2)
    bench.speed = np.zeros(3)
    bench.see(bench.base)
    settled(bench)
    assert bench.get("recovery_done")[0] == 1


def test_the_base_comes_to_rest_over_its_capture_point_before_it_returns():
    bench = Stepping(speed=(0.2, 0.1), min_steps=2, return_duration_s=50.0)
    bench.advance(2 * bench.parameters.step_duration_s + 2.0)
    point = capture_point(bench.base, bench.speed)
    np.testing.assert_allclose(bench.get("desired_output")[:2], point, atol=2e-3)


def settled(bench):
    steps = 20 * bench.parameters.step_duration_s
    bench.advance(steps + bench.parameters.return_duration_s + 0.2)
    return bench


def test_the_stance_pose_becomes_that_of_the_new_footholds():
    margins = {"settle_margin_m": 0.01, "resume_margin_m": 0.0}
    bench = Stepping(stance_pose=(0.5, 0.0, 0.3), min_steps=2, **margins)
    bench.advance(PERIOD_S)
    bench.see(bench.base + [0.04, 0.02, 0.0])  # Feet and all: the posture has not changed.
    settled(bench)
    stance = bench.get("stance_pose")
    np.testing.assert_allclose(stance, [0.54, 0.02, 0.3], atol=5e-3)
    fitted = fit_stance(bench.feet_now(), bench.kinematics.nominal_contacts)
    np.testing.assert_allclose(stance, fitted, atol=1e-9)


def test_the_base_returns_to_the_nominal_set_point_without_a_jump_and_the_feet_stand():
    bench = Stepping()
    goal = bench.base + [0.05, 0.0, 0.0]
    bench.fix(nominal_desired_output=goal)
    previous, largest = bench.base, 0.0
    for _ in range(100):
        bench.advance(PERIOD_S)
        if bench.context.get_time() > 3 * PERIOD_S:
            largest = max(largest, np.abs(bench.get("desired_output") - previous).max())
        previous = bench.get("desired_output")
    # A minimum-jerk motion's top speed is 15/8 of its mean.
    bound = 15 / 8 * 0.05 / bench.parameters.return_duration_s * PERIOD_S
    assert largest <= 1.05 * bound
    np.testing.assert_allclose(settled(bench).get("desired_output"), goal, atol=1e-9)
    np.testing.assert_allclose(bench.feet_now()[:, 2], bench.kinematics.foot_radii, atol=1e-9)
