"""Worker processes: one place that maps work over them."""

import importlib
import io
import os
import platform
import socket
import threading
import time
import warnings
from collections.abc import Callable, Generator, Hashable, Iterable
from contextlib import nullcontext
from functools import cache, partial
from operator import attrgetter
from typing import Any, ClassVar, Generic, TypeVar

from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from drake_safety.files.progress import shown
from drake_safety.learning.segments import installed_versions

BATCH_SIZE = 4  # Items that are sent to a worker at a time.
_WATCH_PERIOD_S = 1.0
_DASK_WORKER_KILLED = "KilledWorker"
_lock = threading.RLock()

_Made = TypeVar("_Made")
_Result = TypeVar("_Result")
Progress = Callable[[int, int], None]  # Called with the number done and in all.


class MadeOnce(Generic[_Made]):
    """A diagram that each process makes once; only that of the last key is kept.

    pydrake never frees a system in Python: a loop made for every call would cost 2.4 MB each.
    """

    _made: ClassVar[dict[Hashable, Any]] = {}

    def __init__(self, key: Hashable, make: Callable[[], _Made]) -> None:
        self.key, self.make = key, make

    def __call__(self) -> _Made:
        """Returns the diagram."""
        if self.key not in self._made:
            self._made.clear()
            self._made[self.key] = self.make()
        return self._made[self.key]


def map_items(
    function: Callable[..., _Result],
    items: Iterable[Any],
    *,
    make: MadeOnce[Any] | None = None,
    num_workers: int | None = None,
    batch_size: int = BATCH_SIZE,
    progress: Progress | bool | None = None,
    num_done: int = 0,
    stage: str = "simulations",
) -> Generator[_Result, None, None]:
    """Calls a function of each item in worker processes; yields results as batches finish.

    With ``make`` it is called with the worker's diagram and an item. Within
    ``joblib.parallel_config`` of another backend than loky that backend's workers are used. Every
    call has one BLAS thread, so that results do not depend on the number of workers.
    """
    import joblib
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import BrokenProcessPool
    from joblib.parallel import get_active_backend

    backend = type(get_active_backend()[0]).__name__
    is_local = backend in ("LokyBackend", "SequentialBackend")
    if not is_local and num_workers is not None:
        raise ValueError(f"joblib's {backend} has its own number of workers: leave out num_workers")
    num_workers = num_workers or joblib.cpu_count()
    # Loops of many plants make a worker so large that joblib replaces it, and loses nothing.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs")
    pending = list(items)
    batches = [pending[i : i + batch_size] for i in range(0, len(pending), batch_size)]
    call = partial(_call_batch, function, make, _versions())
    is_alone = is_local and (num_workers == 1 or len(batches) <= 1)
    local: dict[str, Any] = {"initializer": end_with_parent, "initargs": (os.getpid(),)}
    with (
        shown(progress, lambda stages: partial(stages, stage)) as report,
        joblib.parallel_config("loky", n_jobs=num_workers, inner_max_num_threads=1, **local)
        if is_local and not is_alone
        else nullcontext(),
    ):
        report = report or (lambda done, wanted: None)
        num_wanted = num_done + len(pending)
        report(num_done, num_wanted)
        results: Generator[list[_Result], None, None]
        if is_alone:
            results = (call(batch) for batch in batches)
        else:
            results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(
                joblib.delayed(call)(batch) for batch in batches
            )
        try:
            for batch in results:
                yield from batch
                num_done += len(batch)
                report(num_done, num_wanted)
        except BaseException as error:
            is_killed = isinstance(error, BrokenProcessPool)
            is_killed |= type(error).__name__ == _DASK_WORKER_KILLED
            if is_local and not is_alone and not is_killed:
                # With other arguments than joblib's it would replace the executor, and wait for a
                # thread that waits for its lock.
                get_reusable_executor(reuse=True).shutdown(wait=False, kill_workers=True)
            with warnings.catch_warnings():
                # Joblib warns that not all results were consumed.
                warnings.simplefilter("ignore")
                results.close()
            if is_killed:
                text = "a worker process was killed, by the system if memory ran out; run the same"
                text += " again to continue (train: with --resume), perhaps with fewer workers"
                raise ChildProcessError(text) from None
            raise


def _call_batch(
    function: Callable[..., _Result],
    make: MadeOnce[Any] | None,
    versions: dict[str, str],
    batch: list[Any],
) -> list[_Result]:
    from threadpoolctl import threadpool_limits

    if (own := _versions()) != versions:
        raise ValueError(f"{socket.gethostname()} has {own}, expected {versions}, as here")
    # Threads of one worker would share its diagram.
    with _lock, threadpool_limits(1):
        diagram = [] if make is None else [make()]
        return [function(*diagram, item) for item in batch]


@cache
def _versions() -> dict[str, str]:
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **installed_versions("drake", "numpy")}


def end_with_parent(parent: int) -> None:
    """Ends this worker soon after its parent, however that ends; at once if it has."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD_S)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=watch, name="end_with_parent", daemon=True).start()


class CloudPickled:
    """A user's function, which reaches workers from a notebook or a script too."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Calls the function."""
        return self._function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        import cloudpickle

        class Pickler(cloudpickle.Pickler):
            def reducer_override(self, sent: Any) -> Any:
                # Drake's bound functions and the metaclass of its systems lack a module.
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
