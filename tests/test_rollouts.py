import re
from contextlib import nullcontext

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LinearSystem

from cart_episodes import ARRAYS, assert_identical
from drake_safety import SafetyAssessment, load_scenario, run_episode, run_episodes
from drake_safety.learning.assessment import AssessmentParameters
from drake_safety.learning.segments import DIVERGED, EpisodeError
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.motion import advance_to
from drake_safety.simulation.scenario_check import check_scenario
from toy_tasks import SCENARIO, Mass, gliding, shuttling


def test_a_row_holds_what_the_loops_ports_say():
    episode = run_episode(gliding(speed_m_s=0.5).make_loop(), 3, seed=5)
    np.testing.assert_allclose(episode.time_s, 0.04 * np.arange(21), atol=1e-12)
    assert {len(getattr(episode, name)) for name in ARRAYS} == {21}
    assert (episode.is_safe, episode.cause) == (True, "")
    x, v = episode.state[0]
    np.testing.assert_allclose(episode.state[:, 0], x + v * episode.time_s, atol=0.0101 * abs(v))
    np.testing.assert_array_equal(episode.features[:, 0], 1 - episode.state[:, 0])
    expected = np.stack([1 - episode.state[:, 0], 1 + episode.state[:, 0]], axis=1)
    np.testing.assert_array_equal(episode.margins, expected)


def test_an_unsafe_episode_ends_as_it_leaves_and_names_the_violated_constraint():
    episodes = [run_episode(gliding(speed_m_s=4.0).make_loop(), i) for i in range(20)]
    unsafe = [e for e in episodes if not e.is_safe]
    assert {e.cause for e in unsafe} == {"left", "right"}
    for episode in unsafe:
        violated = ["right", "left"].index(episode.cause)
        assert episode.margins[-1, violated] < 0
        assert episode.margins[-2].min() >= 0
        assert episode.time_s[-1] - episode.time_s[-2] <= 0.04 + 1e-12
        # The state moves up to 0.04 m in a control period: it ends within one of leaving.
        assert episode.margins[-1, violated] > -0.0801


def test_an_episode_until_a_fall_goes_on_outside_the_safe_set_and_only_a_fall_is_unsafe():
    loop = shuttling().make_loop()
    pairs = [(run_episode(loop, i), run_episode(loop, i, until_fall=True)) for i in range(40)]
    assert {one.cause for one, _ in pairs} == {"", "front", "flank"}
    for until_leaving, until_fall in pairs:
        assert until_fall.cause in ("", loop.fall_name)
        num_rows = len(until_leaving.time_s) - (not until_leaving.is_safe)
        np.testing.assert_array_equal(until_fall.state[:num_rows], until_leaving.state[:num_rows])
        fall = until_fall.margins[:, loop.constraint_names.index(loop.fall_name)]
        assert (fall[:-1] >= 0).all() and (fall[-1] < 0) == (not until_fall.is_safe)
    longer_s = [b.time_s[-1] - a.time_s[-1] for a, b in pairs if not a.is_safe]
    assert 0.0 < max(longer_s) < 1.0 + 0.04
    with pytest.raises(ValueError, match="lacks 'CanFall'"):
        run_episode(gliding().make_loop(), until_fall=True)


@pytest.mark.parametrize("num_workers", [1, 2])
def test_an_error_in_somebodys_code_is_not_a_diverged_simulation(num_workers):
    message = r"episode (\d+) of 'gliding' \(seed 3\): RuntimeError: operands"
    with pytest.raises(EpisodeError, match=message) as error:
        run_episodes(gliding(failure="bug"), 20, seed=3, num_workers=num_workers)
    cause = error.value.__cause__
    if num_workers == 1:
        assert isinstance(cause, RuntimeError)
    else:
        assert "toy_tasks.py" in str(cause)
    # And it can be reproduced by what the message says.
    index = int(re.search(message, str(error.value))[1])
    with pytest.raises(EpisodeError):
        run_episode(gliding(failure="bug").make_loop(), index, seed=3)


def test_a_row_is_read_before_the_step_that_begins_at_it_whatever_the_rounding():
    # 3 * 0.1 is more than Drake's 120 * 0.0025: the step that begins there would be taken.
    assert 3 * 0.1 > 120 * 0.0025
    builder = DiagramBuilder()
    A, B, C, D = (np.full((1, 1), entry) for entry in (1.0, 1.0, 1.0, 0.0))
    counter = builder.AddSystem(LinearSystem(A, B, C, D, time_period=0.0025))
    one = builder.AddSystem(ConstantVectorSource([1.0]))
    builder.Connect(one.get_output_port(), counter.get_input_port())
    simulator = Simulator(builder.Build())
    for row in range(1, 200):
        advance_to(simulator, row * 0.1)
        assert simulator.get_context().get_discrete_state_vector()[0] == 40 * row


@pytest.mark.parametrize("failure", ["raise", "1e13"])
def test_a_diverged_simulation_is_recorded_as_such_and_the_run_goes_on(failure):
    episodes = run_episodes(gliding(failure=failure), 20, num_workers=1)
    sound = run_episodes(gliding(), 20, num_workers=1)
    assert len(episodes) == 20
    diverged = [e for e in episodes if e.cause == DIVERGED]
    assert len(diverged) == episodes.num_diverged > 0
    for episode in diverged:
        assert not episode.is_safe
        assert 0 <= episode.first_step < len(episode.time_s)
        arrays = [getattr(episode, name) for name in ARRAYS]
        assert {len(array) for array in arrays} == {len(episode.time_s)}
        assert all((np.abs(array) < 1e12).all() for array in arrays)
    for episode, other in zip(episodes, sound, strict=True):
        reached = (other.true_state[:, 0] > 0.5).any()
        assert (episode.cause == DIVERGED) == reached
        num_rows = len(episode.time_s)
        np.testing.assert_array_equal(episode.state, other.state[:num_rows])
        if reached:
            assert other.state[num_rows, 0] > 0.5


