"""Two closed loops in the same episodes: verdicts, refusals, and the command."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from cart_episodes import assert_identical
from command_line import call
from drake_safety import cli, compare_loops, load_scenario, run_episode, run_episodes
from drake_safety.cli import gate
from drake_safety.diagrams.walking.task import policy_files
from drake_safety.evaluation import loop_comparison
from drake_safety.evaluation.loop_comparison import ComparedPlant
from drake_safety.evaluation.outcomes import OutcomeReader
from drake_safety.evaluation.results import Results
from drake_safety.learning.segments import DIVERGED, RECORDED
from drake_safety.policies.policy import network_file, read_policy_file
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import episode_rng
from exported_robots import edited
from studies import gate as study
from toy_tasks import declare_outputs

WEAK = {"parameters.effort_share": 0.2}
GAMMA = SimpleNamespace(
    predict_one=lambda *inputs: SimpleNamespace(belief=np.array([0.25, 0.5, 0.25]))
)
COMPARED = partial(compare_loops, num_workers=1, worse_by=0.2)


def pendulum(**changes):
    return load_scenario("pendulum", {f"parameters.{name}": one for name, one in changes.items()})


def numbers(verdict):
    return [
        *(verdict.verdict, verdict.pairs, verdict.difference),
        *(verdict.newly_failing, verdict.no_longer_failing),
    ]


@pytest.fixture(scope="module")
def worse():
    return COMPARED(pendulum(), pendulum(effort_share=0.2))


def test_a_weaker_motor_is_found_to_be_worse_and_what_it_changes_is_named(worse):
    assert (worse.verdict, worse.no_longer_failing) == ("worse", [])
    assert worse.pairs % 16 == 0
    assert worse.difference[-1].low > 0 >= worse.difference[-2].low
    changes = worse.newly_failing
    assert worse.difference[-1].value == pytest.approx(len(changes) / worse.pairs)
    assert all(one.value == 1 and one.belief is None for one in changes)
    first = changes[0]
    assert first.time_s == min(one.time_s for one in changes)
    # Episodes are those that seed and index give.
    loops = [scenario.make_loop() for scenario in (pendulum(), pendulum(effort_share=0.2))]
    one, two = (run_episode(loop, first.episode, seed=11_000_000) for loop in loops)
    assert one.is_safe
    assert (two.cause, two.time_s[-1]) == (first.cause, first.time_s)
    np.testing.assert_array_equal(one.true_state[0], two.true_state[0])


def test_a_stronger_motor_is_better_by_the_same_numbers(worse):
    # It is also not worse, which is known sooner by a difference of 0.2.
    better = COMPARED(pendulum(effort_share=0.2), pendulum(), worse_by=0.01)
    assert (better.verdict, better.pairs) == ("better", worse.pairs)
    lows = [-look.low for look in worse.difference]
    assert [look.high for look in better.difference] == pytest.approx(lows)
    assert better.newly_failing == []
    assert [one.episode for one in better.no_longer_failing] == [
        one.episode for one in worse.newly_failing
    ]


def test_a_loop_that_differs_in_nothing_that_matters_is_not_worse():
    looks = []
    same = COMPARED(pendulum(), pendulum(damping=0.0501), each_look=looks.append)
    assert (same.verdict, same.pairs) == ("not worse", 32)
    assert same.newly_failing == same.no_longer_failing == []
    assert [one.verdict for one in looks] == ["undecided", "not worse"]
    assert [one.pairs for one in looks] == [16, 32]
    assert same.difference[-1].high < 0.2 <= same.difference[0].high


def test_metrics_are_a_constraint_the_tracking_error_or_a_function():
    weak, options = pendulum(effort_share=0.2), {"max_pairs": 16, "worse_by": 0.9}
    unsafe = COMPARED(pendulum(), weak, assessment=GAMMA, **options)
    assert {one.belief for one in unsafe.newly_failing} == {(0.25, 0.5, 0.25)}
    sides = [COMPARED(pendulum(), weak, metric=name, **options) for name in ("front", "back")]
    # Outside the safe set a motion goes on, so that it may violate the other constraint, too.
    assert sum(one.both + len(one.newly_failing) for one in sides) >= unsafe.both
    loose = COMPARED(pendulum(), weak, metric="tracking=100", **options)
    assert (loose.both, loose.newly_failing) == (0, [])
    tight = COMPARED(pendulum(), weak, metric="tracking=0.001", **options)
    assert tight.both == 16
    as_function = COMPARED(pendulum(), weak, metric=lambda one: 0.5 * (not one.is_safe), **options)
    half = as_function.difference[-1].value
    assert half == pytest.approx(0.5 * unsafe.difference[-1].value)
    assert [one.episode for one in as_function.newly_failing] == [
        one.episode for one in unsafe.newly_failing
    ]


def test_a_fall_and_a_diverged_simulation_are_failures():
    loop = SimpleNamespace(
        constraint_names=["tilt", "fall"],
        scenario=pendulum(),
        fall_name="fall",
        watched_features={},
    )
    one = run_episode(pendulum(effort_share=0.2).make_loop(), 6)
    num_rows = len(one.time_s)
    margins = np.ones((num_rows, 2))
    margins[1:, 0], margins[3:, 1] = -1.0, -0.1
    fallen = replace(one, margins=margins)
    for metric, first in (("tilt", 1), ("fall", 3)):
        found = OutcomeReader(loop, metric).read(fallen)
        assert (found.value, found.time_s) == (1.0, one.time_s[first])
    diverged = replace(one, margins=np.ones((num_rows, 2)), cause=DIVERGED, is_safe=False)
    found = OutcomeReader(pendulum().make_loop(), "front").read(diverged)
    assert (found.value, found.time_s) == (1.0, one.time_s[-1])


class Dip(LeafSystem):
    """Margins that are negative for a moment between two rows."""

    def __init__(self, dips):
        super().__init__()

        def margins(time_s):
            return [1.0 - 2.0 * (abs(time_s - dip) < 0.006) for dip in dips]

        def safe(time_s):
            return [float(time_s < 0.125 if dips[0] == dips[1] else min(margins(time_s)) >= 0)]

        ports = dict.fromkeys(RECORDED, (1, lambda time_s: [0.0]))
        ports |= {"margins": (2, margins), "safe": (1, safe)}
        declare_outputs(self, ports, lambda context: [context.get_time()])


@pytest.mark.parametrize(
    ("dips", "metric", "expected"),
    [
        ((0.05, 9.0), "height", (0.0, 0.2, "tilt")),
        ((0.05, 0.15), "height", (1.0, 0.15, "tilt")),
        ((0.15, 0.05), "fall", (1.0, 0.05, "fall")),
        ((9.0, 9.0), "tilt", (1.0, 0.13, "tilt")),  # By the port ``safe`` alone.
    ],
)
def test_a_violation_between_two_rows_is_a_failure_at_its_instant(dips, metric, expected):
    second = "fall" if metric == "fall" else "height"
    builder = DiagramBuilder()
    dip = builder.AddSystem(Dip(dips))
    for i in range(dip.num_output_ports()):
        builder.ExportOutput(dip.get_output_port(i), dip.get_output_port(i).get_name())
    loop = builder.Build()
    words = SimpleNamespace(
        constraint_names=["tilt", second],
        scenario=SimpleNamespace(episode_duration_s=0.2, num_steps=5),
        fall_name="fall",
        watched_features={},
    )
    outcomes = OutcomeReader(words, metric)
    motion = simulate(
        loop,
        lambda context: 0,
        (*RECORDED,),
        End(duration_s=0.2, **outcomes.simulated),
        step_s=0.04,
        watch_period_s=0.01,
        constraint_names=words.constraint_names,
    )
    found = outcomes.read(motion.episode())
    assert (found.value, pytest.approx(found.time_s), found.cause) == expected


@pytest.mark.parametrize(
    ("candidate", "options", "message"),
    [
        ({}, {}, "the candidate is the baseline: scenario 'pendulum', variation 'nominal'"),
        (WEAK, {"metric": "frnt"}, "metric 'frnt': expected one of"),
        (WEAK, {"metric": lambda episode: 2}, "episode 0 has 2.0, expected 0 to 1"),
        (
            {"parameters.start_angle_rad": 0.1},
            {},
            r"pair 0 does not start alike in both loops: entry 0 \(angle\) of 'state' is \S+ in",
        ),
        ({"parameters.plan_angle_rad": 0.1}, {}, "entry 0 of 'plan' is"),
    ],
)
def test_what_cannot_be_compared_is_refused_by_name(candidate, options, message):
    with pytest.raises(ValueError, match=message):
        COMPARED(pendulum(), load_scenario("pendulum", candidate), **options)


@pytest.mark.train
def test_what_was_simulated_is_kept_and_continued_with_the_same_result(tmp_path, worse):
    weak, told = pendulum(effort_share=0.2), []
    kept = {"path": tmp_path, "progress": lambda done, wanted: told.append((done, wanted))}
    COMPARED(pendulum(), weak, max_pairs=10, worse_by=0.01, **kept)
    again = COMPARED(pendulum(), weak, max_pairs=worse.pairs, **kept)
    assert numbers(again) == numbers(worse)
    assert told[0] == (0, 10)
    assert (10, worse.pairs) in told
    # Another candidate has the same baseline; its starts are compared with those of a kept one.
    told.clear()
    with pytest.raises(ValueError, match="'state' is"):
        COMPARED(pendulum(), pendulum(start_angle_rad=0.1), max_pairs=4, **kept)
    kept_sets = [load_episodes(one) for one in tmp_path.iterdir()]
    assert len(kept_sets) == 2  # Nothing is kept of what cannot be compared.
    own = pendulum().simulation_hash()
    (baseline,) = (one for one in kept_sets if one.info.scenario_hash == own)
    ordinary = run_episodes(pendulum(), worse.pairs, seed=11_000_000, num_workers=1)
    assert_identical(baseline, ordinary)


GATE = ("gate", "pendulum", "--workers", 1, "--worse-by", 0.2)


@pytest.mark.train
def test_the_command_says_which_candidate_is_worse_and_replays_an_episode(
    monkeypatch, capsys, tmp_path
):
    weak = ("--candidate", "parameters.effort_share=0.2 variation=actual")
    command = (*GATE, *weak, "--candidate", "parameters.damping=0.0501", "--out", tmp_path)
    assert call(monkeypatch, *command) == 1
    printed = capsys.readouterr().out
    assert "at most 2.5 % a candidate" in printed
    results = Results.read(tmp_path / "gate.json")
    candidates = results.entries["candidates"]
    assert [one["verdict"] for one in candidates.values()] == ["worse", "not worse"]
    first = candidates["parameters.effort_share=0.2 variation=actual"]
    assert first["pairs"] == first["difference"][-1]["n"]
    assert (tmp_path / "gate.png").stat().st_size > 10_000
    from mcap.reader import make_reader

    index = first["newly_failing"][0]["episode"]
    assert f"--replay={index}" in printed
    assert call(monkeypatch, *command, "--replay", index, "--mcap") == 0
    printed = capsys.readouterr().out
    recording = (tmp_path / f"episode-{index}.html").read_text()
    assert recording.count("<iframe srcdoc=") == 3
    for number in range(3):
        with (tmp_path / f"episode-{index}-{number}.mcap").open("rb") as file:
            assert make_reader(file).get_summary().statistics.message_count > 100
    assert "baseline: stays in the safe set" in printed
    assert "variation=actual: leaves the safe set: " in printed


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        (["policy=a/new.onnx", "variation=weak"], ["policy=new.onnx", "variation=weak"]),
        (["policy=a/new.onnx metric=0.1"], ["policy=new.onnx metric=0.1"]),
        (["policy=a/new.onnx", "policy=b/new.onnx"], ["policy=a/new.onnx", "policy=b/new.onnx"]),
    ],
)
def test_a_candidate_is_named_without_its_folder_unless_two_names_are_alike(changes, names):
    assert list(gate.short_names(changes).items()) == list(zip(changes, names, strict=True))


@pytest.mark.train
def test_a_scenario_file_is_a_candidate_and_ctrl_c_tells_what_is_known_so_far(
    monkeypatch, capsys, tmp_path
):
    file = tmp_path / "mine.yaml"
    source = Path(__file__).resolve().parents[1] / "diagrams/pendulum.yaml"
    file.write_text(source.read_text() + "parameters: {damping: 0.0501}\n")
    command = (*GATE, file, "--out", tmp_path)
    assert call(monkeypatch, *command, "--episodes", 8) == 2  # Undecided.
    capsys.readouterr()

    def stopped(*loops, each_look, **options):
        def look(verdict):
            each_look(verdict)
            raise KeyboardInterrupt

        compare_loops(*loops, each_look=look, **options)

    monkeypatch.setattr(gate, "compare_loops", stopped)
    assert call(monkeypatch, *command) == 130
    printed = capsys.readouterr().out
    assert "undecided" in printed
    (name,) = Results.read(tmp_path / "gate.json").entries["candidates"]
    assert name == "mine"


@pytest.mark.parametrize(
    "arguments", [[], ["--alpha", "much"], ["--debug", "--candidate", "variation=actul"]]
)
def test_an_error_has_an_exit_code_of_its_own(monkeypatch, tmp_path, arguments):
    assert call(monkeypatch, *GATE, *arguments, "--out", tmp_path) == 3


def test_what_nobody_expects_is_an_error_too_with_its_traceback(monkeypatch, capsys):
    def fail(*arguments, **options):
        raise ZeroDivisionError("of the package")

    for name in ("changed_plant", "make_app"):
        monkeypatch.setattr(gate if name == "changed_plant" else cli, name, fail)
        assert call(monkeypatch, *GATE, "--candidate", "variation=actual") == 3
        assert "ZeroDivisionError: of the package" in capsys.readouterr().err


GO2, _ = policy_files(load_scenario("go2_walking"))


def go2(tmp_path, **changes):
    """The walking scenario with other words in its policy's file."""
    (tmp_path / "policy.yaml").write_text(edited(GO2.read_text(), changes))
    return load_scenario("go2_walking", {"parameters.policy": str(tmp_path / "policy.yaml")})


