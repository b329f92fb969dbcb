"""Robots and scenes as data, and the loader of a robot by name."""

from pathlib import Path

from drake_safety.robots.model_files import add_to_package_map, model_file
from drake_safety.robots.robot_model import RobotModel, load_robot_file

__all__ = ["add_to_package_map", "load_robot", "robot_files", "robot_names"]

_FOLDER = Path(__file__).parent


def robot_names() -> list[str]:
    """Returns the names of the package's robots."""
    return sorted(path.parent.name for path in _FOLDER.glob("*/robot.yaml"))


def load_robot(name: str) -> RobotModel:
    """Loads a robot by name, or by the path of a ``robot.yaml``."""
    if name in robot_names():
        return load_robot_file(_FOLDER / name / "robot.yaml")
    if Path(name).suffix in (".yaml", ".yml"):
        return load_robot_file(name)
    raise ValueError(
        f"robot '{name}' does not exist; robots are {robot_names()}, or pass the path of a "
        "robot.yaml"
    )


def robot_files(name: str) -> list[Path]:
    """Returns the ``robot.yaml`` and the model file of a robot; see :func:`load_robot`."""
    robot = load_robot(name)
    folder = Path(robot.source_dir)
    model = model_file(robot.urdf, robot.source_dir, robot.requires)
    return [Path(name) if name not in robot_names() else folder / "robot.yaml", model]
