import numpy as np
import pytest

from drake_safety.evaluation.results import Results
from drake_safety.learning.seeds import RELEASE
from studies.harness import kept, open_study

CALLS = []


def squared(number):
    CALLS.append(number)
    return number, {"square": np.array(number**2), "text": np.array("why")}


def test_what_is_kept_is_not_called_again_and_a_stopped_study_goes_on(tmp_path):
    CALLS.clear()
    work = range(4)

    def stop(done, total):
        assert total == 4
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kept(tmp_path, work, squared, workers=1, progress=stop)
    assert CALLS == [0, 1]
    reports = []
    found = kept(
        tmp_path, work, squared, workers=1, progress=lambda *report: reports.append(report)
    )
    assert CALLS == [0, 1, 2, 3]
    assert reports == [(2, 4), (3, 4), (4, 4)]
    assert [int(one["square"]) for one in found] == [0, 1, 4, 9]
    assert str(found[3]["text"]) == "why"
    # No half-written file, and a damaged one is told of.
    assert sorted(file.name for file in tmp_path.iterdir()) == [f"{i:05d}.npz" for i in range(4)]
    (tmp_path / "00000.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"00000\.npz is damaged .*: remove it"):
        kept(tmp_path, work, squared, workers=1)


def test_a_study_says_whether_its_seeds_are_those_of_the_release(tmp_path):
    for release, use in ((False, "development"), (True, "release")):
        with open_study("tried", "pendulum", tmp_path, seed=5, release=release) as study:
            assert study.seed == 5 + RELEASE * release
        entries = Results.read(tmp_path / "tried.json").entries
        assert entries["seed"] == study.seed and entries["seed_use"].split()[0] == use
