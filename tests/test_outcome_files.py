"""Verdicts on outcomes that another simulator wrote."""

import json

import numpy as np
import pytest

from command_line import call, python
from drake_safety import compare_loops, load_scenario
from drake_safety.evaluation.outcome_files import compare_outcomes, read_outcomes, write_outcomes
from drake_safety.evaluation.paired_test import interim_estimate
from drake_safety.evaluation.results import Results


def write(path, failed, column="failed", names=None):
    names = range(len(failed)) if names is None else names
    rows = [f"{name},{value}" for name, value in zip(names, failed, strict=True)]
    path.write_text("\n".join([f"episode,{column}", *rows]) + "\n")
    return path


def outcomes(rng, share, names):
    return {name: float(rng.random() < share) for name in names}


@pytest.mark.parametrize(
    ("key", "value", "most", "expected"),
    [
        ("effort_share", 0.2, 2000, "worse"),
        ("damping", 0.0501, 32, "not worse"),
        ("effort_share", 0.2, 20, "undecided"),
    ],
)
def test_the_outcomes_of_simulated_pairs_give_the_same_verdict(
    tmp_path, key, value, most, expected
):
    changed = load_scenario("pendulum", {f"parameters.{key}": value})
    options = {"worse_by": 0.2, "num_workers": 1, "max_pairs": most}
    simulated = compare_loops(load_scenario("pendulum"), changed, **options)
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for file, side in zip(files, zip(*simulated.outcomes, strict=True), strict=True):
        write_outcomes(file, side)
    found = compare_outcomes(*map(read_outcomes, files), worse_by=options["worse_by"])
    assert found.verdict == simulated.verdict == expected
    assert (found.pairs, found.both) == (simulated.pairs, simulated.both)
    names = [int(one.episode) for one in found.newly_failing]
    assert sorted(names) == sorted(one.episode for one in simulated.newly_failing)
    assert found.difference[-1].value == simulated.difference[-1].value


def test_order_does_not_matter_and_other_episodes_are_drawn_into_pairs():
    rng, names = np.random.default_rng(0), [*map(str, range(600))]
    one = outcomes(rng, 0.1, names)
    two = {name: max(value, float(rng.random() < 0.05)) for name, value in one.items()}
    found = compare_outcomes(one, two)
    assert (found.verdict, found.is_paired) == ("worse", True)
    turned = dict(sorted(two.items(), key=lambda item: item[1]))
    assert compare_outcomes(one, turned).difference == found.difference
    # Unpaired the same rates are not enough; sorted files give what others give.
    other = {f"other {name}": value for name, value in turned.items()}
    drawn = compare_outcomes(one, other)
    assert (drawn.verdict, drawn.is_paired, drawn.pairs) == ("undecided", False, 600)
    fewer = compare_outcomes(one, dict([*other.items()][:500]))
    assert (fewer.is_paired, fewer.pairs) == (False, 500)
    # Episodes that a file lacks may have crashed.
    with pytest.raises(
        ValueError, match="599 episodes are in both sets, and 1 in one, such as '7'"
    ):
        compare_outcomes(one, {name: value for name, value in two.items() if name != "7"})


def test_verdicts_on_equal_unpaired_sets_are_seldom_wrong():
    rng, wrong = np.random.default_rng(1), 0
    for k in range(60):
        sides = [outcomes(rng, 0.3, [f"{s}{i}" for i in range(200)]) for s in "ab"]
        by_outcome = [dict(sorted(one.items(), key=lambda item: item[1])) for one in sides]
        wrong += compare_outcomes(*by_outcome, seed=k).verdict == "worse"
    assert wrong <= 8  # 5 % and three standard deviations.


