"""Files are complete or not there, also when other processes write them."""

import os
import subprocess
import sys

import pytest

from drake_safety.files.atomic import replacing


def test_what_a_running_process_is_writing_stays_and_what_a_dead_one_left_goes(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    running, dead = (tmp_path / f".a.json.{p}.tmp" for p in (os.getppid(), ended.pid))
    foreign = tmp_path / ".a.json.b.tmp"
    for file in (running, dead, foreign):
        file.write_text("half")
    with replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("whole")
    assert running.read_text() == foreign.read_text() == "half"
    assert not dead.exists()
    assert (tmp_path / "a.json").read_text() == "whole"


def test_a_file_that_is_not_finished_leaves_what_was_there(tmp_path):
    (tmp_path / "a.json").write_text("before")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]
