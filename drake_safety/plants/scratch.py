"""Scratch: memory that every thread has for itself."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Scratch(threading.local, Generic[_T]):
    """A value that a calculation overwrites, one for each thread.

    Systems of one diagram share a robot's model, and Drake's users expect that a diagram can be
    simulated in several threads, each with a Context of its own.

    Args:
        make: Makes the value; called once in every thread that uses it.
    """

    def __init__(self, make: Callable[[], _T]):
        # A subclass of threading.local is initialised anew in each thread.
        self.value = make()