def test_columns_are_failures_shares_or_values_with_a_bound(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text('\ufeffepisode, failed,error,"part, of"\na,True,0.5,0.25\nb,0.0,2,1\n')
    assert read_outcomes(file) == {"a": 1.0, "b": 0.0}
    assert read_outcomes(file, "error=0.5") == {"a": 0.0, "b": 1.0}
    assert read_outcomes(file, "part, of") == {"a": 0.25, "b": 1.0}


def lerobot(successes, seeds=None):
    """`eval_info.json` as lerobot-eval writes it; with seeds, as older versions do."""
    if seeds is None:
        metrics = {"sum_rewards": [0.0] * len(successes), "successes": successes}
        task = {"task_group": "libero", "task_id": 3, "metrics": metrics}
        return {"per_task": [task], "per_group": {}, "overall": {"n_episodes": len(successes)}}
    rows = [
        {"episode_ix": i, "sum_reward": 0.0, "max_reward": 0.0, "success": s, "seed": seed}
        for i, (s, seed) in enumerate(zip(successes, seeds, strict=True))
    ]
    return {"per_episode": rows, "aggregated": {"pc_success": 50.0}}


def test_lerobots_evaluations_are_read(tmp_path):
    file = tmp_path / "eval_info.json"
    file.write_text(json.dumps(lerobot([True, False])))
    assert read_outcomes(file) == {"libero/3/0": 0.0, "libero/3/1": 1.0}
    file.write_text(json.dumps(lerobot([True, False], [1000, 1001])))
    assert read_outcomes(file) == {"seed 1000": 0.0, "seed 1001": 1.0}
    file.write_text(json.dumps(lerobot([True, False], [None, None])))
    assert read_outcomes(file) == {"episode_ix 0": 0.0, "episode_ix 1": 1.0}


@pytest.mark.parametrize(
    ("name", "text", "metric", "message"),
    [
        (
            "a.csv",
            "",
            "failed",
            r"expected one column each of \['episode', 'failed'\]; it has \[\]",
        ),
        (
            "a.csv",
            "episode,fail\n1,0\n",
            "failed",
            r"of \['failed'\]; it has \['episode', 'fail'\]",
        ),
        ("a.csv", "episode,failed,failed\n1,0,1\n", "failed", r"each of \['failed'\]"),
        ("a.csv", "episode,failed\n", "failed", "it has no episodes"),
        ("a.csv", "episode,failed\n1,0\n1,1\n", "failed", "line 3: episode '1' stands twice"),
        (
            "a.csv",
            "episode,failed\n1,0\n2,2\n",
            "failed",
            "line 3: 'failed' must be 0 or 1; got '2'",
        ),
        ("a.csv", "episode,failed\n1\n", "failed", "line 2: 'failed' must be 0 or 1; got ''"),
        ("a.csv", "episode,failed\n,1\n", "failed", "line 2: 'episode' is empty"),
        ("a.csv", "episode,m\n1,-1\n", "m", "line 2: 'm' must be 0 to 1; got '-1'"),
        ("a.csv", "episode,m\n1,nan\n", "m=3", "line 2: 'm' must be a number; got 'nan'"),
        ("a.csv", "episode,m\n1,1\n", "m=x", "expected a column, or COLUMN=BOUND"),
        ("a.csv", "episode,m\n1,1\n", "m=nan", "expected a column, or COLUMN=BOUND"),
        ("a.csv", "episode,m\n1,0,35\n", "m=1", r"line 2: expected 2 cells; the rest is \['35'\]"),
        ("a.json", "{}", "failed", "it is not an eval_info.json of LeRobot: expected 'per_task'"),
        ("a.json", "5", "failed", "it is not an eval_info.json of LeRobot"),
        ("a.json", "[1", "failed", "a.json': Expecting ',' delimiter"),
        ("a.json", '{"per_episode": [{"seed": 1, "success": 2}]}', "failed", "'seed 1': success"),
        ("a.json", "{}", "m", "LeRobot's successes are the metric 'failed'; got 'm'"),
    ],
)
def test_a_bad_file_is_refused_with_its_place(tmp_path, name, text, metric, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_outcomes(tmp_path / name, metric)
    assert str(tmp_path / name) in str(error.value) or "metric" in message


def test_the_command_says_whether_it_pairs_and_ends_as_the_simulated_gate(
    monkeypatch, capsys, tmp_path
):
    rng = np.random.default_rng(0)
    failed = (rng.random(200) < 0.1).astype(int)
    base = write(tmp_path / "base.csv", failed)
    bad = write(tmp_path / "bad.csv", failed | (rng.random(200) < 0.3).astype(int))
    same = write(tmp_path / "same.csv", failed)
    assert call(monkeypatch, "gate", "--outcomes", base, bad, same) == 1
    printed = capsys.readouterr().out
    assert "episodes that newly fail" in printed and "at most 2.5 % a candidate" in printed
    assert "replay" not in printed and "unpaired" not in printed
    assert call(monkeypatch, "gate", "--outcomes", base, same, "--worse-by", 0.05) == 0
    other = write(tmp_path / "other.csv", failed, names=[f"x{k}" for k in range(200)])
    assert call(monkeypatch, "gate", "--outcomes", base, other) == 2
    _, note, end = capsys.readouterr().out.partition("other.csv: no episode is the baseline's")
    assert note and "looks" not in end
    wrong = ([base], [base, same, "--candidate", "a=1"], [base, tmp_path / "gone.csv"])
    for words in (*wrong, [base, base], [base, same, same]):
        assert call(monkeypatch, "gate", "--outcomes", *words) == 3


@pytest.mark.train
def test_the_simulated_gate_writes_outcomes_that_give_its_verdict(monkeypatch, capsys, tmp_path):
    change = ("--candidate", "parameters.effort_share=0.01", "--worse-by", 0.25)
    assert call(monkeypatch, "gate", "pendulum", "--workers", 1, *change, "--out", tmp_path) == 1
    files = [tmp_path / "outcomes-1" / f"{side}.csv" for side in ("baseline", "candidate")]
    assert call(monkeypatch, "gate", "--outcomes", *files, "--worse-by", 0.25) == 1
    head, *rows = files[1].read_text().splitlines()
    assert head == "episode,failed,time_s,cause" and rows[0].startswith("0,1,")
    (one,) = Results.read(tmp_path / "gate.json").entries["candidates"].values()
    assert one["pairs"] == len(rows)


def test_it_needs_none_of_the_extras():
    code = "import sys, drake_safety.cli.gate, drake_safety.evaluation.outcome_files as o; "
    code += "o.compare_outcomes({'a': 0.0}, {'a': 1.0}); "
    code += "print([n for n in ('torch', 'sklearn', 'pyarrow', 'pandas') if n in sys.modules])"
    assert python("-c", code).strip() == "[]"


def test_a_single_look_is_a_look_of_the_sequential_test():
    one, two = {"1": 0.0, "2": 1.0, "3": 0.0}, {"1": 1.0, "2": 1.0, "3": 0.0}
    expected = interim_estimate([1.0, 0.0, 0.0], [], 0.05)
    assert compare_outcomes(one, two).difference == [expected]
