"""One thread for BLAS around a tick: the idle threads of a pool would spin for milliseconds."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from contextlib import ContextDecorator
from threading import Lock
from typing import Any

from threadpoolctl import ThreadpoolController


class OneBlasThread(ContextDecorator):
    """A context in which BLAS runs in the calling thread; the settings are restored after it.

    Contexts may be nested, and entered by several threads at once. It also decorates functions.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._depth = 0
        self._changed: list[tuple[Callable[[int], Any], Callable[[], int], int]] = []

    def __enter__(self) -> OneBlasThread:
        with self._lock:
            self._depth += 1
            if self._depth == 1:
                # Its import loads a BLAS of its own.
                for get, set_to in _libraries("scipy.linalg" in sys.modules):
                    if (number := get()) != 1:
                        set_to(1)
                        self._changed.append((set_to, get, number))
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                for set_to, get, number in self._changed:
                    if get() == 1:
                        set_to(number)
                self._changed.clear()


ONE_BLAS_THREAD = OneBlasThread()
"""Process-wide instance."""


@functools.cache
def _libraries(has_scipy: bool) -> list[tuple[Callable[[], int], Callable[[int], Any]]]:
    """Functions that get and set the number of threads, of every loaded BLAS."""
    del has_scipy
    libraries = []
    for library in ThreadpoolController().select(user_api="blas").lib_controllers:
        functions = (library.get_num_threads, library.set_num_threads)
        if library.internal_api == "openblas" and library.threading_layer == "pthreads":
            # threadpoolctl looks the symbols up anew at each call, ten times the cost of it.
            functions = _openblas_functions(library.dynlib) or functions
        libraries.append(functions)
    return libraries


def _openblas_functions(library: Any) -> tuple[Callable[[], int], Callable[[int], Any]] | None:
    for prefix in ("", "scipy_"):
        for suffix in ("", "64_", "_64"):
            get, set_to = (
                getattr(library, f"{prefix}openblas_{verb}_num_threads{suffix}", None)
                for verb in ("get", "set")
            )
            if get is not None and set_to is not None:
                return get, set_to
    return None
