"""A cluster of workers: dask's scheduler as joblib's backend, and what travels to its workers."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import importlib
import platform
import socket
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from drake_safety.extras import require_extra
from drake_safety.learning.segments import installed_versions
from drake_safety.simulation.scenario import Scenario, own_files, parse_scenario, source_digest

_LARGEST_PARCEL = 64 * 1024**2  # Bytes of files; they travel with every batch.
_TURN = threading.Lock()
_ROBOT_FOLDER = "robot"


@contextlib.contextmanager
def connected(address: str, *, timeout_s: float = 20.0) -> Iterator[None]:
    """Simulates on a dask cluster, in place of processes of this machine, while the block runs.

    Args:
        address: Address of dask's scheduler, such as "tcp://10.0.0.1:8786".
        timeout_s: Time to wait for the scheduler, and for its first worker [s].

    Raises:
        MissingExtraError: dask is not installed.
        ValueError: No scheduler answers, or it has no workers.
    """
    require_extra("cluster", f"cluster '{address}'")
    import joblib
    from distributed import Client

    try:
        client = Client(address, timeout=timeout_s)
    # Another server's answer may be taken for the size of a huge message.
    except (MemoryError, OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"no dask scheduler answers at '{address}': {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=timeout_s)
        except TimeoutError:
            raise ValueError(
                f"the dask scheduler at '{address}' has no workers: start some, "
                f"`dask worker {address} --nthreads 1`"
            ) from None
        with joblib.parallel_config("dask", client=client, n_jobs=-1):
            yield


@dataclass(frozen=True, kw_only=True)
class Parcel:
    """A scenario as text, with the files of the user that it needs.

    Attributes:
        name: The scenario's name.
        text: The scenario as YAML; the path of a robot of the user's is relative.
        files: Contents by path, relative to a folder of the worker: the folder of the robot, and
            the modules of the task.
        modules: Names of the task's modules.
    """

    name: str
    text: str
    files: dict[str, bytes]
    modules: tuple[str, ...]

    @property
    def digest(self) -> str:
        """SHA-256 of text and files."""
        digest = hashlib.sha256(f"{self.name}\0{self.text}".encode())
        for name in sorted(self.files):
            digest.update(name.encode() + b"\0" + self.files[name] + b"\0")
        return digest.hexdigest()


def packed(scenario: Scenario) -> Parcel:
    """Packs a scenario with what a worker does not have.

    What pip has installed, this package among it, is not packed: a worker has it.

    Args:
        scenario: The scenario.

    Raises:
        ValueError: The task is no file, the files are too large, or a model file lies elsewhere
            than in the folder of the robot.
    """
    own, files = copy.copy(scenario), {}
    task = scenario.task_class()
    if Path(scenario.robot).suffix in (".yaml", ".yml"):
        robot = Path(scenario.robot)
        own.robot = f"{_ROBOT_FOLDER}/{robot.name}"
        for file in sorted(robot.parent.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                name = f"{_ROBOT_FOLDER}/{file.relative_to(robot.parent).as_posix()}"
                files[name] = file
        for file in map(Path, task.model_files(scenario)):
            if not (_is_installed(file) or file.resolve().is_relative_to(robot.parent.resolve())):
                raise ValueError(
                    f"scenario '{scenario.name}': the workers of a cluster have no '{file}'; move "
                    f"it into the folder of the robot, '{robot.parent}'"
                )
    modules = _own_modules(task.__module__, scenario.name)
    files |= {name.replace(".", "/") + ".py": file for name, file in modules.items()}
    size = sum(file.stat().st_size for file in files.values())
    if size > _LARGEST_PARCEL:
        raise ValueError(
            f"scenario '{scenario.name}': its robot's folder and its task have {size / 1e6:.0f} "
            f"MB, more than the {_LARGEST_PARCEL / 1e6:.0f} MB that are sent to a cluster's workers"
        )
    return Parcel(
        name=scenario.name,
        text=own.to_yaml(),
        files={name: file.read_bytes() for name, file in files.items()},
        modules=tuple(modules),
    )


def _is_installed(file: Path) -> bool:
    package = Path(__file__).resolve().parents[1]
    roots = [Path(path) for path in sysconfig.get_paths().values()]
    # In a checkout, models and diagrams stand beside the package.
    roots += [package, *(package.parent / name for name in ("models", "diagrams"))]
    return any(file.resolve().is_relative_to(root.resolve()) for root in roots)


def _own_modules(task_module: str, scenario_name: str) -> dict[str, Path]:
    """Files of the modules of a task that pip has not installed, by name."""
    main = sys.modules[task_module]
    if task_module == "__main__" or not getattr(main, "__file__", None):
        raise ValueError(
            f"scenario '{scenario_name}': the workers of a cluster cannot import the task's module "
            f"'{task_module}'; put it into a file"
        )
    if _is_installed(Path(str(main.__file__))):
        return {}
    wanted = own_files(main)
    found: dict[str, Path] = {}
    for name, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "")
        if file in wanted and name != "__main__":
            found[name] = file
    return found


def local_versions() -> dict[str, str]:
    """What this machine and the workers must have in common, by name."""
    versions = installed_versions("drake", "numpy")
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **versions, "drake_safety's source code": _code_digest()}


@cache
def _code_digest() -> str:
    return source_digest()


@dataclass(frozen=True, kw_only=True, eq=False)
class RemoteCall:
    """A function, called by a worker of a cluster.

    Attributes:
        function: A function at module level.
        versions: What the worker must have, see `local_versions`.
    """

    function: Callable[..., Any]
    versions: dict[str, str]

    @property
    def __name__(self) -> str:
        # The name of the task on dask's dashboard.
        return self.function.__name__.strip("_")

    def __call__(self, *arguments: Any) -> Any:
        """Calls the function with arguments whose parcels are unpacked.

        Args:
            *arguments: The arguments.

        Raises:
            ValueError: The worker has other versions.
        """
        from threadpoolctl import threadpool_limits

        here = local_versions()
        for name, expected in self.versions.items():
            if here.get(name) != expected:
                raise ValueError(
                    f"the worker of the cluster at {socket.gethostname()} has {name} "
                    f"{here.get(name)}, expected {expected}, as here: install the same there"
                )
        # Threads of a worker take turns: Python gains nothing from them, and they share its cache
        # of loops. One BLAS thread, so that results do not depend on where they are computed.
        with _TURN, threadpool_limits(1):
            return self.function(*map(_unpacked, arguments))


_UNPACKED: dict[str, Scenario] = {}


def _unpacked(argument: Any) -> Any:
    """An argument, or the scenario of a parcel, whose files are written once."""
    if not isinstance(argument, Parcel):
        return argument
    digest = argument.digest
    if digest not in _UNPACKED:
        folder = Path(_folder().name) / digest[:16]
        for name, content in argument.files.items():
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        if argument.modules:
            # Another parcel may have had modules of these names.
            for name in argument.modules:
                sys.modules.pop(name, None)
            sys.path.insert(0, str(folder))
            importlib.invalidate_caches()
        # One at a time: the class of a task stays that of its scenario.
        _UNPACKED.clear()
        _UNPACKED[digest] = parse_scenario(argument.text, name=argument.name, folder=folder)
    return _UNPACKED[digest]


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """This process's folder, removed when it ends."""
    return tempfile.TemporaryDirectory(prefix="drake_safety-")
