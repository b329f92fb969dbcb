import numpy as np
import pytest
import yaml
from pydrake.systems.analysis import Simulator

from drake_safety import load_scenario
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import stance_state
from drake_safety.learning.segments import RECORDED
from drake_safety.plants.obstacles import Obstacle
from drake_safety.simulation.rollouts import episode_rng
from legged_robots import edited, write_biped, write_hexapod, write_porter
from reaching_loops import (
    EASY,
    LOOPS,
    SCENES,
    easy_episode,
    evaluated,
    goal_of,
    porter,
    porter_path,
    porting,
    positions,
    started,
)


@pytest.fixture(params=LOOPS)
def make_loop(request):
    """How to make loops of either robot, without noise."""
    return LOOPS[request.param]


def test_ports_tell_of_the_plant(make_loop):
    loop = make_loop()
    simulator = Simulator(loop, started(loop))
    simulator.AdvanceTo(0.3)
    context = simulator.get_context()
    q, v = np.split(evaluated(loop, context, "plant_state"), [loop.kinematics.num_positions])
    hand = loop.robot.reaching_frame(loop.hand)
    assert np.abs(v).max() > 0.01
    for name, expected in {
        "true_state": stance_state(loop.kinematics, q, v),
        "state": stance_state(loop.kinematics, q, v),
        "output": loop.kinematics.reaching_position(q, hand),
        "safe": [1.0],
        "solver_status": [0.0],
    }.items():
        np.testing.assert_array_equal(evaluated(loop, context, name), expected)
    # Margins are held from one look at them to the next.
    margins = loop.safe_set.margins(q, v)
    np.testing.assert_allclose(evaluated(loop, context, "margins"), margins, atol=0.02)


@pytest.mark.parametrize("variation", ["nominal", "noisy"])
def test_what_is_asked_at_plan_time_is_what_an_episode_begins_with(variation):
    loop = porter(variation)
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(0, 0), EASY)
    episode = easy_episode(variation)
    for name in RECORDED[:-1]:
        np.testing.assert_array_equal(evaluated(loop, context, name), getattr(episode, name)[0])


def test_starts_stand_safely_within_the_ranges_of_the_scenario(make_loop):
    loop = make_loop()
    kinematics, sampling = loop.kinematics, loop.scenario.parameters.start
    standing = kinematics.standing_positions()
    legs = {name for foot in loop.robot.feet.values() for name in foot.joints}
    is_free = np.array([name not in legs for name in kinematics.joint_names])
    standing[6] -= sampling.sink_m
    contacts = kinematics.contact_positions(standing)
    seen = []
    for seed in range(25):
        context = started(loop, seed)
        q, v = np.split(evaluated(loop, context, "plant_state"), [kinematics.num_positions])
        assert not v.any()
        margins = loop.safe_set.margins(q, v)
        assert margins.min() > 0
        assert margins[loop.constraint_names.index("collision")] >= sampling.clearance_m
        np.testing.assert_allclose(kinematics.contact_positions(q), contacts, atol=3e-4)
        offset = q[4:7] - standing[4:7]
        assert (np.abs(offset[:2]) <= sampling.base_offset_m).all()
        assert -sampling.base_lowering_m <= offset[2] <= 0
        turn = np.abs(q[7:] - kinematics.posture)[is_free]
        assert turn.max() <= sampling.joint_offset_rad + 1e-12
        seen.append(np.concatenate([offset, q[7:][is_free]]))
    assert (np.ptp(seen, axis=0) > 0).all()


def test_targets_are_drawn_from_the_box_of_the_hand(make_loop):
    left, right = make_loop(), make_loop(hand="right")
    mirrored = np.sort(left.target_box * [1, -1, 1], axis=0)
    np.testing.assert_array_equal(right.target_box, mirrored)
    for loop in (left, right):
        goals = np.array([goal_of(loop, started(loop, seed)) for seed in range(40)])
        lowest, highest = loop.target_box
        assert ((goals >= lowest) & (goals <= highest)).all()
        assert (np.ptp(goals, axis=0) > 0.8 * (highest - lowest)).all()


