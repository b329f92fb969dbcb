import json
import sys
from pathlib import Path

import numpy as np
import pytest

import cart_pole_task
from cart_pole_task import SCENARIO
from command_line import call
from drake_safety import SafetyAssessment, load_scenario, run_episodes
from drake_safety.cli.training_folder import assessment_file, episodes_folder
from drake_safety.simulation.free_motion import run_free
from gliding_task import gliding


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """A scenario whose task stands beside it, and what was learned of it."""
    folder = tmp_path_factory.mktemp("cart")
    (folder / "beside_cart.py").write_text(Path(cart_pole_task.__file__).read_text())
    file = folder / "cart_pole.yaml"
    file.write_text(SCENARIO.replace("cart_pole_task:", "beside_cart:"))
    scenario = load_scenario(file)
    episodes = run_episodes(scenario, 60, num_workers=1, path=episodes_folder(folder))
    assert 0 < episodes.num_unsafe < 60
    SafetyAssessment(scenario.assessment).fit(episodes).save(assessment_file(folder, "sharpened"))
    yield file, folder
    sys.modules.pop("beside_cart", None)


@pytest.mark.slow
def test_an_episode_is_recorded_with_its_timeline_and_events(monkeypatch, capsys, cart):
    file, folder = cart
    assert call(monkeypatch, "run", file, "--assessment", folder) in (0, None)
    run = folder / "run"
    names = {path.name for path in run.iterdir()}
    assert names == {"recording.html", "run.json", "timeline.png", "timeline.svg"}
    rows = json.loads((run / "run.json").read_text())["rows"]
    assert rows[0][:2] == ["0.00", "the episode starts"]
    assert "end" in rows[-1][1] or "left" in rows[-1][1]
    assert "meshcat" in (run / "recording.html").read_text()[:200_000].lower()
    assert "the episode starts" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--push", "ball"], "run: --push: task 'CartPole' has no ball to throw"),
        (["--target", "1 2 3"], "has no plans with a goal"),
    ],
)
@pytest.mark.slow
def test_what_such_a_task_cannot_do_is_said(monkeypatch, capsys, cart, options, message):
    file, folder = cart
    assert call(monkeypatch, "run", file, "--assessment", folder, *options) == 2
    assert message in " ".join(capsys.readouterr().out.split())


def test_the_end_of_a_motion_is_told():
    loop = gliding(speed_m_s=2.0).make_loop()
    motions = [run_free(loop, index, seed=0, duration_s=0.8) for index in range(12)]
    left = [motion for motion in motions if motion.cause]
    assert 0 < len(left) < 12
    for motion in motions:
        assert motion.margins.shape == (len(motion.time_s), 2)
        assert not motion.failure
        assert motion.time_s[-1] == pytest.approx(0.8) or motion.cause
    for motion in left:
        assert motion.cause in ("right", "left")
        row = int(np.argmax(motion.margins.min(axis=1) < 0))
        assert motion.time_s[row] == motion.leave_time_s


@pytest.mark.parametrize(("failure", "told"), [("raise", "the solver failed"), ("nan", "finite")])
def test_a_simulation_that_fails_ends_and_says_why(failure, told):
    loop = gliding(failure=failure, speed_m_s=4.0).make_loop()
    motions = [run_free(loop, index, seed=0, duration_s=0.8) for index in range(12)]
    failed = [motion for motion in motions if motion.failure]
    assert failed
    for motion in failed:
        assert told in motion.failure
        assert np.isfinite(motion.margins).all()
    with pytest.raises(ValueError, match="failed at its start: no start"):
        run_free(gliding(fails_at_start=True).make_loop(), seed=0, duration_s=0.8)
