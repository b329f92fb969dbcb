import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety import SafetyAssessment, load_scenario, run_episode, run_episodes
from drake_safety.diagrams.reaching.kinematic_preview import chain_joints
from drake_safety.diagrams.reaching.sampling import PostureSampling
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS
from reaching_loops import (
    EASY,
    atlas,
    easy_episode,
    evaluated,
    porter,
    porter_path,
    positions,
    started,
)


def test_a_robot_of_ones_own_reaches_from_yaml_alone():
    episode = easy_episode()
    assert episode.is_safe
    assert episode.num_controller_failures == 0
    assert np.linalg.norm(episode.output[-1] - EASY) < 0.02
    error = np.linalg.norm(episode.output - episode.desired_output, axis=1)
    assert error.max() < 0.05


def test_a_target_behind_a_board_ends_in_a_collision():
    episode = run_episode(porter(), 0, goal=[0.5, 0.2, 0.475])  # Inside the board below the hand.
    assert not episode.is_safe
    assert episode.cause == "collision"
    assert episode.margins[-1, 1] < 0


@pytest.mark.parametrize("variation", ["heavy", "rough", "noisy"])
def test_reality_gaps_run_and_reach_nearly(variation):
    episode = easy_episode(variation)
    assert episode.cause == ""
    assert np.linalg.norm(episode.output[-1] - EASY) < 0.04
    assert np.abs(episode.true_state - easy_episode().true_state).max() > 1e-5


def test_the_preview_foresees_the_joints_of_an_easy_reach():
    loop, goal = atlas(), np.array([0.65, 0.3, 1.05])
    context = loop.CreateDefaultContext()
    loop.reset_standing(context, goal)
    names = loop.feature_names
    x = dict(zip(names, evaluated(loop, context, "features"), strict=True))
    Simulator(loop, context).AdvanceTo(loop.scenario.episode_duration_s)
    q = positions(loop, context)
    assert np.linalg.norm(loop.safe_set.model.reaching_position(q) - goal) < 0.02
    margins = loop.safe_set.margins(q, np.zeros(loop.kinematics.num_velocities))
    for name, margin in zip(loop.constraint_names[:3], margins, strict=False):
        assert x[f"preview_last_{name}"] == pytest.approx(margin, abs=0.03)
    lowest, highest = loop.kinematics.position_limits.T
    distance = np.minimum(q[7:] - lowest, highest - q[7:])
    chain = chain_joints(loop.kinematics, loop.safe_set.model.hand)
    expected = distance[chain] - loop.scenario.parameters.safe_set.joint_margin_rad
    foreseen = [x[f"preview_last_stop_{i}"] for i in range(len(chain))]
    np.testing.assert_allclose(foreseen, expected, atol=0.05)


def test_an_unsolved_program_shows_in_the_solver_status():
    loop = porter()
    context = started(loop)
    simulator = Simulator(loop, context)
    simulator.AdvanceTo(0.02)
    assert evaluated(loop, context, "solver_status")[0] == 0
    plant_context = loop.plant.GetMyMutableContextFromRoot(context)
    v = np.zeros(loop.plant.num_velocities())
    v[6 : 6 + loop.kinematics.num_joints] = 200.0  # No ankle can stop a foot that spins so fast.
    loop.plant.SetVelocities(plant_context, loop.robot_instance, v)
    simulator.AdvanceTo(0.024)
    assert evaluated(loop, context, "solver_status")[0] != 0
    assert evaluated(loop, context, "num_controller_failures")[0] > 0


def test_an_episode_that_begins_outside_the_safe_set_ends_at_once(monkeypatch):
    loop = porter()
    q = loop.kinematics.standing_positions()
    q[6] += 0.5
    monkeypatch.setattr(PostureSampling, "sample", lambda *arguments: q)
    episode = run_episode(loop, 0)
    assert not episode.is_safe
    assert episode.cause == "support_polygon"
    assert len(episode.time_s) == 1


@pytest.fixture(scope="module")
def assessment():
    scenario = load_scenario(porter_path())
    episodes = run_episodes(scenario, 7, num_workers=1)
    return SafetyAssessment(scenario.assessment).fit(episodes)


@pytest.mark.train
def test_one_assessment_serves_both_hands(assessment):
    probabilities = []
    for hand in ("left", "right"):
        loop = porter(assessment=assessment, hand=hand)
        context = started(loop, 3)
        Simulator(loop, context).Initialize()
        values = {name: evaluated(loop, context, name) for name in ASSESSMENT_PORTS}
        assert all(np.isfinite(value).all() for value in values.values())
        assert values["belief"].sum() == pytest.approx(1.0)
        probabilities.append(values["safety_probability"][0])
    assert probabilities[0] == pytest.approx(probabilities[1], abs=1e-4)


def test_the_hash_follows_what_can_be_touched(tmp_path):
    path = porter_path()
    before = load_scenario(path).simulation_hash()
    scenario = load_scenario(path)
    scenario.parameters.obstacles[0].position[2] += 0.01
    assert scenario.simulation_hash() != before
    shelf = tmp_path / "shelf.urdf"
    own = load_scenario(path)
    own.parameters.obstacles[0].model = str(shelf)
    hashes = set()
    for size in ("0.1", "0.2"):
        shelf.write_text(
            f'<robot name="s"><link name="s"><collision><geometry><box size="{size} 1 1"/>'
            "</geometry></collision></link></robot>"
        )
        hashes.add(own.simulation_hash())
    assert len(hashes) == 2


def test_feet_that_begin_loaded_stay_flat_from_the_first_step():
    loop = atlas()
    fastest = []
    for sink_m in (0.0, loop.scenario.parameters.start.sink_m):
        context = started(loop, 1)
        plant_context = loop.plant.GetMyMutableContextFromRoot(context)
        q = positions(loop, context).copy()
        q[6] += loop.scenario.parameters.start.sink_m - sink_m
        loop.plant.SetPositions(plant_context, loop.robot_instance, q)
        Simulator(loop, context).AdvanceTo(0.002)
        fastest.append(np.abs(loop.plant.GetVelocities(plant_context, loop.robot_instance)).max())
    unloaded, loaded = fastest
    assert unloaded > 10.0  # rad/s, of an ankle.
    assert loaded < 2.0


def test_a_preview_across_the_body_reaches_its_plan():
    loop = atlas()
    miss = loop.feature_names.index("preview_last_miss")
    context = loop.CreateDefaultContext()
    for goal in ([0.47, -0.27, 1.12], [0.49, -0.24, 1.22], [0.54, -0.26, 1.12]):
        loop.reset_standing(context, np.array(goal))
        assert evaluated(loop, context, "features")[miss] < 0.02