def test_a_goal_takes_the_place_of_the_drawn_target_and_of_nothing_else():
    loop = porter("noisy")
    drawn, given = started(loop, 2), started(loop, 2, EASY)
    np.testing.assert_allclose(goal_of(loop, given), EASY, atol=1e-12)
    assert not np.allclose(goal_of(loop, drawn), EASY, atol=1e-3)
    for name in ("plant_state", "state", "output"):
        np.testing.assert_array_equal(evaluated(loop, given, name), evaluated(loop, drawn, name))


def test_the_plan_leads_from_the_hand_at_rest_to_the_goal_at_rest(make_loop):
    loop = make_loop()
    duration_s = loop.scenario.parameters.plan_duration_s
    context = started(loop, 1)
    start = loop.safe_set.model.reaching_position(positions(loop, context))
    np.testing.assert_allclose(evaluated(loop, context, "desired_output"), start, atol=1e-9)
    rows = []
    for time in (1e-4, duration_s - 1e-4, duration_s):
        context.SetTime(time)
        rows.append(evaluated(loop, context, "desired_output").copy())
    goal = goal_of(loop, context)
    np.testing.assert_allclose(rows[0], start, atol=1e-9)
    np.testing.assert_allclose(rows[1], goal, atol=1e-9)
    np.testing.assert_allclose(rows[2], goal, atol=1e-9)


@pytest.mark.parametrize("goal", [[0.3, np.nan, 0.6], [np.inf, 0, 0], [0.3, 0.2], 0.3])
def test_a_goal_that_is_not_three_finite_numbers_is_refused(goal):
    loop = porter()
    message = "reaching: a target is three finite numbers"
    with pytest.raises(ValueError, match=message):
        loop.reset(loop.CreateDefaultContext(), np.random.default_rng(0), goal)
    with pytest.raises(ValueError, match=message):
        loop.reset_standing(loop.CreateDefaultContext(), goal)


def test_a_standing_start_is_the_posture_of_the_robot_and_always_the_same():
    loop = porter("noisy")
    rows = []
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    for _ in range(2):
        loop.reset_standing(context, EASY)
        q = positions(loop, context)
        np.testing.assert_array_equal(q, loop.kinematics.standing_positions())
        simulator.Initialize()
        simulator.AdvanceTo(0.05)
        rows.append(evaluated(loop, context, "state").copy())
        loop.reset(context, np.random.default_rng(0))  # Another episode in between.
        simulator.Initialize()
        simulator.AdvanceTo(0.02)
    np.testing.assert_array_equal(rows[0], rows[1])


def test_starts_that_cannot_be_safe_are_given_up():
    scenario = load_scenario(porter_path())
    scenario.parameters.safe_set.joint_margin_rad = 1.0
    loop = scenario.make_loop()
    with pytest.raises(RuntimeError, match="random postures of robot 'porter' is in the safe set"):
        loop.reset(loop.CreateDefaultContext(), np.random.default_rng(0))


def test_the_same_generator_draws_the_mirror_image_for_the_other_hand(make_loop):
    left, right = make_loop(), make_loop(hand="right")
    assert left.mirror is None
    mirror = Mirror(left.kinematics)
    for seed in range(5):
        one, other = started(left, seed), started(right, seed)
        q, v = np.split(evaluated(left, one, "plant_state"), [left.kinematics.num_positions])
        expected = np.concatenate(mirror.plant_state(q, v, np.zeros(3)))
        found = evaluated(right, other, "plant_state")
        np.testing.assert_allclose(found, expected, atol=1e-12)
        np.testing.assert_allclose(
            goal_of(right, other), mirror.points(goal_of(left, one)), atol=1e-9
        )


