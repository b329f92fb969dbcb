"""How hard a push a robot survives: the card, its figure and the command."""

import math
from dataclasses import replace

import numpy as np
import pytest

from command_line import call
from drake_safety import load_scenario
from drake_safety.evaluation import push_card
from drake_safety.evaluation.push_card import PushCell, PushPlan, PushRig, make_push_card
from drake_safety.evaluation.push_figure import push_figure
from drake_safety.evaluation.results import Results

PLAN = PushPlan(directions=2, phases=8, precision=0.2)


@pytest.fixture(scope="module")
def laikago():
    return load_scenario("laikago_balancing")


@pytest.fixture(scope="module")
def rig(laikago):
    return PushRig(laikago, "nominal", PLAN)


@pytest.fixture(scope="module")
def card(laikago, tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    return folder, make_push_card(laikago, PLAN, num_workers=1, path=folder)


def test_a_robot_that_stands_has_one_phase_and_falls_by_a_hard_push_alone(rig):
    assert (rig.period_s, rig.num_phases, rig.plan.metric) == (0.0, 1, "fall")
    mass_kg = rig.loop.kinematics.total_mass
    assert rig.unit_n_s == pytest.approx(mass_kg * math.sqrt(9.81 * 0.4245), rel=0.02)
    assert not rig.try_push(1.0, 0, 0)[0]
    assert rig.try_push(40.0 * rig.unit_n_s, 0, 0)[0]
    push, saved = rig.push(10.0, 1, 0)
    assert push.time_s == pytest.approx(saved.get_time())
    np.testing.assert_allclose(push.force_n, [-100.0, 0.0, 0.0], atol=0.5)
    assert push.body == rig.loop.robot.base


def test_each_direction_has_the_smallest_impulse_that_fails_and_the_largest_below_it(card):
    _, card = card
    assert [(cell.direction, cell.phase) for cell in card.cells] == [(0, 0), (1, 0)]
    for cell in card.cells:
        below, above = cell.survived_n_s, cell.critical_n_s
        assert 0.0 < below < above <= below / (1.0 - PLAN.precision) + 1e-9
        failed = [j for j, f in zip(cell.impulses_n_s, cell.has_failed, strict=True) if f]
        assert min(failed) == above
    assert card.grid("survived_n_s").shape == (2, 1)
    assert card.weakest.survived_n_s == card.grid("survived_n_s").min()
    assert card.islands.n == 4
    assert np.isnan(card.grid("foreseen_n_s")).all()


@pytest.mark.slow
def test_it_has_the_same_bits_for_two_workers_and_continues(card, laikago, monkeypatch):
    folder, card = card
    assert make_push_card(laikago, PLAN, num_workers=2).cells == card.cells
    monkeypatch.setattr(PushRig, "cell", None)
    assert make_push_card(laikago, PLAN, num_workers=1, path=folder).cells == card.cells


class Island(PushRig):
    """A robot that fails from 10 N·s on, and between 5 and 6."""

    def __init__(self):
        self.plan, self.unit_n_s, self._assessment = PushPlan(), 4.0, None

    num_phases = 1

    def try_push(self, impulse_n_s, direction, phase):
        return impulse_n_s >= 10.0 or 5.0 <= impulse_n_s < 6.0, 0.5


def test_failures_below_the_smallest_that_bisection_finds_are_looked_for():
    cells = [Island().cell((k, 0)) for k in range(40)]
    upper = [cell for cell in cells if cell.critical_n_s >= 10.0]
    lower = [cell for cell in cells if cell.critical_n_s < 10.0]
    assert len(lower) > 3
    assert all(cell.num_islands == 0 and 9.5 <= cell.survived_n_s < 10.0 for cell in upper)
    assert all(5.0 <= cell.critical_n_s < 5.3 and cell.survived_n_s < 5.0 for cell in lower)
    assert {cell.num_islands for cell in lower} <= {1, 2}


def test_a_robot_that_nothing_pushes_over_has_an_impulse_beyond_the_largest_one(monkeypatch):
    monkeypatch.setattr(Island, "try_push", lambda *_: (False, 1.5))
    cell = Island().cell((0, 0))
    assert (cell.critical_n_s, cell.num_islands) == (math.inf, 0)
    assert cell.survived_n_s == 128.0
    assert set(cell.speeds) == {1.5}


def test_a_robot_that_any_push_fells_survives_none(monkeypatch):
    monkeypatch.setattr(Island, "try_push", lambda *_: (True, 0.5))
    cell = Island().cell((0, 0))
    assert (cell.survived_n_s, cell.num_islands) == (0.0, 0)
    assert 0.0 < cell.critical_n_s < 0.01


class Doubtful(Island):
    """A robot whose Γ expects a failure from 7 N·s on."""

    def __init__(self):
        super().__init__()
        self._assessment = object()

    def failure_probability(self, impulse_n_s, direction, phase):
        return float(impulse_n_s > 7.0)


def test_the_impulse_is_printed_from_which_on_gamma_expects_a_failure():
    for k in range(20):
        cell = Doubtful().cell((k, 0))
        assert cell.foreseen_n_s == pytest.approx(7.0, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "period_s"), [("go2_walking", (0.2, 0.35)), ("g1_walking", (0.9, 1.1))]
)
def test_the_period_of_a_gait_is_that_of_its_joints(name, period_s):
    rig = PushRig(load_scenario(name), "nominal", PushPlan())
    assert period_s[0] <= rig.period_s <= period_s[1]
    times_s = [rig.push(1.0, 0, phase)[0].time_s for phase in range(8)]
    assert np.ptp(times_s) <= rig.period_s
    assert (np.diff(times_s) > 0).all()


