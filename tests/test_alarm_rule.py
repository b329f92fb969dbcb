"""When an alarm begins and ends, and what a run prints and draws of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.cli.run import event_rows, reason_events
from drake_safety.learning.change_detector import RECOVERED_LEVEL, RECOVERY_S
from drake_safety.simulation.motion import Motion
from sprung_motions import INFO, STEP_S, learned, motion

pytestmark = pytest.mark.train


def test_an_alarm_ends_after_five_seconds_of_low_levels():
    rows = motion(30.0, 50, slice(100, 140))
    levels, (alarm,) = learned().watch([rows], INFO.state_names)
    largest = levels.max(axis=1)
    size = round(RECOVERY_S / STEP_S)
    assert alarm.begin == int(np.argmax(largest > 1.0))
    calm = np.lib.stride_tricks.sliding_window_view(largest, size).max(axis=1) < RECOVERED_LEVEL
    assert alarm.end == np.flatnonzero(calm[alarm.begin + 1 :])[0] + alarm.begin + size


def test_the_events_of_a_run_have_begin_and_end_of_every_alarm():
    time_s = 0.02 * np.arange(50)
    alarm = np.zeros((50, 1))
    alarm[10:20] = alarm[40:] = 1.0
    cause = np.full(50, "", dtype=object)
    cause[10:20], cause[40:] = "inputs frozen", "pushed steadily down"
    ports = {"safety_probability": np.ones((50, 1)), "alarm": alarm, "alarm_cause": cause}

    def rows(events, given, calibrations):
        gamma = SimpleNamespace(calibrations_=calibrations)
        return event_rows(events, Motion(time_s=time_s, ports=given), gamma)

    assert rows([(0.5, "ball")], ports, {}) == [
        ("0.20", "monitor: inputs frozen", "1.00"),
        ("0.40", "monitor: the alarm ends", "1.00"),
        ("0.50", "ball", "1.00"),
        ("0.80", "monitor: pushed steadily down", "1.00"),
    ]
    promised = rows([], ports, {"plan": None})
    assert promised[0][1] == "monitor: inputs frozen. The promise is withdrawn"
    assert rows([], {"safety_probability": alarm}, {}) == []


SAFE, UNSAFE, UNKNOWN = [0.7, 0.0, 0.3], [0.1, 0.6, 0.3], [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("happens", "alarm", "belief", "without_alarm", "reason"),
    [
        ("", 0, UNSAFE, UNSAFE, "probability 0.030 < 0.06; likely cause: height, -2.0 cm"),
        ("", 0, UNKNOWN, UNKNOWN, "don't know: unlike training"),
        ("", 1, UNKNOWN, SAFE, "don't know: monitor's alarm since 0.10 s"),
        ("steps: ", 1, UNKNOWN, UNSAFE, "probability 0.030 < 0.06; likely cause: height, -2.0 cm"),
    ],
)
def test_an_event_names_the_reason_of_a_low_probability(
    happens, alarm, belief, without_alarm, reason
):
    rows = {"belief": belief, "belief_without_alarm": without_alarm, "alarm": [alarm]}
    rows |= {"safety_probability": [0.03], "probability_without_alarm": [0.03]}
    rows |= {"cause_probability": [0.6], "predicted_margins": [-0.02]}
    ports = {name: np.tile(np.asarray(row, dtype=float), (20, 1)) for name, row in rows.items()}
    ports["alarm"][:5] = 0.0
    parameters = SimpleNamespace(initial_uncertainty=0.3, margin_unit=1.0)
    names = {"constraint_names": ["height"], "angular_constraints": ()}
    loop = SimpleNamespace(**names, assessment=SimpleNamespace(parameters=parameters))
    motion = Motion(time_s=0.02 * np.arange(20), ports=ports)
    assert reason_events(loop, motion, [0.2], 0.06, happens) == [(0.2, happens + reason)]
