"""Files are complete or not there, also when other processes write them."""

import ast
import errno
import os
from pathlib import Path

import pytest

import drake_safety
from drake_safety.evaluation.figure_style import new_figure, save
from drake_safety.files.atomic import replacing, write_file


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


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("page.html", lambda path: write_file(path, "after")),
        ("figure.png", lambda path: save(new_figure(1.0, 1.0), path)),
        ("figure.svg", lambda path: save(new_figure(1.0, 1.0), path)),
    ],
)
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, name, write):
    files = [tmp_path / "figure.png", tmp_path / "figure.svg", tmp_path / "page.html"]
    for file in files:
        file.write_text("before")

    def full_disk(self, content):
        with self.open("wb") as file:
            file.write(content[:100])
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match=r"cannot be written: No space left on device; what had"):
        write(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == files
    assert {file.read_text() for file in files} == {"before"}


# They write into a folder that is not there before, and is then moved or removed as a whole.
SCRATCH = {"mjcf.py", "robot_template.py", "urdf_copy.py", "messages.py", "atomic.py"}
WRITES = {"write_text", "write_bytes", "savefig", "imsave", "copyfile"}


def test_only_one_module_writes_what_users_keep():
    package = Path(drake_safety.__file__).parent
    for path in [*package.rglob("*.py"), *(package.parent / "diagrams").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_write = isinstance(node, ast.Attribute) and node.attr in WRITES
            in_memory = path.name == "figure_style.py" and is_write and node.attr == "savefig"
            assert not is_write or in_memory or path.name in SCRATCH, (path, node.lineno)
