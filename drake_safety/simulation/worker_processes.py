"""Worker processes: one place that maps work over them."""

from __future__ import annotations

import importlib
import io
import os
import platform
import socket
import threading
import time
import warnings
from collections.abc import Callable, Generator, Hashable, Iterable
from contextlib import closing, nullcontext
from functools import cache, partial
from operator import attrgetter
from typing import Any, ClassVar, Generic, TypeVar

from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from drake_safety.files.progress import shown
from drake_safety.learning.segments import installed_versions

BATCH_SIZE = 4
"""Number of items that are sent to a worker at a time."""
_WATCH_PERIOD_S = 1.0
_LOCAL_BACKENDS = ("LokyBackend", "SequentialBackend")
_DASKS = "KilledWorker"
_TURN = threading.RLock()

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")
_Result = TypeVar("_Result")
Progress = Callable[[int, int], None]
"""Called with the number done and in all."""


def map_items(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    *,
    num_workers: int | None = None,
    batch_size: int = BATCH_SIZE,
    progress: Progress | bool | None = None,
    num_done: int = 0,
    stage: str = "simulations",
) -> Generator[_Result, None, None]:
    """Calls ``function(item)`` in worker processes; yields results as batches finish.

    Within ``joblib.parallel_config`` of another backend than loky, or :func:`cluster.connected`,
    that backend's workers are used.

    Every call has one BLAS thread, so that results do not depend on the number of workers. On
    Ctrl-C or any error the workers end; when this process is killed they end within a second or
    two.

    Args:
        num_workers: Number of processes; that of cores by default. 1 runs in this process.
        batch_size: Number of items that are sent to a worker at a time.
        progress: Called with the number done and in all, at the start and after each batch; True
            shows it.
        num_done: Number that had been done before.

    Raises:
        ChildProcessError: A worker was killed.
        ValueError: A number of processes is given, but the backend has its own, or a worker has
            other versions of Python, Drake, NumPy or this package.
    """
    pending = list(items)
    batches = [pending[i : i + batch_size] for i in range(0, len(pending), batch_size)]
    results = _map_batches(partial(_called, _versions(), function), batches, num_workers)
    with shown(progress, lambda stages: partial(stages, stage)) as report, closing(results):
        report = report or (lambda done, wanted: None)
        num_wanted = num_done + len(pending)
        report(num_done, num_wanted)
        for batch in results:
            yield from batch
            num_done += len(batch)
            report(num_done, num_wanted)


def _map_batches(
    call: Callable[[list[_Item]], list[_Result]],
    batches: list[list[_Item]],
    num_workers: int | None,
) -> Generator[list[_Result], None, None]:
    import joblib
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import BrokenProcessPool
    from joblib.parallel import get_active_backend

    backend = type(get_active_backend()[0]).__name__
    is_local = backend in _LOCAL_BACKENDS
    if not is_local and num_workers is not None:
        who = "a cluster" if backend.startswith("Dask") else f"joblib's {backend}"
        raise ValueError(
            f"{who} has its own number of workers; got {num_workers}: leave out num_workers, on "
            "the command line --workers"
        )
    num_workers = num_workers or joblib.cpu_count()
    if is_local and (num_workers == 1 or len(batches) <= 1):
        yield from map(call, batches)
        return
    local = {"initializer": end_with_parent, "initargs": (os.getpid(),)}
    with (
        joblib.parallel_config("loky", n_jobs=num_workers, inner_max_num_threads=1, **local)
        if is_local
        else nullcontext()
    ):
        results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(
            joblib.delayed(call)(batch) for batch in batches
        )
        try:
            for result in results:  # noqa: UP028 (`yield from` would hand Ctrl-C to joblib)
                yield result
        except BaseException as error:
            is_killed = isinstance(error, BrokenProcessPool) or type(error).__name__ == _DASKS
            if is_local and not is_killed:
                # With other arguments than joblib's it would replace the executor, and wait for a
                # thread that waits for its lock.
                get_reusable_executor(reuse=True).shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings():
                # Joblib warns that not all results were consumed.
                warnings.simplefilter("ignore")
                results.close()
            if is_killed:
                raise ChildProcessError(
                    "a worker process was killed, by the system if memory ran out; what had "
                    "finished is kept: run the same again to continue (train: with --resume), with "
                    "fewer workers if memory is short"
                ) from None
            raise


def _called(
    versions: dict[str, str], function: Callable[[_Item], _Result], batch: list[_Item]
) -> list[_Result]:
    from threadpoolctl import threadpool_limits

    here = _versions()
    for name, expected in versions.items():
        if here.get(name) != expected:
            raise ValueError(
                f"the worker at {socket.gethostname()} has {name} {here.get(name)}, expected "
                f"{expected}, as here: install the same there"
            )
    # Threads of one worker would share its loops.
    with _TURN, threadpool_limits(1):
        return [function(item) for item in batch]


@cache
def _versions() -> dict[str, str]:
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **installed_versions("drake", "numpy")}


def end_with_parent(parent: int) -> None:
    """Ends this worker soon after its parent, however that ends; at once if it has.

    A worker whose parent is killed while it starts would else wait for minutes, or for ever, when
    it sends a result that nobody reads.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD_S)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=watch, name="end_with_parent", daemon=True).start()


class MadeOnce(Generic[_Made]):
    """A diagram that each process makes once, when it is first called.

    It is sent to workers with all that ``make`` uses. pydrake never frees a system in Python: a
    loop made for every call would cost 2.4 MB each. Only the last one is kept.

    Args:
        key: Tells diagrams apart.
    """

    _made: ClassVar[dict[Hashable, Any]] = {}

    def __init__(self, key: Hashable, make: Callable[[], _Made]) -> None:
        self._key, self.make = key, make

    def __call__(self) -> _Made:
        """The diagram."""
        if self._key not in self._made:
            self._made.clear()
            self._made[self._key] = self.make()
        return self._made[self._key]

    def run(self, function: Callable[..., _Result], *arguments: Any, **options: Any) -> _Result:
        """Calls a function of the diagram and of more arguments."""
        return function(self(), *arguments, **options)


class Sent:
    """A user's function, which reaches workers from a notebook or a script too.

    It is sent with all that it uses, as joblib sends such functions, for whose pickling Drake lacks
    two things: a module of its bound functions, such as StabilizingLQRController, and one of the
    metaclass of its systems.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Calls the function."""
        return self._function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        import cloudpickle

        class Pickler(cloudpickle.Pickler):
            def reducer_override(self, sent: Any) -> Any:
                if sent is type(LeafSystem):
                    return type, (LeafSystem,)
                module = getattr(sent, "__module__", None) or ""
                # Their type is that of Python's built-in functions with pybind11.
                if type(sent) is type(RigidTransform.Identity) and module.startswith("pydrake"):
                    return _imported, (module, sent.__qualname__.removeprefix("PyCapsule."))
                return super().reducer_override(sent)

        with io.BytesIO() as file:
            Pickler(file).dump(self._function)
            return cloudpickle.loads, (file.getvalue(),)


def _imported(module: str, name: str) -> Any:
    return attrgetter(name)(importlib.import_module(module))
