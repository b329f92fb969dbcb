"""`evaluate` and `calibrate` for plans with a goal."""

import shutil

import pytest

from command_line import call
from drake_safety.cli.evaluate_plans import PlanOptions, check_options
from drake_safety.cli.training_folder import (
    MODES,
    fresh_episodes_folder,
    load_assessment,
)
from drake_safety.evaluation import figure_style
from drake_safety.evaluation.results import Results
from drake_safety.simulation import pushed_motions, rollouts
from drake_safety.simulation.dataset import completed
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import train_shuttle


@pytest.fixture(scope="module")
def shuttle_run(tmp_path_factory):
    """A scenario whose plans have a goal, and what was learned of it."""
    folder = tmp_path_factory.mktemp("shuttle")
    return train_shuttle(folder), folder


def evaluate_shuttle(monkeypatch, run, *arguments):
    file, folder = run
    options = ("--assessment", folder, "--episodes", 30, "--calibration-episodes", 20)
    options += ("--workers", 1, "--seed", 100)
    return call(monkeypatch, "evaluate", file, *options, *arguments)


@pytest.mark.slow
def test_plans_with_a_goal_are_evaluated_before_anything_moves(monkeypatch, capsys, shuttle_run):
    _, folder = shuttle_run
    arguments = ("--other-hand", 10, "--plane-step", 0.6)
    assert evaluate_shuttle(monkeypatch, shuttle_run, *arguments) in (0, None)
    printed = capsys.readouterr().out
    for title in ("all targets", "the other hand", "paper uses its next H steps"):
        assert title in printed
    report = Results.read(folder / "evaluation.json")
    assert report["plans.causes.right_cause"].n == report["plans.causes.by_cause_probability"].n
    for name in ("sharpened", "paper", "gradient_boosting", "mlp"):
        for prefix in ("plans", "plans.fair", "plans.other_hand", "plans.other_hand.fair"):
            assert f"{prefix}.{name}.unsafe_recall" in report
    assert report["plans.outcomes.safe"].n == 30
    assert report["plans.other_hand.outcomes.safe"].n == 10
    assert report["plans.sharpened.threshold"].n == report.entries["calibration_episodes"] == 20
    assert "plans.plane.sharpened.right" in report
    for name in ("plans", "plans_roc", "reachable_region"):
        assert (folder / f"{name}.png").is_file()
    # What takes throws or runs is no part of it.
    assert not any(key.startswith(("throws.", "segments.")) for key in report)


def calibrate_shuttle(monkeypatch, run, *arguments):
    file, folder = run
    options = ("--assessment", folder, "--episodes", 120, "--workers", 1, "--splits", 20)
    return call(monkeypatch, "calibrate", file, *options, *arguments)


@pytest.mark.slow
def test_a_calibration_is_stored_and_used_by_who_evaluates(
    monkeypatch, capsys, shuttle_run, tmp_path
):
    file, trained = shuttle_run
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    run = (file, folder)
    assert calibrate_shuttle(monkeypatch, run, "--miss-rate", 0.1) in (0, None)
    printed = capsys.readouterr().out
    assert "at most 10 % of unsafe episodes called safe, on average" in printed
    assert "needs 99 unsafe episodes" in printed
    stored = {mode: load_assessment(folder, mode).calibrations_ for mode in MODES}
    for mode in MODES:
        assert stored[mode].keys() == {"plan", "motion"}
        assert stored[mode]["plan"].miss_rate == 0.1
        assert stored[mode]["plan"].num_unsafe + stored[mode]["plan"].num_safe == 120
    # The episodes are kept: another promise simulates nothing.
    monkeypatch.setattr(rollouts, "run_episode", None)
    assert calibrate_shuttle(monkeypatch, run, "--miss-rate", 0.01) == 2
    assert "needs at least 99 unsafe episodes; of 120 episodes" in capsys.readouterr().out
    assert load_assessment(folder, "sharpened").calibrations_ == stored["sharpened"]
    monkeypatch.undo()
    monkeypatch.setattr(figure_style, "save", lambda figure, path: [])
    assert evaluate_shuttle(monkeypatch, run, "--plane-step", 0) in (0, None)
    report = Results.read(folder / "evaluation.json")
    threshold = report["plans.sharpened.threshold"].value
    assert threshold == pytest.approx(stored["sharpened"]["plan"].threshold)
    assert report["calibration.plan.sharpened.promised_miss_rate"].value == 0.1
    missed = report["calibration.plan.sharpened.miss_rate"].value
    assert missed == pytest.approx(1.0 - report["plans.sharpened.unsafe_recall"].value)
    assert evaluate_shuttle(monkeypatch, run, "--seed", 2_000_000) == 2
    printed = " ".join(capsys.readouterr().out.split())
    assert "start as the 120 'nominal' episodes of its calibration" in printed
    assert "choose another seed, such as 2000001" in printed


