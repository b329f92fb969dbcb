import numpy as np
import pytest

from drake_safety.learning.innovation import KINDS, Innovation, describe
from drake_safety.learning.novelty import Novelty

STEP_S, NUM_STATES, STEPS = 0.05, 4, 40
FROZEN, DISTANCE, SCATTER, FAST, SLOW = range(5)  # Columns of the levels.
A = np.array([[1, 0, 0.05, 0], [0, 1, 0, 0.05], [-0.3, 0, 0.9, 0.02], [0, -0.3, 0.02, 0.9]])


def motions(num, seed, *, force=(0.0, 0.0), plant=A, noise=0.002):
    """Two masses on springs that follow goals; x is their state and the goals."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(num):
        s, goal = rng.normal(scale=0.1, size=NUM_STATES), rng.normal(scale=0.1, size=2)
        rows = []
        for _ in range(STEPS):
            rows.append(np.concatenate([s + rng.normal(scale=noise, size=NUM_STATES), goal]))
            s = plant @ s + np.concatenate([np.zeros(2), 0.3 * goal + np.array(force)])
            s += rng.normal(scale=0.001, size=NUM_STATES)
        found.append(np.array(rows))
    return found


@pytest.fixture(scope="module")
def novelty():
    x = np.concatenate(motions(200, 0))
    episode = np.repeat(np.arange(200), STEPS)
    return Novelty.fit(x, episode, np.zeros(len(x), dtype=bool), rate=0.01, plan=slice(0))


@pytest.fixture(scope="module")
def innovation(novelty):
    return Innovation.fit(motions(400, 1), NUM_STATES, STEP_S, novelty)


def levels(innovation, novelty, x):
    return innovation.levels(x, [novelty.of(one) for one in x])


@pytest.mark.train
def test_hours_of_the_same_plant_raise_no_alarm(innovation, novelty):
    x = motions(5400, 2)  # Three hours.
    assert levels(innovation, novelty, x).max() < 1.0


@pytest.mark.train
@pytest.mark.parametrize(
    ("change", "within_s"),
    [
        ({"force": (0.002, 0.0)}, 10.0),
        ({"force": (0.0, -0.01)}, 2.0),
        ({"plant": A - 0.05 * np.eye(4)[[0, 1, 3, 2]] * [0, 0, 1, 1]}, 10.0),
        ({"noise": 0.02}, 2.0),
    ],
)
def test_a_changed_plant_is_noticed_though_no_input_is_novel(innovation, novelty, change, within_s):
    x = motions(20, 3, **change)
    found = levels(innovation, novelty, x).max(axis=1) > 1.0
    assert found.any()
    assert (np.argmax(found) + 1) * STEP_S <= within_s


@pytest.mark.train
def test_one_impact_is_no_lasting_change(innovation, novelty):
    x = motions(20, 4)
    x[10][20, 2] += 5.0
    assert levels(innovation, novelty, x)[:, [FAST, SLOW]].max() < 1.0


@pytest.mark.train
def test_a_frozen_input_is_noticed_after_few_repeats(innovation, novelty):
    x = motions(3, 5)
    x[1][5:] = x[1][5]
    found = levels(innovation, novelty, x)[:, FROZEN] > 1.0
    assert 5 < np.argmax(found) - STEPS <= 5 + innovation.longest_repeat + 1


@pytest.mark.train
def test_inputs_far_from_training_add_up(innovation, novelty):
    x = [3.0 * one for one in motions(20, 6)]
    assert levels(innovation, novelty, x)[:, DISTANCE].max() > 1.0


@pytest.mark.train
def test_the_cause_names_the_state_that_is_pushed(innovation):
    x = motions(20, 7, force=(0.0, -0.02))
    errors = np.concatenate([innovation.of(one[:-1], one[1:, :NUM_STATES]) for one in x])
    deviations = innovation.deviations("slow", errors[-80:].mean(axis=0))
    assert np.argmax(np.abs(deviations)) in (1, 3)
    assert deviations[3] < 0.0


@pytest.mark.parametrize(
    ("names", "deviations", "said"),
    [
        (["base_x", "velocity_y"], [1.0, 7.0], "pushed steadily to the left (velocity_y +7"),
        (["base_x", "velocity_y"], [-9.0, 7.0], "pushed steadily backward (base_x -9"),
        (["knee", "knee_rate"], [1.0, -7.0], "joint knee answers unlike the learned one"),
        (["angle", "speed"], [1.0, -7.0], "speed changes unlike what was learned"),
    ],
)
def test_an_alarm_says_what_it_saw(names, deviations, said):
    assert describe("slow", np.array(deviations), names).startswith(said)
    others = [describe(kind, np.zeros(1), ["a"]) for kind in KINDS[:4]]
    assert others[:3] == ["", "input frozen", "inputs unlike those of training"]
    assert others[3].startswith("inputs noisier")


@pytest.mark.train
def test_what_an_actual_robot_does_is_no_alarm_after_feedback(innovation, novelty):
    change = {"force": (0.01, 0.0)}
    adapted_novelty = novelty.with_feedback(np.concatenate(motions(60, 8, **change)), 0.01)
    adapted = innovation.with_feedback(motions(60, 8, **change), adapted_novelty)
    x = motions(300, 9, **change)
    assert levels(innovation, novelty, x).max() > 1.0
    assert levels(adapted, adapted_novelty, x).max() < 1.0
    # It still notices another change, and the nominal plant.
    other = motions(40, 10, force=(0.0, 0.02))
    assert levels(adapted, adapted_novelty, other).max() > 1.0


@pytest.mark.train
def test_too_little_motion_gives_no_alarm(novelty):
    innovation = Innovation.fit(motions(1, 11)[0:1], NUM_STATES, STEP_S, novelty)
    assert np.all(np.isinf(innovation.chart_limits))
    with pytest.raises(ValueError, match="no motion has two inputs"):
        Innovation.fit([np.zeros((1, 6))], NUM_STATES, STEP_S, novelty)


@pytest.mark.train
@pytest.mark.parametrize("name", ["offset", "chart_whitenings", "layer.1.bias"])
def test_damaged_arrays_are_refused(innovation, name):
    arrays = innovation.arrays()
    with pytest.raises(ValueError, match=name):
        Innovation.from_arrays(
            arrays | {name: arrays[name][..., :-1]}, num_inputs=6, num_states=NUM_STATES
        )