def test_the_assessor_sees_the_other_hand_as_the_trained_one_in_the_mirror(make_loop):
    left, right = make_loop(), make_loop(hand="right")
    # The torso that Atlas was published with is not quite symmetric: its centre of mass lies some
    # millimetres to one side, and a far reach ends some hundredths of a radian otherwise.
    atol = 0.03 if left.robot.name == "atlas" else 1e-6
    for name in ("state_names", "output_names", "feature_names", "constraint_names"):
        assert getattr(left, name) == getattr(right, name)
    compared = 0
    for seed in range(8):
        one, other = started(left, seed), started(right, seed)
        for name in ("state", "true_state", "desired_preview"):
            expected = evaluated(left, one, name)
            np.testing.assert_allclose(evaluated(right, other, name), expected, atol=1e-9)
        expected = evaluated(left, one, "features")
        # A hand that never gets there is previewed on its way, wherever it then is.
        if expected[left.feature_names.index("preview_last_miss")] < 0.015:
            compared += 1
            np.testing.assert_allclose(evaluated(right, other, "features"), expected, atol=atol)
        for name in ("output", "desired_output"):
            expected = evaluated(left, one, name) * [1, -1, 1]
            np.testing.assert_allclose(evaluated(right, other, name), expected, atol=1e-9)
    assert compared >= 3


def test_the_mirror_image_moves_as_the_mirrored_robot():
    left, right = easy_episode(), easy_episode(hand="right")
    assert (left.cause, left.num_steps) == (right.cause, right.num_steps)
    np.testing.assert_allclose(right.state, left.state, atol=1e-3)
    np.testing.assert_allclose(right.features, left.features, atol=1e-3)
    np.testing.assert_allclose(right.output, left.output * [1, -1, 1], atol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hand": "tail"}, r"'porter' has no reaching frame 'tail'; it has \['head', 'left', 'r"),
        ({"hand": "head"}, "are 'left' of robot 'porter' and its mirror image 'right'; got"),
    ],
)
def test_a_hand_that_is_neither_the_trained_one_nor_its_image_is_refused(
    tmp_path, options, message
):
    path = porting(tmp_path, parameters={"hand": "left"})
    frames = yaml.safe_load((tmp_path / "robot.yaml").read_text())["reaching_frames"]
    edited(tmp_path / "robot.yaml", reaching_frames=frames | {"head": {"body": "pelvis"}})
    with pytest.raises(ValueError, match=message):
        load_scenario(path).make_loop(**options)


def test_the_scenario_says_which_hand_is_trained(tmp_path):
    scenario = load_scenario(porting(tmp_path, parameters={"hand": "right"}))
    right, left = scenario.make_loop(), scenario.make_loop(hand="left")
    assert (right.hand, left.hand) == ("right", "left")
    assert right.mirror is None
    assert left.mirror is not None
    np.testing.assert_array_equal(right.target_box, scenario.parameters.target.box)


def test_a_robot_without_a_mirror_has_one_hand_to_reach_with(tmp_path):
    path = porting(tmp_path)
    edited(tmp_path / "robot.yaml", mirror={})
    scenario = load_scenario(path)
    assert scenario.make_loop().hand == "left"
    with pytest.raises(ValueError, match=r"mirror pairs joint .* which is not its reflection"):
        scenario.make_loop(hand="right")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (write_hexapod, "robot 'hexapod' has no reaching frames, so it cannot reach"),
        (write_biped, "'biped': no body moved by joints of its reaching frames"),
        (
            lambda folder: edited(write_porter(folder), feet={}, mirror={}),
            "robot 'porter' has no feet to stand on",
        ),
    ],
    ids=["no hands", "no arm", "no feet"],
)
def test_a_robot_that_cannot_reach_is_refused(tmp_path, write, message):
    path = porting(tmp_path, write)
    with pytest.raises(ValueError, match=message):
        load_scenario(path).make_loop()


def test_a_decoration_that_can_be_touched_is_refused():
    scenario = load_scenario(porter_path())
    scenario.parameters.decorations = [Obstacle(model=f"{SCENES}/bookshelf.urdf")]
    with pytest.raises(ValueError, match=r"decoration '.*bookshelf.urdf' has collision geometry"):
        scenario.make_loop()
