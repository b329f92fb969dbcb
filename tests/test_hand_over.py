"""A policy takes over a robot: what `check` says of the hand-over and of its margins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from command_line import call
from drake_safety import load_scenario
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation import hand_over
from drake_safety.simulation.hand_over import MotorLoads, check_hand_over
from drake_safety.simulation.motion import Motion
from legged_robots import edited
from policy_networks import save_network, save_script, walker


@pytest.fixture(scope="module")
def resting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("resting")
    return walker(folder, save_network(folder / "walk.pt", 42, 18, scale=0.0))


def save_nan(path):
    """A network at rest that returns NaN at a command of about 0.5."""
    import torch

    class Damaged(torch.nn.Module):
        def forward(self, x):
            command = x[:, 3:4]
            is_bad = (command > 0.4) & (command < 0.6)
            return torch.zeros(x.shape[0], 18) + torch.where(is_bad, float("nan"), 0.0)

    return save_script(path, Damaged())


@pytest.mark.train
def test_a_policy_that_holds_its_posture_is_no_walker(resting, monkeypatch, capsys):
    assert call(monkeypatch, "check", resting, "--quick") == 1
    printed = capsys.readouterr().out
    assert "problem  takes over and walks, from standing: the joint targets jump by 0.0" in printed
    assert "it moves at -0.00: it holds its posture" in printed or "at 0.00: it holds" in printed
    assert "order of 'joints' and of the terms" in printed
    assert "ready" not in printed and "crouch" not in printed and "joint_gains" not in printed


@pytest.mark.train
def test_a_network_that_returns_nan_at_a_command_is_damaged(tmp_path):
    loop = load_scenario(walker(tmp_path, save_nan(tmp_path / "walk.pt"))).make_loop()
    (finding,) = check_hand_over(loop)
    assert not finding.is_ok
    assert "returns actions that are not finite, and the last one is held" in finding.message


@pytest.mark.train
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"period_s": 0.005}, "the joint targets jump by 0.13 rad (knee_5)"),
        ({"gains": {".*": {}}}, "the joint targets jump by 0.13 rad (knee_5)"),  # No servos.
        ({"command": {"highest": [0, 0, 0]}}, "no command is above zero"),
    ],
)
def test_a_policy_that_does_not_walk_is_told_how_it_begins(tmp_path, changes, message):
    # The first action is 0.36 to 0.53, by gravity.
    scenario = walker(tmp_path, save_network(tmp_path / "walk.pt", 42, 18, scale=-0.01))
    edited(scenario.with_name("policy.yaml"), **changes)
    (finding,) = check_hand_over(load_scenario(scenario).make_loop())
    assert not finding.is_ok and message in finding.message


@pytest.mark.train
def test_loads_are_those_of_servos_and_direct_current_motors(resting):
    loop = load_scenario(resting).make_loop()
    loads, context = MotorLoads(loop), loop.CreateDefaultContext()
    start = loop.standing_start()
    q, v = start.q.copy(), start.v.copy()
    q[7] -= 0.05
    v[6], v[7] = -2.0, 25.0  # Of 20 rad/s at most.
    loop.reset_to(context, None, replace(start, q=q, v=v))
    loads.read(context)
    # Of 40 N·m: 200 N·m/rad · 0.05 rad + 4 N·m·s/rad · 2 rad/s, against the motion; 4 · 25.
    torque, speed, power = loads.peaks
    assert torque[:3] == pytest.approx([18 / 40, 100 / 40, 0.0], abs=1e-6)
    assert speed[:3] == pytest.approx([0.1, 1.25, 0.0], abs=1e-6)
    # A motor that brakes returns power.
    assert power[:3] == pytest.approx([0.45 * (0.45 - 0.1), 0.0, 0.0], abs=1e-6)
    assert "torque 250 % (lift_0), speed 125 % (lift_0)" in loads.finding().message
    assert loads.finding().is_warning and "train the policy" in loads.finding().remedy


@pytest.mark.train
def test_a_servo_at_rest_asks_for_the_torque_that_it_has(resting):
    loop = load_scenario(resting).make_loop()
    loads, actual = MotorLoads(loop), []

    def watch(context):
        if context.get_time() > 0.9:
            plant_context = loop.plant.GetMyContextFromRoot(context)
            port = loop.plant.get_net_actuation_output_port(loop.robot_instance)
            actual.append(np.abs(port.Eval(plant_context)) / 40.0)
            loads.read(context)

    hand_over._moved(loop, loop.standing_start(), [], 1.0, monitor=watch)
    assert loads.peaks[0].max() > 0.03
    assert loads.peaks[0] == pytest.approx(np.max(actual, axis=0), abs=1e-3)


class Plants:
    """A scenario whose robot falls from some rung of each ladder on."""

    def __init__(self, limits, plant=None):
        self.limits, self.plant = limits, plant or PlantVariation(mass_scale=2.0)

    def variation(self, name):
        return self.plant

    def with_variation(self, name, plant):
        return Plants(self.limits, plant)

    def make_loop(self, name):
        plant = self.plant
        change = {
            "latency": plant.shift.command_delay_s if plant.shift else 0.0,
            "friction": -(plant.foot_friction or 0.8),
            "more mass": plant.mass_scale,
            "less mass": -plant.mass_scale,
        }[name]
        falls = change >= self.limits[name] - 1e-9
        return SimpleNamespace(standing_start=lambda: None, falls=falls)


@pytest.mark.parametrize(
    ("limits", "texts", "is_small"),
    [
        (
            {"latency": 0.03, "friction": -0.24, "more mass": 3.5, "less mass": -0.1},
            "latency: falls at 30 ms, no fall at 20 ms; friction: falls at 0.24, no fall at 0.36; "
            "more mass: falls at ×1.75, no fall at ×1.5; less mass: no fall at ×0.3",
            False,
        ),
        (
            {"latency": 0.005, "friction": -0.01, "more mass": 9.0, "less mass": -0.1},
            "latency: falls at 5 ms; friction: no fall at 0.04; "
            "more mass: no fall at ×2.5; less mass: no fall at ×0.3",
            True,
        ),
    ],
)
def test_margins_are_the_last_rungs_without_a_fall(monkeypatch, limits, texts, is_small):
    def moved(loop, *arguments):
        return SimpleNamespace(has_fallen=loop.falls, failure="")

    monkeypatch.setattr(hand_over, "_moved", moved)
    robot = SimpleNamespace(foot_friction=0.8)
    loop, told = SimpleNamespace(scenario=Plants(limits), robot=robot), []
    finding = hand_over._margins(loop, np.zeros(3), lambda *done: told.append(done))
    assert finding.message == texts
    assert finding.is_ok and finding.is_warning == is_small
    assert told[0] == (0, 12) and told[-1] == (12, 12)


def test_the_smallest_command_that_moves_a_robot_is_found_on_each_axis(monkeypatch):
    dead = np.array([0.15, 0.0, 9.0])

    def moved(loop, start, commands, duration_s):
        time_s = np.arange(round(duration_s / 0.02) + 1) * 0.02
        output = np.full((len(time_s), 3), 0.03)  # It drifts.
        for begin_s, command in commands:
            rows = time_s > begin_s + 0.3
            output[rows] = 0.03 + np.where(np.abs(command) > dead, 0.8 * command, 0.0)
        return Motion(time_s=time_s, ports={"output": output})

    monkeypatch.setattr(hand_over, "_moved", moved)
    loop = SimpleNamespace(standing_start=lambda: None)
    highest = np.array([1.0, 0.5, 1.0])
    finding = hand_over._smallest_commands(loop, highest, lambda *done: None)
    assert finding.message.endswith("forward 0.2 m/s, left 0.025 m/s, yaw none up to 0.4 rad/s")
    assert finding.is_warning
    dead[2] = 0.0
    finding = hand_over._smallest_commands(loop, highest * [1, 1, 0], lambda *done: None)
    assert finding.message.endswith("forward 0.2 m/s, left 0.025 m/s") and not finding.is_warning


@pytest.mark.slow
def test_a_published_policy_takes_over_walks_and_stops():
    loop = load_scenario("go2_walking").make_loop()
    findings = [*check_hand_over(loop, has_margins=False)]
    assert [one.item.rpartition(", ")[2] for one in findings] == [
        *("from standing", "from a crouch", "in a drop of 2 cm", "motors"),
    ]
    assert all(one.is_ok for one in findings)
    for one in findings[:3]:
        assert "asked for 0.50 m/s forward, it moves at 0.4" in one.message
        assert 6.0 < float(one.message.partition("with ")[2].split()[0]) < 14.0
        assert float(one.message.split()[-2]) < 0.1
    # Calves exceed their stated speed: docs/pushes.md.
    assert "speed 1" in findings[3].message and "_calf_joint" in findings[3].message
    crouch = hand_over._starts(loop)["from a crouch"]
    feet = loop.kinematics.contact_positions(crouch.q)[:, 2] - loop.kinematics.foot_radii
    assert feet == pytest.approx(0.0, abs=2e-3)
    assert loop.kinematics.standing_height - crouch.q[6] == pytest.approx(0.02)
