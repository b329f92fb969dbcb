"""The package's extras, and the error for one that is not installed."""

import shlex
from importlib.util import find_spec

MODULES = {
    "cluster": ("distributed",),
    "live": ("aiohttp", "nicegui"),
    "logs": ("mcap", "pandas", "pyarrow", "rosbags"),
    "mujoco": ("mujoco",),
    "c": ("emx_onnx_cgen", "jinja2", "onnx"),
    "onnx": ("onnx",),
    "report": ("jinja2",),
    "robots": ("collada", "robot_descriptions", "trimesh", "xacrodoc"),
    "train": ("dtaidistance", "openTSNE", "pyarrow", "sklearn", "torch", "tslearn"),
    "walking": ("onnx", "onnxruntime"),
}
"""Modules that the library imports, by extra."""


class MissingExtraError(ValueError):
    """Packages that pip can install are not installed.

    Args:
        message: The feature, and the packages that it needs.
        needs: Packages for pip; the message ends with the command that installs them.
        options: Options of the command.
    """

    def __init__(self, message: str, needs: str, options: str = ""):
        super().__init__(f"{message}: pip install {options}{shlex.quote(needs)}")
        self.needs = needs


def missing_extra(extra: str, message: str) -> MissingExtraError:
    """Returns the error for an extra that is not installed; the message says who needs what."""
    return MissingExtraError(message, f"drake_safety[{extra}]")


def require_extra(extra: str, who: str, *modules: str) -> None:
    """Checks that an extra is installed, before anything else is done; nothing is imported.

    Args:
        *modules: Its modules that are needed; all of them by default.

    Raises:
        MissingExtraError: One of them is not installed.
    """
    for name in modules or MODULES[extra]:
        if find_spec(name) is None:
            raise missing_extra(extra, f"{who}: the package '{name}' is not installed")
