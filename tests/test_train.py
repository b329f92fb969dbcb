import re

import pytest

from command_line import call
from drake_safety.cli.training_folder import MODES, load_assessment
from drake_safety.learning.change_detector import usual_rows
from drake_safety.learning.seeds import FALLS, MOTION
from drake_safety.simulation.dataset import load_episodes
from sprung_motions import same_detector
from toy_tasks import SHUTTLING


@pytest.mark.slow
def test_the_monitor_is_learned_from_undisturbed_motion_that_is_kept(monkeypatch, capsys, tmp_path):
    file, out = tmp_path / "shuttling.yaml", tmp_path / "run"
    file.write_text(SHUTTLING)
    train = ("train", file, "--episodes", 60, "--workers", 1, "--out")
    assert call(monkeypatch, *train, out, "--motion", 0.4) == 0
    printed = capsys.readouterr().out
    assert "0 min of motion for its limits" in printed
    told = re.search(r"monitor: alarms in 0 of (\d+) safe episodes", printed)
    watched = load_episodes(out / "watched")
    assert len(watched) == 60 and int(told[1]) == sum(one.is_safe for one in [*watched][1::2])
    motions = load_episodes(out / "motion")
    assert (len(motions), motions.info.seed, motions.info.step_s) == (30, MOTION.first, 0.02)
    learned = {mode: load_assessment(out, mode).detector_ for mode in MODES}
    assert same_detector(*learned.values())
    # The shuttle falls where it leaves to one side; that is learned of other episodes.
    falls = load_episodes(out / "falls")
    assert (len(falls), falls.info.seed) == (15, FALLS.first)
    assert {one.cause for one in falls} == {"", "flank"}
    assert load_assessment(out, MODES[0]).fall_logit_ is not None
    assert load_assessment(out, MODES[1]).fall_logit_ is None
    halves = [len(one) - 2 for one in usual_rows(motions) if len(one) > 2]
    safe = [len(one.state) - one.first_step - 2 for one in [*watched][::2] if one.is_safe]
    halves += [num for num in safe if num > 0]
    assert learned["paper"].motion_s == pytest.approx(0.02 * sum(halves[1::2]))
    # Of an actual plant the monitor learns from its motion too, which no pair is.
    adapt = ("adapt", file, "--assessment", out, "--feedback", 10, "--workers", 1)
    assert call(monkeypatch, *adapt) == 0
    (folder,) = out.glob("feedback/*/motion")
    actual = load_episodes(folder)
    assert (actual.info.variation, actual.info.seed) == ("actual", MOTION.first + 1)
    for mode in MODES:
        adapted = load_assessment(out / "adapted-actual", mode).detector_
        assert same_detector(adapted, learned[mode].with_motions(usual_rows(actual)))
        assert not same_detector(adapted, learned[mode])
    # Without motion it is learned from the episodes, whose rows are a step apart.
    alone = tmp_path / "alone"
    assert call(monkeypatch, *train, alone, "--motion", 0, "--mode", "paper") == 0
    assert not (alone / "motion").exists()
    assert load_assessment(alone, "paper").detector_.step_s == 0.04
    assert not (alone / "falls").exists()
