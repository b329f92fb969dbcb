"""Scenarios: YAML files that combine a robot and a task."""

import copy
import fnmatch
import hashlib
import importlib
import inspect
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import field, replace
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import pydantic
import yaml
from pydantic import Field

from drake_safety.files.reading import parse_yaml, reading
from drake_safety.files.schema import Positive, load_typed, schema
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.robots.family import FAMILY, PlantFamily
from drake_safety.robots.robot import PlantVariation
from drake_safety.robots.robot_model import load_robot_file
from drake_safety.robots.robot_size import overlaid
from drake_safety.simulation.closed_loop import ClosedLoop, Purpose, check_ports
from drake_safety.systems.monitored_assessor import OnAlarm

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat


_FOLDER = Path(str(files("drake_safety.diagrams")))
_LEAST_MONITOR_STEP_S = 0.02
_MOST_STEPS = 10_000_000  # Steps of an episode, of any kind.
# A folder in a text file: the value of an XML attribute, or of a key or an item in YAML.
_FOLDER_IN_TEXT = re.compile(rb"""(["']|[:,{\[-]\s+|\[)(?:file://)?/[^"'<>\n,}\]]*/""")
_TEXT_FORMATS = (".yaml", ".yml", ".urdf", ".sdf", ".xml")


@schema(kw_only=True)
class Scenario:
    """Schema of a scenario file; the task defines the fields under ``parameters``.

    Example: ``actual = scenario.make_loop("actual")``
    """

    name: str = ""  # File name without suffix.
    task: str = ""  # Import path ``package.module:Class`` of a ClosedLoop.
    robot: str = ""
    """Name of a robot of the package, or the path of a ``robot.yaml``; "" for another plant."""
    episode_duration_s: Positive = 2.0  # T.
    step_s: Positive = 0.04
    """Time between two rows of an episode [s]; the assessment's ``preview_stride`` rows are the
    paper's step, the unit of H."""
    time_step_s: Positive = 0.0025  # Step of the discrete plant.
    control_period_s: Positive = 0.01  # Period of controller and safety monitor.
    on_alarm: OnAlarm = "unknown"
    """Effect of the monitor's alarm: ``unknown`` makes every belief "don't know", so that plans are
    refused; ``report`` only reports it. Recovery ignores alarms."""
    without_features: list[str] = field(default_factory=list)
    """Patterns such as ``foot_height_*`` of a legged robot's features that Γ does not read."""
    variations: dict[str, PlantVariation] = field(default_factory=dict)
    """Plants by name; training episodes are of ``nominal`` and of the family."""
    family: PlantFamily | None = None
    """Random plants around the nominal one, on which Γ learns beside it."""
    assessment: AssessmentParameters = field(default_factory=AssessmentParameters)

    # An instance of the task's Parameters.
    parameters: Annotated[Any, Field(exclude=True)] = field(default=None, repr=False)
    # The scenario file's folder, where its task may stand.
    folder: Annotated[str, Field(exclude=True)] = field(default="", repr=False, compare=False)
    # File name to hash instead of the current one, as an assessment was learned under it.
    identity: Annotated[str, Field(exclude=True)] = field(default="", repr=False, compare=False)

    def __post_init__(self) -> None:
        if FAMILY in self.variations:
            raise ValueError(
                f"no variation can have the name '{FAMILY}', that of the random plants"
            )
        episode = f"episode of {self.episode_duration_s} s"
        for name in ("step_s", "time_step_s", "control_period_s"):
            if self.episode_duration_s > _MOST_STEPS * getattr(self, name):
                raise ValueError(f"an {episode} has more than {_MOST_STEPS} steps of {name}")
        if self.assessment.horizon * self.assessment.preview_stride > self.num_steps:
            steps = f"{self.assessment.horizon} steps of {self.preview_step_s:g} s"
            raise ValueError(f"the assessment horizon of {steps} exceeds the {episode}")

    @property
    def preview_step_s(self) -> float:
        """Time between two samples of the preview [s]."""
        return self.assessment.preview_stride * self.step_s

    @property
    def monitor_step_s(self) -> float:
        """Time between two updates of the change monitor [s]: of control periods, at least .02."""
        periods = math.ceil(_LEAST_MONITOR_STEP_S / self.control_period_s - 1e-6)
        return periods * self.control_period_s

    @property
    def watch_period_s(self) -> float:
        """Sampling period of the safe set [s]: the task's ``monitor_period_s``, if it has one."""
        return getattr(self.parameters, "monitor_period_s", self.control_period_s)

    @property
    def num_steps(self) -> int:
        """Rows after the first one of a whole episode."""
        return round(self.episode_duration_s / self.step_s)

    def variation(self, name: str) -> PlantVariation:
        """A plant variation by name; that of ``family`` is its first plant of seed 0."""
        if name == FAMILY and name not in self.variations:
            return self.with_plant(0, 0).variations[name]
        if name not in self.variations:
            there = list(self.variations)
            raise ValueError(f"scenario '{self.name}' has no variation '{name}'; it has {there}")
        return self.variations[name]

    def with_plant(self, seed: int, number: int) -> "Scenario":
        """The scenario whose variation ``family`` is a random plant of the family."""
        if self.family is None:
            raise ValueError(f"scenario '{self.name}' has no family of plants: add `family:`")
        plant = self.family.plant(self.variation("nominal"), seed, number)
        return self.with_variation(FAMILY, plant)

    def with_variation(self, name: str, plant: PlantVariation) -> "Scenario":
        """The scenario with a further variation."""
        changed = copy.copy(self)
        changed.variations = {**self.variations, name: plant}
        return changed

    @property
    def robot_name(self) -> str:
        """The name of the robot, which may be that in its YAML file."""
        is_file = Path(self.robot).suffix in (".yaml", ".yml")
        return load_robot_file(self.robot).name if is_file else self.robot

    def task_class(self) -> type[ClosedLoop]:
        """Returns the task, imported."""
        return _import_task(self.task, self.name, self.folder)

    def __reduce__(self) -> tuple[Any, ...]:
        # A worker process imports the task before it reads the parameters, which are the task's.
        return _unpickled, (self.task, self.name, self.folder), vars(self)

    def make_loop(
        self,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: "Meshcat | None" = None,
        **options: Any,
    ) -> ClosedLoop:
        """Builds the task's diagram.

        Args:
            variation: The plant, a key of ``variations``, or ``family``.
            assessment: Γ that is added; without it the diagram has no ports of Γ.
            **options: Options of the task, such as ``recovery=False``.
        """
        task: Any = self.task_class()  # Its constructor has options of its own.
        known = inspect.signature(task).parameters
        takes_all = any(p.kind is p.VAR_KEYWORD for p in known.values())
        if unknown := [name for name in options if not takes_all and name not in known]:
            # Arguments of make_loop itself.
            own = [n for n in known if n not in ("scenario", "variation", "assessment", "meshcat")]
            raise ValueError(f"task '{task.__name__}' has no options {unknown}; it has {own}")
        if takes_all or "meshcat" in known:
            options["meshcat"] = meshcat
        loop: ClosedLoop = task(self, variation, assessment=assessment, **options)
        check_ports(loop)
        if kept := [p for p in self.without_features if fnmatch.filter(loop.feature_names, p)]:
            raise ValueError(f"task '{task.__name__}' keeps features of without_features: {kept}")
        return loop

    def options_for(self, purpose: Purpose, variation: str = "nominal") -> dict[str, Any]:
        """The task's options for a purpose; see :meth:`ClosedLoop.options_for`."""
        return self.task_class().options_for(purpose, self, variation)

    def to_yaml(self) -> str:
        """Returns the scenario as canonical YAML text with all defaults."""
        return yaml.safe_dump(self._values(), default_flow_style=None, sort_keys=False)

    def _values(self) -> dict[str, Any]:
        options: Any = {"mode": "json", "exclude_none": True, "warnings": False}
        # By the schema, an integer that Python code set in place of a float is a float.
        values, parameters = (
            pydantic.TypeAdapter(type(part)).dump_python(part, **options)
            for part in (self, self.parameters)
        )
        return values | {"parameters": parameters}

    def adopt(self, info: EpisodesInfo) -> bool:
        """Takes over the identity under which an assessment was learned, if it simulates alike."""
        is_same = self.simulation_hash(info.variation, name=info.scenario) == info.scenario_hash
        if is_same:
            self.identity = info.scenario
        return is_same

    def simulation_hash(self, variation: str = "nominal", *, name: str = "") -> str:
        """SHA-256 of all parameters that determine a rollout, and of the robot's files.

        It covers defaults and, as the controllers' model, the nominal plant. It omits source code,
        the task's online parameters, other variations, and the assessment's parameters except the
        preview's. The family counts only as its own variation. ``name`` replaces the file's name.
        """
        if variation != "nominal":
            self.variation(variation)
        text = self._values()
        del text["on_alarm"]  # No episode depends on it.
        if not self.without_features:
            del text["without_features"]  # As the hash has always been.
        family = text.pop(FAMILY, {})
        if variation == FAMILY:
            text[FAMILY] = family.get("ranges")
        preview = ("horizon", "preview_stride")
        text["assessment"] = {key: getattr(self.assessment, key) for key in preview}
        plants = [k for k in ("nominal", variation) if k in self.variations and k != FAMILY]
        text["variations"] = {key: text["variations"][key] for key in plants}
        text["name"] = name or self.identity or self.name
        # Files are hashed; their folders are irrelevant.
        text["robot"] = Path(self.robot).name
        text["parameters"] = _without_folders(text["parameters"])
        task = self.task_class()
        for key in getattr(task.Parameters, "online", ()):
            text["parameters"].pop(key, None)
        digest = hashlib.sha256(yaml.safe_dump(text, sort_keys=True).encode())
        for path in task.model_files(self):
            digest.update(_content(Path(path)))
        return digest.hexdigest()