@pytest.mark.slow
def test_fresh_targets_are_kept_and_not_simulated_again(monkeypatch, capsys, shuttle_run):
    file, folder = shuttle_run
    arguments = ("--plane-step", 0)
    monkeypatch.setattr(figure_style, "save", lambda figure, path: [])
    assert evaluate_shuttle(monkeypatch, shuttle_run, *arguments) in (0, None)
    first = Results.read(folder / "evaluation.json")
    hash_ = load_scenario(file).simulation_hash()
    kept = [
        fresh_episodes_folder(folder, hash_, seed, options)
        for seed, options in ((100, {}), (103, {}), (100, {"side": "right"}))
    ]
    assert [len(completed(path)) for path in kept] == [30, 20, 30]

    def forbidden(*arguments, **options):
        raise AssertionError("simulated again")

    # Once all are there, even a simulation that always fails is not needed.
    monkeypatch.setattr(rollouts, "run_episode", forbidden)
    assert evaluate_shuttle(monkeypatch, shuttle_run, *arguments) in (0, None)
    again = Results.read(folder / "evaluation.json")
    assert list(map(str, again.values())) == list(map(str, first.values()))


@pytest.mark.slow
def test_without_baselines_nothing_but_either_mode_is_judged(monkeypatch, shuttle_run, tmp_path):
    monkeypatch.setattr(figure_style, "save", lambda figure, path: [])
    options = ("--plane-step", 0, "--other-hand", 0, "--no-baselines", "--out", tmp_path)
    assert evaluate_shuttle(monkeypatch, shuttle_run, *options) in (0, None)
    report = Results.read(tmp_path / "evaluation.json")
    judged = {key.split(".")[1] for key in report if key.endswith(".brier")}
    assert judged == {"sharpened", "paper", "fair"}


@pytest.mark.train
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plane-x", "5"], "the plane x = 5 m misses the target box"),
        (["--throws", "3"], "pass --throws 0: task 'Shuttling' has no ball to throw"),
        (["--seed", "-3"], "seed 0 gives episodes that start as the 60 'nominal'"),
    ],
)
def test_what_cannot_be_evaluated_is_refused_before_anything_is_simulated(
    monkeypatch, capsys, shuttle_run, arguments, message
):
    def forbidden(*arguments, **options):
        raise AssertionError("simulated")

    monkeypatch.setattr(rollouts, "run_episode", forbidden)
    assert evaluate_shuttle(monkeypatch, shuttle_run, *arguments) == 2
    assert message in " ".join(capsys.readouterr().out.split())


def test_options_of_targets_are_refused_where_plans_have_no_goal():
    loop = load_scenario("laikago_balancing").make_loop()
    check_options(loop, PlanOptions())
    for options in (PlanOptions(other_hand=5), PlanOptions(plane_x=0.8)):
        with pytest.raises(
            ValueError, match=r"leave out --other-hand.*'Balancing' has no plans with a"
        ):
            check_options(loop, options)


@pytest.mark.slow
def test_who_notices_pushes_is_part_of_the_evaluation(monkeypatch, capsys, shuttle_run):
    file, folder = shuttle_run
    options = ("--assessment", folder, "--episodes", 20, "--calibration-episodes", 20)
    options += ("--workers", 1, "--seed", 100, "--plane-step", 0, "--other-hand", 0)
    assert call(monkeypatch, "evaluate", file, *options, "--pushes", 15) in (0, None)
    printed = capsys.readouterr().out
    report = Results.read(folder / "evaluation.json")
    judged = {key.split(".")[1] for key in report if key.startswith("monitoring.")}
    assert judged == {
        "motions",
        "sharpened",
        "paper",
        "gradient_boosting",
        "mlp",
        "front_margin",
        "smallest_margin",
    }
    pushed, refused = (report[f"monitoring.motions.{key}"] for key in ("leave_safe_set", "refused"))
    assert refused.n == 30 and pushed.n == 30 - round(30 * refused.value)
    assert 0 < pushed.value < 1
    assert "Alarms on pushed motions" in printed
    assert (folder / "monitoring.png").is_file()
    # The motions are kept, as the fresh episodes are: the second time nothing is simulated.
    monkeypatch.setattr(pushed_motions, "run_pushed_motion", None)
    monkeypatch.setattr(rollouts, "run_episode", None)
    assert call(monkeypatch, "evaluate", file, *options, "--pushes", 15) in (0, None)
    again = Results.read(folder / "evaluation.json")
    assert str(again.select(set="monitoring")) == str(report.select(set="monitoring"))


@pytest.mark.train
def test_pushes_are_refused_where_there_is_no_way_to_push(monkeypatch, capsys, shuttle_run):
    _, folder = shuttle_run
    arguments = ("--assessment", folder, "--throws", 0, "--pushes", 3)
    assert call(monkeypatch, "evaluate", "laikago_balancing", *arguments) == 2
    assert "leave out --pushes; alarms are evaluated on throws" in " ".join(
        capsys.readouterr().out.split()
    )
