"""Files that are complete or not there, and folders with one writer."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout


@contextlib.contextmanager
def replacing(final: Path) -> Iterator[Path]:
    """A temporary file beside a final one, renamed to it on success, removed on any exception."""
    # Readers of folders (pyarrow, pandas) skip names that start with a dot.
    temporary = final.with_name(f".{final.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        # The bytes reach the disk before the name does.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(final)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        text = f"{final} cannot be written: {why}; its earlier content is kept"
        raise OSError(text) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes) -> None:
    """Writes a file whole, in UTF-8, by :func:`replacing`; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def lock_folder(path: Path) -> BaseFileLock:
    """Makes a folder if it does not exist, and locks it until this process ends or releases it."""
    path.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path / ".lock", thread_local=False)
    try:
        # The operating system unlocks it when the process ends, however that happens.
        lock.acquire(timeout=0)
    except Timeout:
        what = (
            "is being written by another process or writer: wait for it, or choose another folder"
        )
        raise ValueError(f"{path} {what}") from None
    return lock
