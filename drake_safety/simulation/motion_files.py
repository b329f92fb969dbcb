"""Pairs of motions on disk, undisturbed and pushed.

A folder has an ``info.json`` with the metadata of the set, as that of episodes does, and a
``motions-NNNNN.npz`` for each pair: arrays ``undisturbed.NAME`` and ``pushed.NAME``, in SI units,
without pickles. A file with its final name is complete.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.files.atomic import replacing
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.simulation.dataset import open_folder
from drake_safety.simulation.watched_motion import WatchedMotion

Pair = tuple[WatchedMotion, WatchedMotion]
"""A motion undisturbed, and pushed."""

_KINDS = ("undisturbed", "pushed")
_NAME = re.compile(r"motions-(\d{5,})\.npz")
_FIELDS = tuple(field.name for field in fields(WatchedMotion))


class MotionFolder:
    """A folder of pairs of motions of one set.

    Args:
        path: The folder; made if it does not exist.
        info: Metadata of the set.

    Raises:
        ValueError: The folder holds another set.
    """

    def __init__(self, path: str | PathLike[str], info: EpisodesInfo):
        self.path = Path(path)
        open_folder(self.path, info)

    def completed(self) -> set[int]:
        """Indices of the pairs in the folder."""
        names = (_NAME.fullmatch(file.name) for file in self.path.iterdir())
        return {int(match[1]) for match in names if match}

    def save(self, pair: Pair) -> None:
        """Writes a pair atomically.

        Raises:
            ValueError: The motions have different indices.
        """
        indices = [motion.index for motion in pair]
        if indices[0] != indices[1]:
            raise ValueError(f"{self.path}: a pair has one index; got {indices}")
        arrays: dict[str, Any] = {
            f"{kind}.{name}": np.asarray(getattr(motion, name))
            for kind, motion in zip(_KINDS, pair, strict=True)
            for name in _FIELDS
        }
        with replacing(self._file(indices[0])) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    def load(self, index: int) -> Pair:
        """Reads a pair, bit for bit as it was saved.

        Raises:
            ValueError: The file is missing, truncated or damaged.
        """
        file = self._file(index)
        try:
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
                undisturbed, pushed = (_motion(arrays, kind) for kind in _KINDS)
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{file} holds no pair of motions, or is damaged ({error!r}); remove it and "
                "resume: the motions will be simulated again"
            ) from error
        return undisturbed, pushed

    def _file(self, index: int) -> Path:
        return self.path / f"motions-{index:05d}.npz"


def _motion(arrays: np.lib.npyio.NpzFile, kind: str) -> WatchedMotion:
    values: dict[str, Any] = {name: arrays[f"{kind}.{name}"] for name in _FIELDS}
    # Numbers were stored as arrays without dimensions.
    return WatchedMotion(
        **{name: value if value.ndim else value.item() for name, value in values.items()}
    )
