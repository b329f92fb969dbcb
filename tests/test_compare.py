"""The table and the picture of several evaluated runs."""

import numpy as np

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import shuttling
from studies.compare import compare, comparison_figure, standing_still

FIGURES = {
    "episodes.sharpened.auc": Estimate(0.95, 0.93, 0.97, 100),
    "throws.falls_without_recovery": Estimate(0.4, 0.25, 0.55, 40),
    "throws.sharpened.falls_with_recovery": Estimate(0.025, 0.0, 0.1, 40),
}


def test_a_run_is_a_row_and_what_it_was_not_asked_a_dash(tmp_path, capsys):
    Results(FIGURES, {"scenario": "pendulum"}).write(tmp_path / "evaluation.json")
    compare([tmp_path])
    printed = capsys.readouterr().out
    assert "pendulum" in printed and "95.0" in printed and "40.0" in printed
    assert "picture" not in printed  # There is no robot to show.


def test_the_picture_shows_each_robot_with_what_its_run_says():
    picture = np.zeros((4, 5, 3), dtype=np.uint8)
    (axes,) = comparison_figure({"laikago_balancing": FIGURES}, {"laikago_balancing": picture}).axes
    assert axes.get_title(loc="left") == "laikago balancing"
    assert axes.texts[0].get_text() == "AUC at planning time 0.950\nfalls 40 % → 2.5 %"


def test_a_robot_is_seen_standing_and_a_task_without_one_has_no_picture():
    assert standing_still(shuttling().make_loop()) is None
    still = standing_still(load_scenario("laikago_balancing").make_loop())
    middle, corner = still[still.shape[0] // 2, still.shape[1] // 2], still[2, 2]
    assert np.abs(middle.astype(int) - corner).max() > 20