def test_a_saved_state_continues_as_the_motion_that_it_was_saved_from(rig):
    moved = rig._moved(2.4)
    push, _ = rig.push(0.0, 0, 0)
    motion = rig.pushed(0.0, 0, 0, duration_s=0.2)
    rows = np.round(motion.time_s + push.time_s, 9)
    common = [k for k, t in enumerate(moved.time_s) if np.isclose(rows, t).any()]
    assert len(common) > 2
    for k in common:
        i = int(np.abs(rows - moved.time_s[k]).argmin())
        np.testing.assert_allclose(motion["plant_state"][i], moved["plant_state"][k], atol=1e-9)


def test_a_robot_that_falls_by_itself_and_a_task_without_legs_are_refused(laikago):
    weak = load_scenario(
        "laikago_balancing",
        {"variations.nominal.shift": {"joints": {".*": {"effort_scale": 0.05}}}},
    )
    with pytest.raises(ValueError, match="fails without a push"):
        _ = PushRig(weak, "nominal", PLAN).period_s
    with pytest.raises(ValueError, match="LeggedLoop"):
        PushRig(load_scenario("pendulum"), "nominal", PLAN)


def test_the_figure_has_a_curve_for_each_loop_and_for_gamma():
    rng = np.random.default_rng(0)
    cells = [
        PushCell(
            direction=i,
            phase=k,
            impulses_n_s=[10.0 + i + k, 30.0],
            has_failed=[False, True],
            speeds=[0.5, 1.5],
            num_islands=0,
            foreseen_n_s=float(rng.uniform(20, 40)),
        )
        for i in range(4)
        for k in range(2)
    ]
    plan = replace(PLAN, directions=4, body="base")
    one = push_card.PushCard(plan=plan, unit_n_s=20.0, period_s=0.5, cells=cells)
    figure = push_figure({"baseline": one, "policy=new.onnx": one})
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert "baseline, worst phase of the gait" in labels
    assert "policy=new.onnx, worst phase of the gait" in labels
    assert any(label.startswith("Γ") for label in labels)
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), [10, 11, 12, 13, 10])
    assert one.summary == ("0°, phase 1 of 2", "10 (0.50)", "12", "14", "0 % (0–21)", "0.50")


def test_a_wrong_candidate_is_refused_before_anything_is_pushed(monkeypatch, tmp_path, capsys):
    def make_rig(scenario, variation, plan, **options):
        if variation == "actual":
            raise ValueError("it has no motors")

    monkeypatch.setattr("drake_safety.cli.pushes.PushRig", make_rig)
    monkeypatch.setattr("drake_safety.cli.pushes.make_push_card", None)
    options = ["--candidate", "variation=actual", "--out", tmp_path]
    assert call(monkeypatch, "pushes", "laikago_balancing", *options) == 2
    assert "it has no motors" in capsys.readouterr().out


@pytest.mark.slow
def test_the_command_compares_two_loops_and_names_the_weakest(monkeypatch, tmp_path, capsys):
    options = ["--directions", 1, "--workers", 1, "--out", tmp_path]
    options += ["--candidate", "variations.nominal.motors=dc"]
    assert call(monkeypatch, "pushes", "laikago_balancing", *options) == 0
    printed = capsys.readouterr().out
    assert "robot that stands" in printed
    assert "motors=dc: " in printed
    cards = Results.read(tmp_path / "pushes.json").entries["cards"]
    assert [*cards] == ["baseline", "variations.nominal.motors=dc"]
    assert cards["baseline"]["cells"][0]["foreseen_n_s"] is not None
    assert (tmp_path / "pushes.png").stat().st_size > 20_000
    assert call(monkeypatch, "pushes", "laikago_balancing", *options, "--replay") == 0
    assert "weakest.html" in capsys.readouterr().out
    assert (tmp_path / "weakest.html").stat().st_size > 100_000
