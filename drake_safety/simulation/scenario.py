"""A scenario: the YAML file that marries a robot and a task."""

import hashlib
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import yaml
from pydrake.common.yaml import yaml_dump_typed

from drake_safety.learning.assessment import AssessmentParameters
from drake_safety.robots.robot import PlantVariation
from drake_safety.robots.robot_model import load_typed
from drake_safety.simulation.capabilities import CompletesParameters
from drake_safety.simulation.closed_loop import ClosedLoop

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from drake_safety.learning.assessment import SafetyAssessment


@dataclass(kw_only=True)
class Scenario:
    """What a scenario file holds. The fields under ``parameters`` are the task's own."""

    name: str = ""
    """File name without suffix; filled in by the loader."""
    task: str = ""
    """Import path ``package.module:Class`` of a ClosedLoop."""
    robot: str = ""
    """Name of a robot that comes with the package, or the path of a ``robot.yaml``; empty for a
    task that brings a plant of its own."""
    episode_duration_s: float = 2.0
    """T [s]."""
    step_s: float = 0.04
    """Time between two assessment inputs, the unit of H [s]."""
    time_step_s: float = 0.0025
    """Step of the discrete plant [s]."""
    control_period_s: float = 0.01
    """Period of the controller and of the safety monitor [s]."""
    variations: dict[str, PlantVariation] = field(default_factory=dict)
    """Plants by name; ``nominal`` is the one that is learned from."""
    assessment: AssessmentParameters = field(default_factory=AssessmentParameters)
    """How Γ is learned."""

    parameters = cast(Any, None)  # Set by the loader: an instance of the task's Parameters.

    def __post_init__(self) -> None:
        for name in ("episode_duration_s", "step_s", "time_step_s", "control_period_s"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"scenario '{self.name}': {name} must be positive; got {getattr(self, name)}"
                )
        if self.assessment.horizon > self.num_steps:
            raise ValueError(
                f"scenario '{self.name}': the assessment horizon of {self.assessment.horizon} "
                f"steps of {self.step_s} s exceeds the episode of {self.episode_duration_s} s"
            )

    @property
    def num_steps(self) -> int:
        """Assessment steps of a whole episode."""
        return round(self.episode_duration_s / self.step_s)

    def variation(self, name: str) -> PlantVariation:
        """A plant variation by name.

        Raises:
            ValueError: No such variation.
        """
        if name not in self.variations:
            raise ValueError(
                f"scenario '{self.name}' has no variation '{name}'; it has {list(self.variations)}"
            )
        return self.variations[name]

    def task_class(self) -> type[ClosedLoop]:
        """The task, imported.

        Raises:
            ValueError: The import path is malformed or leads to no ClosedLoop.
        """
        return _import_task(self.task, self.name)

    def make_loop(
        self,
        variation: str = "nominal",
        *,
        assessment: "SafetyAssessment | None" = None,
        meshcat: "Meshcat | None" = None,
        **options: Any,
    ) -> ClosedLoop:
        """Builds the task's diagram.

        Args:
            variation: Which plant.
            assessment: Γ; adds the assessor and what the task does with it.
            meshcat: Adds a visualiser.
            **options: The task's own, such as ``recovery=False``.

        Raises:
            ValueError: Unknown variation, an option that the task does not have, or an assessment
                made for something else.
        """
        task: Any = self.task_class()  # Its constructor has options of its own.
        _check_options(task, options)
        return task(self, variation, assessment=assessment, meshcat=meshcat, **options)

    def to_yaml(self) -> str:
        """The scenario as canonical text, defaults included, that `load_scenario` reads."""
        head = yaml_dump_typed(self, schema=Scenario)
        body = yaml_dump_typed(self.parameters, schema=type(self.parameters))
        return head + "parameters:\n" + textwrap.indent(body, "  ")

    def simulation_hash(self, variation: str = "nominal") -> str:
        """SHA-256 of all that decides what a rollout does and records, robot included.

        Defaults count, so that episodes of before and after a default was changed do not mix. How Γ
        is learned is left out, but for the horizon that shapes the preview, and so are the task's
        online parameters and the other variations: episodes stay valid when only the learning, a
        threshold or another plant changes. Source code is known by :meth:`code_digest`.

        Args:
            variation: The plant that is simulated. The nominal one always counts: controllers
                take it for the robot.

        Raises:
            ValueError: No such variation.
        """
        if variation != "nominal":
            self.variation(variation)
        text = yaml.safe_load(self.to_yaml())
        text["assessment"] = {"horizon": self.assessment.horizon}
        text["variations"] = {
            name: text["variations"][name]
            for name in ("nominal", variation)
            if name in self.variations
        }
        # A robot of one's own is known by its files, wherever their folder lies.
        text["robot"] = Path(self.robot).name
        task = self.task_class()
        for name in task.online_parameters:
            text["parameters"].pop(name, None)
        digest = hashlib.sha256(yaml.safe_dump(text, sort_keys=True).encode())
        for path in task.model_files(self):
            digest.update(_LOOKS.sub(b"", Path(path).read_bytes()))
        return digest.hexdigest()

    def code_digest(self) -> str:
        """SHA-256 of the source code that simulates: this package's, and the task's module's.

        Of the task's module count the modules beside it that it imports, too.
        """
        return source_digest(_own_files(sys.modules[self.task_class().__module__]))


