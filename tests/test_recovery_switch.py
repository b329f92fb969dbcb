import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.systems.recovery_switch import RecoverySwitch
from legged_robots import robot_kinematics
from system_doubles import Bench

PERIOD_S, OFFSET_S, HORIZON = 0.01, 0.0005, 3
PREVIEW = np.arange(9.0)
OUTLOOK = np.arange(6.0)


class Standing(Bench):
    """The block alone, seeing a robot that stands still."""

    def __init__(self):
        self.kinematics = k = robot_kinematics("laikago")
        self.parameters = RecoveryStepParameters(settle_margin_m=0.01, resume_margin_m=0.0)
        options = {"period_s": PERIOD_S, "offset_s": OFFSET_S, "horizon": HORIZON, "num_outlook": 2}
        super().__init__(RecoverySwitch(k, self.parameters, threshold=0.6, **options))
        base = np.append(k.nominal_base_offset, k.standing_height)
        self.nominal = base + [0.02, 0.01, 0.0]
        self.feet = np.column_stack([k.nominal_contacts, k.foot_radii])
        q = k.positions_at(RigidTransform(base), k.posture)
        self.fix(
            plant_state=np.append(q, np.zeros(k.num_velocities)),
            nominal_desired_output=self.nominal,
            nominal_desired_preview=PREVIEW,
            nominal_desired_outlook=OUTLOOK,
            safety_probability=1.0,
        )

    def assert_nominal(self):
        assert self.get("recovery_active")[0] == 0
        nominal = {"output": self.nominal, "preview": PREVIEW, "outlook": OUTLOOK}
        for name, expected in nominal.items():
            np.testing.assert_array_equal(self.get(f"desired_{name}"), expected)

    def recovery_duration_s(self):
        steps = 20 * self.parameters.step_duration_s
        return steps + self.parameters.return_duration_s + 0.2


def test_the_step_planner_ticks_behind_the_trigger_in_the_same_period():
    bench = Standing()
    bench.advance(0.1 + 0.5 * PERIOD_S)
    bench.fix(safety_probability=0.3)
    bench.simulator.AdvanceTo(0.11 + OFFSET_S + 1e-6)
    assert bench.get("recovery_active")[0] == 1
    before = bench.get("desired_output")
    bench.simulator.AdvanceTo(0.11 + 2 * OFFSET_S + 1e-6)
    expected = [*bench.kinematics.nominal_base_offset, bench.kinematics.standing_height]
    np.testing.assert_allclose(bench.get("desired_output"), expected, atol=1e-9)
    # Until the step planner has planned, the set point is the nominal one, held.
    np.testing.assert_allclose(before, bench.nominal, atol=1e-9)


def test_each_recovery_ends_with_the_nominal_plan_passing_through_again():
    bench = Standing()
    for _ in range(2):
        bench.fix(safety_probability=0.3)
        bench.advance(3 * PERIOD_S)
        bench.fix(safety_probability=1.0)
        bench.advance(3 * PERIOD_S)
        assert bench.get("recovery_active")[0] == 1  # It latches.
        outlook, preview = bench.get("desired_outlook"), bench.get("desired_preview")
        np.testing.assert_array_equal(outlook, preview[:6])
        assert not np.array_equal(outlook, OUTLOOK)
        bench.advance(bench.recovery_duration_s())
        bench.assert_nominal()