# joblib tells of the tasks that it cancelled, which is what was asked for.
@pytest.mark.train
@pytest.mark.filterwarnings("ignore:.*still being processed by the workers:UserWarning")
@pytest.mark.filterwarnings("ignore:.*have been successfully executed:UserWarning")
@pytest.mark.parametrize("num_workers", [1, 2])
def test_an_interrupted_run_keeps_what_was_finished_and_goes_on_to_the_same_set(
    tmp_path, num_workers
):
    def interrupt(done, wanted):
        if done >= 8:
            raise KeyboardInterrupt

    uninterrupted = run_episodes(gliding(), 24, num_workers=1)
    with pytest.raises(KeyboardInterrupt):
        run_episodes(gliding(), 24, num_workers=num_workers, path=tmp_path, progress=interrupt)
    kept = completed(tmp_path)
    assert 8 <= len(kept) < 24
    for num_kept in (len(kept), 24):
        seen = []
        options = {"path": tmp_path, "progress": lambda *n, s=seen: s.append(n)}
        resumed = run_episodes(gliding(), 24, num_workers=1, **options)
        assert seen == sorted(seen) and (seen[0], seen[-1]) == ((num_kept, 24), (24, 24))
        assert_identical(resumed, uninterrupted)
        assert_identical(load_episodes(tmp_path), uninterrupted)


@pytest.mark.train
def test_true_shows_the_progress_of_episodes_and_of_learning(capsys):
    episodes = run_episodes(gliding(), 12, num_workers=1, progress=True)
    assert "episodes of 'gliding': 12/12" in capsys.readouterr().err
    SafetyAssessment(AssessmentParameters(perplexity=5.0)).fit(episodes, progress=True)
    printed = capsys.readouterr().err
    assert "t-SNE: 100/100" in printed and "beliefs: 100/100" in printed


def balancing():
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 0.4
    return scenario


def test_an_episode_begun_by_a_push_counts_from_after_it():
    loop = balancing().make_loop()
    episodes = [run_episode(loop, i) for i in range(12)]
    assert {e.first_step for e in episodes if len(e.time_s) > 1} == {0, 1}


def test_episodes_of_a_robot_are_the_same_to_the_bit_with_one_and_two_workers():
    alone = run_episodes(balancing(), 8, variation="actual", num_workers=1)
    assert_identical(run_episodes(balancing(), 8, variation="actual", num_workers=2), alone)
    assert alone.num_diverged == 0


@pytest.mark.train
def test_an_episode_counts_the_failures_of_its_controller(tmp_path):
    loop = shuttling().make_loop()
    ends = [run_episode(loop, goal=np.array([0.9, 0.2, z])) for z in (0.5, 0.99)]
    assert [episode.num_controller_failures for episode in ends] == [0, 1]
    drawn = run_episodes(shuttling(), 12, num_workers=1, path=tmp_path)
    counts = [episode.num_controller_failures for episode in drawn]
    assert [episode.num_controller_failures for episode in load_episodes(tmp_path)] == counts


def test_a_goal_replaces_the_random_one_of_tasks_that_have_goals():
    loop, goal = shuttling().make_loop(), np.array([0.9, 0.2, 0.5])
    episode = run_episode(loop, 3, goal=goal)
    position, velocity = np.split(episode.state[0], 2)
    reached = position + loop.scenario.episode_duration_s * velocity
    np.testing.assert_allclose(loop.mass.reflect * reached, goal)
    np.testing.assert_array_equal(episode.state[0, :3], run_episode(loop, 3).state[0, :3])
    with pytest.raises(ValueError, match="'Gliding' lacks 'HasGoals'"):
        run_episode(gliding().make_loop(), goal=goal)


@pytest.mark.train
def test_what_a_loops_options_make_is_another_set(tmp_path):
    left, right = (
        run_episodes(shuttling(), 2, side=side, num_workers=1, path=tmp_path / side)
        for side in ("left", "right")
    )
    assert left.info.scenario_hash != right.info.scenario_hash
    # A set goes on with its own options, and with no others.
    more = run_episodes(shuttling(), 4, side="right", num_workers=1, path=tmp_path / "right")
    assert_identical(more[:2], right)
    for others in ({"side": "left"}, {}):
        with pytest.raises(ValueError, match="episodes of another set"):
            run_episodes(shuttling(), 4, num_workers=1, path=tmp_path / "right", **others)


class Leaking(Mass):
    """A mass that is faster the more often it has moved, in all episodes."""

    count = 0

    def _update(self, context, discrete_state):
        super()._update(context, discrete_state)
        self.count += 1
        discrete_state[1] += 1e-9 * self.count


@pytest.mark.parametrize("is_leaking", [False, True])
def test_state_outside_the_context_is_found_in_many_episodes_and_by_check(
    tmp_path, monkeypatch, is_leaking
):
    if is_leaking:
        monkeypatch.setattr("toy_tasks.Mass", Leaking)
    file = tmp_path / "mine.yaml"
    file.write_text(
        SCENARIO.replace("robot: none\n", f"parameters: {{speed_m_s: {1.7 + is_leaking}}}\n")
    )
    findings = check_scenario(file, num_episodes=3)
    (repeated,) = [finding for finding in findings if finding.item == "repeated episode"]
    assert repeated.is_ok == (not is_leaking)
    message = r"episode 0 of 'mine', .* keeps state outside"
    refused = pytest.raises(ValueError, match=message) if is_leaking else nullcontext()
    with refused:
        run_episodes(load_scenario(file), 64, num_workers=1)
