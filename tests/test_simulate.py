import numpy as np
import pytest

from drake_safety.learning.segments import EpisodeError
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import episode_rng
from toy_tasks import gliding


def glide(loop, index, after_leaving_s=np.inf, **options):
    def start(context):
        return loop.reset(context, episode_rng(0, index))

    end = End(duration_s=0.8, after_leaving_s=after_leaving_s)
    return simulate(loop, start, ["margins", "state"], end, index=index, **options)


def test_a_motion_goes_on_for_a_while_after_it_left_the_safe_set():
    loop = gliding(speed_m_s=2.0).make_loop()
    motions = [glide(loop, index, after_leaving_s=0.1) for index in range(12)]
    assert 0 < sum(motion.has_left for motion in motions) < 12
    for motion in motions:
        assert motion["margins"].shape == (len(motion.time_s), 2)
        assert not motion.failure and not motion.has_fallen
        end_s = min(motion.leave_time_s + 0.1, 0.8)
        assert motion.time_s[-1] == pytest.approx(end_s, abs=0.0201)
        if motion.has_left:
            row = int(np.argmax(motion["margins"].min(axis=1) < 0))
            assert motion.time_s[row] == motion.leave_time_s
            assert motion.cause == ["right", "left"][np.argmin(motion["margins"][row])]
        whole = glide(loop, motion.index)
        np.testing.assert_array_equal(whole["state"][: len(motion.time_s)], motion["state"])
        assert whole.time_s[-1] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("failure", "told"), [("raise", "the solver failed"), ("nan", "a margin of nan at")]
)
def test_a_simulation_that_fails_says_why_or_is_an_error(failure, told):
    loop = gliding(failure=failure, speed_m_s=4.0).make_loop()
    motions = {index: glide(loop, index, may_fail=True) for index in range(12)}
    failed = {index: motion for index, motion in motions.items() if motion.failure}
    assert failed
    for index, motion in failed.items():
        assert told in motion.failure
        assert np.isfinite(motion["margins"]).all()
        with pytest.raises(EpisodeError, match=f"number {index}: the simulation failed: .*{told}"):
            glide(loop, index, who=f"number {index}")
    with pytest.raises(EpisodeError, match="motion: RuntimeError: no start"):
        glide(gliding(fails_at_start=True).make_loop(), 0, may_fail=True)


def test_events_happen_at_their_times_and_a_row_shows_the_state_before_later_updates():
    loop = gliding(speed_m_s=0.1).make_loop()
    done, rows = [], []

    def stop(context):
        done.append(context.get_time())
        mass = loop.mass.GetMyMutableContextFromRoot(context)
        mass.SetDiscreteState([0.0, 0.0])

    motion = glide(
        loop,
        3,
        events=[(0.33, stop), (0.105, stop)],
        each_row=lambda context: rows.append(context.get_time()),
    )
    assert done == pytest.approx([0.105, 0.33])
    assert rows == pytest.approx(motion.time_s)
    is_after = motion.time_s > 0.105
    assert motion["state"][~is_after, 1].all() and not motion["state"][is_after].any()