def _content(path: Path) -> bytes:
    content = path.read_bytes()
    return _FOLDER_IN_TEXT.sub(rb"\1", content) if path.suffix in _TEXT_FORMATS else content


def _without_folders(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_folders(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [*map(_without_folders, value)]
    if isinstance(value, str) and value.startswith("/") and (path := Path(value)).is_file():
        return hashlib.sha256(_content(path)).hexdigest()
    return value


def _unpickled(task: str, name: str, folder: str) -> Scenario:
    if _file_beside(task.partition(":")[0], folder):
        _import_task(task, name, folder)
    return Scenario.__new__(Scenario)


def _file_beside(module_name: str, folder: str) -> Path | None:
    if not folder:
        return None
    path = Path(folder, *module_name.split("."))
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def _imported(module_name: str, folder: str) -> ModuleType:
    file = _file_beside(module_name, folder)
    if file is None:
        return importlib.import_module(module_name)
    is_searched = folder in sys.path
    if not is_searched:
        sys.path.append(folder)  # After all others.
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    finally:
        if not is_searched:
            sys.path.remove(folder)
    origin = getattr(module, "__file__", None)
    if origin is None or Path(origin).resolve() != file.resolve():
        text = f"module '{module_name}' is {origin}, and not {file} beside the scenario"
        raise ValueError(f"{text}: give the file a name of its own")
    return module


def _import_task(task: str, scenario_name: str, folder: str) -> type[ClosedLoop]:
    who = f"scenario '{scenario_name}'"
    module_name, _, class_name = task.partition(":")
    if not (module_name and class_name):
        raise ValueError(f"{who}: task must be 'package.module:Class'; got '{task}'")
    try:
        module = _imported(module_name, folder)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        text = f"{who}: no module '{module_name}', installed or beside the scenario's file"
        raise ValueError(text) from error
    task_class: Any = getattr(module, class_name, None)
    is_task = isinstance(task_class, type) and issubclass(task_class, ClosedLoop)
    # A class without parameters is a base class of tasks.
    if not (is_task and hasattr(task_class, "Parameters")):
        raise ValueError(f"{who}: module '{module_name}' has no task '{class_name}'")
    return task_class


def scenario_names() -> list[str]:
    """Names of the package's scenarios."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_scenario(name: str | Path, changes: Mapping[str, Any] | None = None) -> Scenario:
    """Loads a scenario by name, or by the path of a YAML file, and imports its task.

    Importing runs the task's code; :func:`read_scenario` does not. The task's module may stand in
    the scenario file's folder; a relative ``robot`` path begins there. ``changes`` replace values
    by key, such as ``parameters.policy``.

    Example: ``short = load_scenario("pendulum", {"episode_duration_s": 1.0})``
    """
    path = _scenario_file(name)
    with reading(path, errors=ValueError):
        folder, text = path.resolve().parent, path.read_text(encoding="utf-8")
        if changes:
            raw = parse_yaml(text, f"scenario '{path.stem}'")
            for key, value in changes.items():
                for part in reversed(key.split(".")):
                    value = {part: value}
                raw = overlaid(raw, value)
            text = yaml.safe_dump(raw, sort_keys=False)
        return parse_scenario(text, name=path.stem, folder=folder, task_folder=str(folder))


def read_scenario(name: str | Path) -> Scenario:
    """Reads a scenario's file without importing its task, which leaves its parameters unchecked."""
    path = _scenario_file(name)
    with reading(path):
        return _parsed(path.read_text(encoding="utf-8"), path.stem, path.resolve().parent)


def _scenario_file(name: str | Path) -> Path:
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = _FOLDER / f"{name}.yaml"
        if not path.is_file():
            raise ValueError(f"scenario '{name}' does not exist; scenarios are {scenario_names()}")
    if not path.is_file():
        raise ValueError(f"scenario file '{path}' does not exist")
    return path


def parse_scenario(text: str, *, name: str, folder: Path, task_folder: str = "") -> Scenario:
    """Reads a scenario from YAML text; the task's module may stand in ``task_folder``."""
    scenario = replace(_parsed(text, name, folder), folder=task_folder)
    schema, stated = scenario.task_class().Parameters, scenario.parameters
    if isinstance(stated, dict) and hasattr(schema, "completed"):
        stated = schema.completed(stated, scenario.robot)
    parameters: Any = load_typed(schema, stated, f"scenario '{name}', parameters")
    return replace(scenario, parameters=parameters)


def _parsed(text: str, name: str, folder: Path) -> Scenario:
    raw = parse_yaml(text, f"scenario '{name}'")
    if not isinstance(raw, dict) or "task" not in raw:
        raise ValueError(f"scenario '{name}' must be a mapping with the key 'task'")
    if own := sorted(raw.keys() & {"folder", "identity"}):
        raise ValueError(f"scenario '{name}': unknown keys {own}, which no file states")
    parameters: Any = raw.pop("parameters", None) or {}
    scenario = load_typed(Scenario, raw | {"name": name}, f"scenario '{name}'")
    robot = scenario.robot
    if Path(robot).suffix in (".yaml", ".yml"):
        robot = str((folder / robot).resolve())
    return replace(scenario, robot=robot, parameters=parameters)
