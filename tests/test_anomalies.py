"""The study of anomalies after RAPT: injections, judgement, and the monitors beside ours."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety import load_scenario
from drake_safety.simulation.rollouts import run_motion, worker_loop
from studies import gru_monitor, injections
from studies.anomalies import Monitor, Watched, judged, learned_monitors, with_faults
from studies.gru_monitor import GruMonitor
from studies.injections import (
    PLANTS,
    SENSORS,
    Change,
    changed_episode,
    drawn_change,
    drawn_fault,
    faulty,
    kind_of,
)

STEP_S, ONSET = 0.02, 3
ROWS = np.arange(24.0).reshape(8, 3) + 1.0
SCENARIO = "go2_walking"


def with_fault(kind, value=0.0, columns=(0, 2), rng=None):
    before = ROWS.copy()
    seen = faulty(ROWS, kind, columns, value, ONSET, STEP_S, rng)
    np.testing.assert_array_equal(ROWS, before)
    np.testing.assert_array_equal(seen[:ONSET], ROWS[:ONSET])
    others = [i for i in range(3) if i not in columns]
    np.testing.assert_array_equal(seen[:, others], ROWS[:, others])
    return seen[ONSET:, columns]


def test_a_fault_changes_some_columns_from_its_onset_on():
    nominal = ROWS[ONSET:, [0, 2]]
    np.testing.assert_array_equal(with_fault("zeroed", 0.0), 0.0 * nominal)
    np.testing.assert_array_equal(with_fault("halved", 0.5), 0.5 * nominal)
    np.testing.assert_array_equal(with_fault("doubled", 2.0), 2.0 * nominal)
    np.testing.assert_array_equal(with_fault("swapped_sensors"), nominal[:, ::-1])
    np.testing.assert_array_equal(with_fault("frozen"), np.tile(nominal[0], (5, 1)))
    drift = -0.5 * STEP_S * np.arange(5)[:, None]
    np.testing.assert_allclose(with_fault("drift", -0.5), nominal + drift)
    # Late and slow sensors show earlier rows.
    np.testing.assert_array_equal(with_fault("delay", 0.04), ROWS[1:6, [0, 2]])
    np.testing.assert_array_equal(with_fault("delay", 0.021), ROWS[2:7, [0, 2]])
    np.testing.assert_array_equal(with_fault("slow", 0.04), ROWS[[3, 3, 5, 5, 7]][:, [0, 2]])
    noise = with_fault("noise", 0.1, rng=np.random.default_rng(0)) - nominal
    assert np.abs(noise).max() <= 0.1 and len(np.unique(noise)) == 10
    # Two pairs are swapped each.
    seen = faulty(
        np.arange(8.0).reshape(2, 4), "swapped_sensors", [3, 0, 1, 2], 0.0, 1, STEP_S, None
    )
    np.testing.assert_array_equal(seen[1], [7.0, 6.0, 5.0, 4.0])


def test_drawn_faults_are_within_the_ranges():
    for kind, (most, low, high) in SENSORS.items():
        drawn = [drawn_fault(kind, 33, np.random.default_rng(seed)) for seed in range(100)]
        counts = {len(which) for which, _ in drawn}
        values = np.array([value for _, value in drawn])
        assert counts == set(range(2, most + 1, 2) if "swapped" in kind else range(1, most + 1))
        assert all(len(set(which.tolist())) == len(which) for which, _ in drawn)
        assert low <= np.abs(values).min() and np.abs(values).max() <= high
        assert (values.min() < 0.0) == (kind == "drift")


def column_monitor(limit=math.nan):
    """Its levels are the first columns of the rows."""
    return Monitor("column", ["hip", "knee_rate"], lambda rows: rows[:, :2], limit)


def constant(kind, group, *columns, onset=0, truth=()):
    return Watched(kind, group, np.array(columns, dtype=float).T, onset, frozenset(truth))


def test_areas_shares_delays_and_names_of_episodes():
    calibration = [np.full((4, 2), 0.01 * i) for i in range(200)]  # One of them is above 1.98.
    unperturbed = [constant("unperturbed", i, [0, level], [0, 0]) for i, level in enumerate((1, 3))]
    found = judged(
        column_monitor(limit=2.5),
        calibration,
        [
            *unperturbed,
            # Found two rows after the onset, by the joint's rate; what precedes it does not count.
            constant("zeroed", 2, [9, 0, 0, 0], [0, 0, 0, 2], onset=1, truth=["knee"]),
            constant("zeroed", 3, [0, 0, 1.5, 0], [0, 0, 0, 0], onset=1, truth=["hip"]),
            constant("friction", 4, [0, 4, 0, 0], [0, 0, 0, 0], onset=1),
        ],
        STEP_S,
    )
    values = {
        f"{kind}.{metric}": estimate.value
        for kind, estimates in found.items()
        for metric, estimate in estimates.items()
    }
    assert values == pytest.approx(
        {
            # Levels 2 and 1.5 against 1 and 3; 4 is above both.
            "zeroed.auc": 0.5,
            "friction.auc": 1.0,
            "pooled.auc": 4 / 6,
            "zeroed.detected": 1 / 2,
            "friction.detected": 1.0,
            "pooled.detected": 2 / 3,
            "unperturbed.detected": 1 / 2,
            "zeroed.delay_s": 2 * STEP_S,
            "friction.delay_s": 0.0,
            "pooled.delay_s": STEP_S,
            "zeroed.named": 1.0,
            "pooled.named": 1.0,
            "zeroed.alarmed": 0.0,
            "friction.alarmed": 1.0,
            "pooled.alarmed": 1 / 3,
            "unperturbed.alarmed": 1 / 2,
        }
    )
    assert found["pooled"]["auc"].n == 5
    nameless = Monitor("nameless", [""], lambda rows: rows[:, :1])
    one = constant("drift", 9, [0, 9], [0, 0], truth=["hip"])
    plain = judged(nameless, calibration, [*unperturbed, one], STEP_S)["drift"]
    assert plain["detected"].value == 1.0 and not {"alarmed", "named"} & set(plain)


def test_a_wrong_name_is_none_and_episodes_of_one_recording_are_one_sample():
    episodes = [
        constant("unperturbed", 0, [0, 0], [0, 0]),
        constant("zeroed", 0, [5, 5], [0, 0], truth=["knee"]),
        constant("drift", 0, [5, 5], [0, 0], truth=["hip"]),
    ]
    found = judged(column_monitor(), [np.zeros((2, 2))], episodes, STEP_S)
    assert found["zeroed"]["named"].value == 0.0 and found["drift"]["named"].value == 1.0
    assert found["pooled"]["detected"].n == 1


def test_faults_are_of_recordings_in_turn_and_known_by_name():
    detector = SimpleNamespace(step_s=STEP_S, watched=np.array([2, 0]))
    rng = np.random.default_rng(0)
    calm = [Watched("unperturbed", 7 + i, rng.normal(size=(80, 3))) for i in range(3)]
    seen = with_faults(calm, 2, 5, detector, ["knee", "hip"])
    assert [one.kind for one in seen] == [kind for kind in SENSORS for _ in range(2)]
    assert [one.group for one in seen[:4]] == [7, 8, 9, 7]
    for one in seen:
        changed = one.rows != calm[one.group - 7].rows
        assert not changed[:50].any() and one.onset == 50
        columns = {("knee", "hip")[[2, 0].index(i)] for i in np.flatnonzero(changed.any(axis=0))}
        assert columns == one.truth


@pytest.fixture(scope="module")
def loop():
    return worker_loop(load_scenario(SCENARIO))()


def drawn(loop, kind, turn):
    index = len(PLANTS) * turn + list(PLANTS).index(kind)
    assert kind_of(index) == kind
    return drawn_change(loop, 11, index)


def test_alternatives_of_a_changed_plant_come_in_turn(loop):
    torque, stiffness, damping, dead = (drawn(loop, "actuators", turn) for turn in range(4))
    for change in (torque, stiffness, damping, dead):
        assert change.joints == set(change.variation.shift.joints)
        assert 1 <= len(change.joints) <= 5
    for joint in torque.variation.shift.joints.values():
        assert 0.4 <= joint.effort_scale <= 0.8 and joint.stiffness_scale == 1.0
    for joint in stiffness.variation.shift.joints.values():
        assert joint.stiffness_scale * joint.damping_scale == pytest.approx(1.0)
    scales = [joint.damping_scale for joint in damping.variation.shift.joints.values()]
    assert all(0.1 <= one <= 0.5 or 1.1 <= one <= 1.5 for one in scales)
    assert all(one.effort_scale < 1e-3 for one in dead.variation.shift.joints.values())
    faults = drawn(loop, "swapped_commands", 0).variation.shift.command_faults
    assert {fault.kind for fault in faults} == {"swap"} and len(faults) in (2, 4)
    friction = [drawn(loop, "friction", turn).variation.foot_friction for turn in range(2)]
    assert friction == pytest.approx(
        [0.6 * loop.robot.foot_friction, 1.4 * loop.robot.foot_friction]
    )
    payload = drawn(loop, "push_or_payload", 1).variation.payload
    assert payload.mass_kg == pytest.approx(0.3 * loop.kinematics.total_mass)


def test_states_change_as_stated_and_no_foot_is_in_the_ground(loop):
    start = loop.settled_start()
    pushed = drawn(loop, "push_or_payload", 0).start(start)
    assert 0.05 <= np.linalg.norm(pushed.v[3:5] - start.v[3:5]) <= 0.4
    np.testing.assert_array_equal(pushed.q, start.q)
    rates, raised, tilted = (drawn(loop, "state", turn).start(start) for turn in range(3))
    change = np.abs(rates.v - start.v)
    assert change[:6].max() == 0.0 and 0.2 < change[6:].max() <= 0.5
    rise = (raised.q - start.q)[6] / loop.kinematics.standing_height
    assert 0.13 <= rise <= 0.63
    heights = loop.kinematics.contact_positions(tilted.q)[:, 2] - loop.kinematics.foot_radii
    assert np.linalg.norm(tilted.q[:4]) == pytest.approx(1.0) and heights.min() > -1e-3
    assert np.abs(tilted.q[:4] - start.q[:4]).max() > 0.01


def test_a_motion_that_goes_on_as_the_same_plant_is_the_same(loop, monkeypatch):
    monkeypatch.setattr(injections, "EPISODE_S", 1.6)
    plain = run_motion(loop, 3, seed=5, until_s=1.6)
    joined = changed_episode(loop, loop, Change(), 5, 3)
    np.testing.assert_allclose(joined.time_s, plain.time_s, atol=1e-9)
    np.testing.assert_allclose(joined.true_state, plain.true_state, atol=1e-8)
    np.testing.assert_allclose(joined.desired_preview, plain.desired_preview, atol=1e-9)
    pushed = changed_episode(loop, loop, drawn(loop, "push_or_payload", 0), 5, 3)
    np.testing.assert_array_equal(pushed.true_state[:50], joined.true_state[:50])
    assert np.abs(pushed.true_state[50] - joined.true_state[50]).max() > 0.01


def oscillations(num, seed, rows=400):
    """A driven oscillator (position, velocity, drive) with noise, (rows, 3) each."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(num):
        x, drive = np.zeros(2), np.repeat(rng.normal(size=rows // 20), 20)
        seen = np.empty((rows, 3))
        for k in range(rows):
            seen[k] = *x, drive[k]
            x = x + 0.1 * np.array([x[1], drive[k] - x[0] - 0.4 * x[1]])
        seen[:, :2] += 0.01 * rng.normal(size=(rows, 2))
        found.append(seen)
    return found


@pytest.mark.train
def test_the_recurrent_monitor_sees_a_frozen_sensor_that_is_within_its_range(monkeypatch):
    monkeypatch.setattr(gru_monitor, "_HIDDEN", 24)
    gru = GruMonitor(oscillations(30, 0), 2)
    calm = oscillations(10, 1)
    frozen = [faulty(one, "frozen", [0], 0.0, 200, 0.1, np.random.default_rng(0)) for one in calm]
    before, after = (np.array([gru.levels(one).max() for one in x]) for x in (calm, frozen))
    assert gru.levels(calm[0]).shape == (400, 3)
    np.testing.assert_array_equal(gru.levels(calm[0])[0], 0.0)
    assert np.median(after) > 2.0 * before.max()
    assert np.argmax(gru.levels(frozen[0]).max(axis=0)) in (0, 1)
    with pytest.raises(ValueError, match="1 motions have 51 rows; two are needed"):
        GruMonitor(calm[:1], 2)


@pytest.mark.train
def test_the_range_check_is_in_units_of_the_range_and_says_which(monkeypatch):
    monkeypatch.setattr(gru_monitor, "_EPOCHS", 1)
    motions, columns = oscillations(5, 2), np.array([3, 0, 2])
    rows = np.zeros((6, 4))
    low, high = (getattr(np.concatenate(motions), name)(axis=0) for name in ("min", "max"))
    rows[:, columns] = 0.5 * (low + high)
    rows[2, 0] = high[1] + 0.25 * (high - low)[1]
    gru, forest, ranged = learned_monitors(motions, columns, ["position", "velocity"])
    levels = ranged.levels(rows)
    assert levels.max() == pytest.approx(0.25)
    row, column = np.unravel_index(np.argmax(levels), levels.shape)
    assert row == 2 and ranged.names[column] == "velocity"
    assert gru.levels(rows).shape == (6, 3) and gru.limit == 1.0
    scores = forest.levels(rows)
    assert scores.shape == (6, 1) and np.argmax(scores) == 2
