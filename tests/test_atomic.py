"""Files are complete or not there, also when other processes write them."""

import os

import pytest

from drake_safety.files.atomic import replacing


def test_what_another_process_is_writing_stays(tmp_path):
    other = tmp_path / f".a.json.{os.getppid()}.tmp"
    other.write_text("half")
    with replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("whole")
    assert other.read_text() == "half"
    assert (tmp_path / "a.json").read_text() == "whole"


def test_a_file_that_is_not_finished_leaves_what_was_there(tmp_path):
    (tmp_path / "a.json").write_text("before")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]