def start_of(loop):
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(0, 5))
    return loop_comparison._start_of(loop, context)


def test_another_policy_takes_over_where_the_baselines_has_walked(tmp_path):
    baseline = load_scenario("go2_walking")
    crouched = go2(tmp_path, **{"_thigh_joint: 0.8": "_thigh_joint: 0.9"})
    there = start_of(baseline.make_loop())
    assert np.abs(there["state"][-12:]).max() > 0.1  # In mid-stride.
    alone = start_of(crouched.make_loop())
    with pytest.raises(ValueError, match="pair 5 does not start alike"):
        loop_comparison._check_alike(5, baseline.make_loop(), there, alone)
    taking_over = loop_comparison.make_paired((ComparedPlant(baseline), ComparedPlant(crouched)), 1)
    loop_comparison._check_alike(5, taking_over, there, start_of(taking_over))


def test_a_policy_that_remembers_other_things_cannot_take_over_in_mid_stride(tmp_path):
    clipped = go2(tmp_path, **{"{name: last_action}": "{name: last_action, clip: 5}"})
    pair = ComparedPlant(load_scenario("go2_walking")), ComparedPlant(clipped)
    with pytest.raises(ValueError, match=r"cannot take over in mid-stride.*standing_share: 1"):
        start_of(loop_comparison.make_paired(pair, 1))


