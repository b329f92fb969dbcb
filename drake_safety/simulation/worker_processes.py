"""Worker processes: one place that maps work over them."""

from __future__ import annotations

import copyreg
import functools
import importlib
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator
from contextlib import closing
from types import BuiltinFunctionType, ModuleType
from typing import Any

from pydrake.systems.framework import LeafSystem

_BATCH = 4  # Episodes, or throws, per call of a worker.
_WATCH_PERIOD_S = 1.0

Progress = Callable[[int, int], None]
"""Called with the number done and in all."""


def batches(indices: list[int]) -> list[list[int]]:
    """Splits a list into batches, one for each call of a worker."""
    return [indices[i : i + _BATCH] for i in range(0, len(indices), _BATCH)]


def run_batches(
    function: Callable[..., list[Any]],
    indices: list[int],
    arguments: Callable[[list[int]], tuple],
    *,
    num_workers: int | None = None,
    progress: Progress | None = None,
    num_done: int = 0,
) -> Generator[Any, None, None]:
    """Calls a function for batches of indices in worker processes; yields results as they finish.

    Args:
        function: A function at module level; returns one result per index.
        indices: The indices.
        arguments: Maps a batch of indices to the function's arguments.
        num_workers: Number of processes; that of cores by default.
        progress: Called with the number done and in all, after each batch.
        num_done: Number done beforehand.
    """
    num_wanted = num_done + len(indices)
    results = parallel_map(function, [arguments(batch) for batch in batches(indices)], num_workers)
    with closing(results):
        for batch in results:
            yield from batch
            num_done += len(batch)
            if progress is not None:
                progress(num_done, num_wanted)


def parallel_map(
    function: Callable[..., Any], arguments: list[tuple], num_workers: int | None = None
) -> Generator[Any, None, None]:
    """Calls ``function(*arguments[i])`` in worker processes; yields results as they finish.

    Every worker has one BLAS thread, and so has this process if it does the work, so that results
    do not depend on the number of workers. On Ctrl-C or any error the workers end; when this
    process is killed they end within a second or two.

    Args:
        function: A function at module level.
        arguments: One tuple per call.
        num_workers: Number of processes; that of cores by default.

    Raises:
        ChildProcessError: A worker was killed.
    """
    import joblib
    from joblib.externals.loky.process_executor import BrokenProcessPool
    from threadpoolctl import threadpool_limits

    num_workers = num_workers or joblib.cpu_count()
    if num_workers == 1 or len(arguments) <= 1:
        with threadpool_limits(1):
            for args in arguments:
                yield function(*args)
        return
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(
            n_jobs=num_workers, return_as="generator_unordered", batch_size=1
        )
        calls = (joblib.delayed(_call_in_worker)(os.getpid(), function, args) for args in arguments)
        results = parallel(calls)
        try:
            for result in results:  # noqa: UP028 (`yield from` would hand Ctrl-C to joblib)
                yield result
        except BrokenProcessPool:
            raise ChildProcessError(
                "a worker process was killed, by the system if memory ran out; what had finished "
                "is kept: run the same again to continue (train: with --resume), with fewer "
                "workers if memory is short"
            ) from None
        except BaseException:
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings():
                # Joblib warns that not all results were consumed.
                warnings.simplefilter("ignore")
                results.close()
            raise


def _call_in_worker(parent: int, function: Callable[..., Any], arguments: tuple) -> Any:
    end_with_parent(parent)
    return function(*arguments)


@functools.cache
def end_with_parent(parent: int) -> None:
    """Ends this process soon after its parent, however that ends.

    Args:
        parent: Process ID of the parent; nothing happens if another process is.
    """
    if os.getppid() != parent:
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD_S)
        os._exit(1)

    threading.Thread(target=watch, name="end_with_parent", daemon=True).start()


def _reduce_builtin(function: Any) -> Any:
    if type(function.__self__).__name__ == "PyCapsule":
        return getattr, (importlib.import_module(function.__module__), function.__name__)
    return function.__reduce__()


# Functions of a notebook or a script are pickled for the workers with all that they use. Two kinds
# of pydrake objects cannot be pickled by name: bound functions such as StabilizingLQRController,
# and the metaclass of its systems, whose module does not exist.
copyreg.pickle(BuiltinFunctionType, _reduce_builtin)
_METACLASS = type(LeafSystem)
vars(sys.modules.setdefault(_METACLASS.__module__, ModuleType(_METACLASS.__module__))).setdefault(
    _METACLASS.__name__, _METACLASS
)