def source_digest(files: Iterable[Path] = ()) -> str:
    """SHA-256 of this package's source code that decides a simulation, and of further files.

    Args:
        files: Of a task's module; they are known by their names, wherever their folder lies.
    """
    root = Path(__file__).parents[1]
    package = [path for room in _SIMULATING_ROOMS for path in (root / room).rglob("*.py")]
    named = {path.relative_to(root).as_posix(): path for path in package}
    named |= {path.name: path for path in files}
    digest = hashlib.sha256()
    for name in sorted(named):
        digest.update(name.encode() + b"\0" + named[name].read_bytes() + b"\0")
    return digest.hexdigest()


_SIMULATING_ROOMS = ("control", "plants", "robots", "simulation", "systems")


def _own_files(module: ModuleType) -> set[Path]:
    """The file of a module, and those in its folder that it imports from, directly or not."""
    files: dict[Path, ModuleType] = {}
    waiting = [module]
    while waiting:
        one = waiting.pop()
        file = Path(getattr(one, "__file__", None) or "")
        if file in files or (files and file.parent != next(iter(files)).parent):
            continue
        files[file] = one
        names = {getattr(value, "__module__", None) for value in vars(one).values()}
        waiting += [sys.modules[name] for name in names if name in sys.modules]
    return set(files)


_LOOKS = re.compile(rb"^visuals:.*\n", re.MULTILINE)
"""What a robot.yaml says that decides nothing."""


def _check_options(task: type[ClosedLoop], options: dict[str, Any]) -> None:
    parameters = inspect.signature(task).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    # What every task takes goes through make_loop's own arguments.
    common = ("scenario", "variation", "assessment", "meshcat")
    known = [parameter.name for parameter in parameters if parameter.name not in common]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise ValueError(f"task '{task.__name__}' has no options {unknown}; it has {known}")


def _import_task(task: str, scenario_name: str) -> type[ClosedLoop]:
    module_name, _, class_name = task.partition(":")
    if not (module_name and class_name):
        raise ValueError(
            f"scenario '{scenario_name}': task must be 'package.module:Class'; got '{task}'"
        )
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise ValueError(
            f"scenario '{scenario_name}': no module '{module_name}' for task '{task}'; tasks "
            f"that come with the package are {task_names()}"
        ) from error
    known = {
        name: value
        for name, value in vars(module).items()
        # What has no parameters of its own is a base that tasks share.
        if isinstance(value, type)
        and issubclass(value, ClosedLoop)
        and hasattr(value, "Parameters")
    }
    if class_name not in known:
        raise ValueError(
            f"scenario '{scenario_name}': module '{module_name}' has no task '{class_name}'; "
            f"it has {list(known)}"
        )
    return known[class_name]


def _scenario_folder() -> Path:
    return Path(str(files("drake_safety.diagrams")))


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(path.stem for path in _scenario_folder().glob("*.yaml"))


def task_names() -> list[str]:
    """Import paths of the modules of tasks that come with the package: those of its scenarios."""
    texts = (path.read_text(encoding="utf-8") for path in _scenario_folder().glob("*.yaml"))
    return sorted({yaml.safe_load(text)["task"].partition(":")[0] for text in texts})


def load_scenario(name: str | Path) -> Scenario:
    """Loads a scenario by name, or by the path of a YAML file of your own.

    A relative ``robot`` path is taken from the scenario file's folder.

    Args:
        name: ``"NAME"`` of one that comes with the package, or a path.

    Raises:
        ValueError: No such scenario, unknown or ill-typed keys, or no such task.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = _scenario_folder() / f"{name}.yaml"
        if not path.is_file():
            raise ValueError(
                f"scenario '{name}' does not exist; scenarios are {scenario_names()}, or give "
                "the path of a YAML file"
            )
    if not path.is_file():
        raise ValueError(f"scenario file '{path}' does not exist")
    return parse_scenario(
        path.read_text(encoding="utf-8"), name=path.stem, folder=path.resolve().parent
    )


def parse_scenario(text: str, *, name: str, folder: Path) -> Scenario:
    """Reads a scenario from YAML text.

    Args:
        text: The YAML.
        name: The scenario's name.
        folder: Where a relative robot path starts.

    Raises:
        ValueError: As :func:`load_scenario`.
    """
    try:
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"scenario '{name}' is not YAML: {error}") from error
    if not isinstance(raw, dict) or "task" not in raw:
        raise ValueError(
            f"scenario '{name}' must be a mapping with the key 'task', and 'robot' for a task that "
            "takes one"
        )
    parameters = raw.pop("parameters", None) or {}
    scenario = load_typed(Scenario, raw | {"name": name}, f"scenario '{name}'")
    if Path(scenario.robot).suffix in (".yaml", ".yml"):
        scenario.robot = str((folder / scenario.robot).resolve())
    task = scenario.task_class()
    if isinstance(parameters, dict) and isinstance(task, CompletesParameters):
        parameters = task.complete_parameters(scenario.robot, parameters)
    scenario.parameters = load_typed(task.Parameters, parameters, f"scenario '{name}', parameters")
    return scenario