def test_a_network_alone_is_a_policy(tmp_path):
    network = network_file(read_policy_file(GO2), str(GO2.parent))
    copy = tmp_path / "new.onnx"
    shutil.copyfile(network, copy)
    changed = gate.changed_plant("go2_walking", f"policy={copy}").scenario
    assert policy_files(changed) == (GO2, str(copy))
    assert copy in changed.task_class().model_files(changed)
    starts = [start_of(load_scenario("go2_walking").make_loop()), start_of(changed.make_loop())]
    loop_comparison._check_alike(5, changed.make_loop(), *starts)


def test_the_study_counts_wrong_verdicts_and_the_pairs_until_a_right_one():
    rng = np.random.default_rng(1)
    baseline = rng.random(400) < 0.3
    candidate = baseline | (rng.random(400) < 0.1)
    found = study.rows(baseline.astype(int), candidate.astype(int), 100)
    failed = [found[name, "failures"].value for name in ("baseline", "candidate", "only one")]
    assert failed[1] - failed[0] == pytest.approx(failed[2])
    for key in (("equal loops", "false_worse"), ("low end", "misses"), ("high end", "misses")):
        assert found[key].value <= 0.08
    assert found["paired", "power"].value == 1.0
    pairs = [found[name, "pairs_until_worse"].value for name in ("paired", "batch", "unpaired")]
    assert 2 * pairs[0] < min(pairs[1:])
    # By the usual formula for two shares.
    assert (study.batch_size(0.01, 0.02), study.batch_size(0.05, 0.1)) == (2529, 474)
    assert study.batch_size(0.1, 0.1) == np.inf


def test_an_episode_in_which_a_controller_found_no_command_fails_and_says_so():
    loop = pendulum().make_loop()
    episode = next(e for e in (run_episode(loop, i, seed=7) for i in range(9)) if e.is_safe)
    for metric in ("unsafe", "front", "tracking=9"):
        reader = OutcomeReader(loop, metric)
        good, bad = (reader.read(replace(episode, num_controller_failures=n)) for n in (0, 3))
        assert (good.value, good.cause, bad.value, bad.cause) == (0.0, "", 1.0, "held actions")
