"""Worker processes: one place that maps work over them."""

from __future__ import annotations

import copyreg
import importlib
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from operator import attrgetter
from types import ModuleType
from typing import Any

from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from drake_safety.files.progress import shown

_BATCH = 4  # Episodes, or throws, per call of a worker.
_WATCH_PERIOD_S = 1.0
_LOCAL_BACKENDS = ("LokyBackend", "SequentialBackend")

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
    progress: Progress | bool | None = None,
    num_done: int = 0,
    stage: str = "simulations",
) -> Generator[Any, None, None]:
    """Calls a function for batches of indices in worker processes; yields results as they finish.

    Args:
        function: A function at module level; returns one result per index.
        indices: The indices.
        arguments: Maps a batch of indices to the function's arguments.
        num_workers: Number of processes; that of cores by default.
        progress: Called with the number done and in all, at the start and after each batch; True
            shows it.
        num_done: Number done beforehand.
        stage: Name under which it is shown.
    """
    num_wanted = num_done + len(indices)
    results = parallel_map(function, [arguments(batch) for batch in batches(indices)], num_workers)
    with shown(progress, lambda stages: partial(stages, stage)) as report, closing(results):
        if report is not None:
            report(num_done, num_wanted)
        for batch in results:
            yield from batch
            num_done += len(batch)
            if report is not None:
                report(num_done, num_wanted)


def parallel_map(
    function: Callable[..., Any], arguments: list[tuple], num_workers: int | None = None
) -> Generator[Any, None, None]:
    """Calls ``function(*arguments[i])`` in worker processes; yields results as they finish.

    Within ``joblib.parallel_config`` of another backend than loky, or :func:`cluster.connected`,
    that backend's workers are used; scenarios travel as text, with the user's files.

    Every worker has one BLAS thread, and so has this process if it does the work, so that results
    do not depend on the number of workers. On Ctrl-C or any error the workers end; when this
    process is killed they end within a second or two.

    Args:
        function: A function at module level.
        arguments: One tuple per call.
        num_workers: Number of processes; that of cores by default.

    Raises:
        ChildProcessError: A worker was killed.
        ValueError: A number of processes is given, but another backend has its own.
    """
    import joblib
    from joblib.externals.loky.process_executor import BrokenProcessPool
    from joblib.parallel import get_active_backend
    from threadpoolctl import threadpool_limits

    backend = get_active_backend()[0]
    if type(backend).__name__ not in _LOCAL_BACKENDS:
        yield from _map_remotely(function, arguments, num_workers)
        return
    num_workers = num_workers or joblib.cpu_count()
    if num_workers == 1 or len(arguments) <= 1:
        with threadpool_limits(1):
            for args in arguments:
                yield function(*args)
        return
    backend_options = {"initializer": end_with_parent, "initargs": (os.getpid(),)}
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1, **backend_options):
        parallel = joblib.Parallel(
            n_jobs=num_workers, return_as="generator_unordered", batch_size=1
        )
        results = parallel(joblib.delayed(function)(*args) for args in arguments)
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

            # With other arguments than joblib's it would replace the executor, and wait for a
            # thread that waits for its lock.
            get_reusable_executor(reuse=True).shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings():
                # Joblib warns that not all results were consumed.
                warnings.simplefilter("ignore")
                results.close()
            raise


def _map_remotely(
    function: Callable[..., Any], arguments: list[tuple], num_workers: int | None
) -> Generator[Any, None, None]:
    """`parallel_map` by the active backend of joblib, which does lost calls again."""
    import joblib

    from drake_safety.simulation.cluster import Parcel, RemoteCall, local_versions, packed
    from drake_safety.simulation.scenario import Scenario

    if num_workers is not None:
        raise ValueError(
            f"a cluster has its own number of workers; got {num_workers}: leave out num_workers, "
            "on the command line --workers"
        )
    parcels: dict[int, Parcel] = {}

    def to_send(argument: Any) -> Any:
        if not isinstance(argument, Scenario):
            return argument
        if id(argument) not in parcels:
            parcels[id(argument)] = packed(argument)
        return parcels[id(argument)]

    call = joblib.delayed(RemoteCall(function=function, versions=local_versions()))
    calls = [call(*map(to_send, args)) for args in arguments]
    results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)
    try:
        for result in results:  # noqa: UP028 (`yield from` would hand Ctrl-C to joblib)
            yield result
    except BaseException as error:
        with warnings.catch_warnings():
            # Joblib warns that not all results were consumed.
            warnings.simplefilter("ignore")
            results.close()
        if type(error).__name__ == "KilledWorker":
            raise ChildProcessError(
                "workers of the cluster were killed again and again at the same episodes, perhaps "
                "because memory ran out; what had finished is kept: run the same again to continue "
                "(train: with --resume)"
            ) from None
        raise


def end_with_parent(parent: int) -> None:
    """Ends this worker soon after its parent, however that ends; at once if it has.

    A worker whose parent is killed while it starts would else wait for minutes, or for ever, when
    it sends a result that nobody reads.

    Args:
        parent: Process ID of the parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD_S)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=watch, name="end_with_parent", daemon=True).start()


def _named(module: str, name: str) -> Any:
    return attrgetter(name)(importlib.import_module(module))


def _reduce_bound(function: Any) -> Any:
    # pybind11 binds a function as Python's built-in methods are, to a capsule of its own.
    owner = getattr(function, "__self__", None)
    if owner is not None and type(owner).__name__ != "PyCapsule":
        return function.__reduce__()
    return _named, (function.__module__, function.__qualname__.removeprefix("PyCapsule."))


# Functions of a notebook or a script are pickled for the workers with all that they use. Two kinds
# of pydrake objects cannot be pickled by name: bound functions such as StabilizingLQRController,
# whose type is Python's own with pybind11 and another with nanobind, and the metaclass of its
# systems, whose module does not exist.
copyreg.pickle(type(RigidTransform.Identity), _reduce_bound)
_METACLASS = type(LeafSystem)
vars(sys.modules.setdefault(_METACLASS.__module__, ModuleType(_METACLASS.__module__))).setdefault(
    _METACLASS.__name__, _METACLASS
)
