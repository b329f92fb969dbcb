"""Files are complete or not there, also when other processes write them."""

import errno
import os
from pathlib import Path

import pytest

from drake_safety.evaluation.figure_style import new_figure, save
from drake_safety.files.atomic import replacing, write_file


def test_file_that_another_process_is_writing_stays(tmp_path):
    other = tmp_path / f".a.json.{os.getppid()}.tmp"
    other.write_text("half")
    write_file(tmp_path / "a.json", "whole")
    assert other.read_text() == "half"


def test_file_that_is_not_finished_leaves_the_earlier_one(tmp_path):
    (tmp_path / "a.json").write_text("before")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]


def test_full_disk_leaves_the_earlier_files(tmp_path, monkeypatch):
    files = [tmp_path / "figure.png", tmp_path / "figure.svg", tmp_path / "page.html"]
    for file in files:
        file.write_text("before")

    def full_disk(self, content):
        with self.open("wb") as file:
            file.write(content[:100])
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    said = r"cannot be written: No space left on device; its earlier content"
    with pytest.raises(OSError, match=said):
        save(new_figure(1.0, 1.0), files[0])
    with pytest.raises(OSError, match=said):
        write_file(files[2], "after")
    assert sorted(tmp_path.iterdir()) == files
    assert {file.read_text() for file in files} == {"before"}
