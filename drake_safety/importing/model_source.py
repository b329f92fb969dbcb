"""Model files to be made first: xacro is expanded, a named description downloaded."""

from collections.abc import Mapping
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path

from drake_safety.extras import require_extra
from drake_safety.files.reading import shortened

_PATHS = ("URDF_PATH", "MJCF_PATH", "XACRO_PATH")


def is_xacro(path: Path) -> bool:
    """Whether a file is to be expanded by xacro."""
    return path.suffix == ".xacro" or (path.is_file() and b"<xacro:" in path.read_bytes())


def expanded(path: Path, arguments: Mapping[str, str]) -> str:
    """The URDF of a xacro file; its packages lie above it or in ROS_PACKAGE_PATH."""
    require_extra("robots", f"new: '{path}' is xacro", "xacrodoc")
    from xacrodoc import XacroDoc, packages

    if not path.is_file():
        raise ValueError(f"new: '{path}' does not exist")
    packages.walk_up_from(path)
    included, options = [str(path.resolve())], {"subargs": dict(arguments), "rootdir": path.parent}
    try:
        # An include, so that nested includes are relative to it.
        document = XacroDoc.from_includes(included, resolve_packages=False, **options)
    except Exception as error:  # Errors of xacro, of XML, or of its expressions.
        missing = str(error).partition("Undefined substitution argument ")[2]
        remedy = f"; pass --xacro-arg {missing}=VALUE" if missing else ""
        raise ValueError(f"new: xacro of '{path}': {shortened(str(error))}{remedy}") from error
    text: str = document.to_urdf_string()
    return text


def model_file(name: str) -> Path:
    """A model file, or the file of a name in robot_descriptions, which git downloads first."""
    if (path := Path(name)).suffix or path.exists():
        return path
    who = f"new: '{name}' is not a file"
    require_extra("robots", who, "robot_descriptions")
    known = import_module("robot_descriptions").DESCRIPTIONS
    if name not in known:
        near = [one for one in known if name in one] or get_close_matches(name, known, cutoff=0.5)
        raise ValueError(f"{who}, and none of {len(known)} robot_descriptions; near are {near}")
    try:
        module = import_module(f"robot_descriptions.{name}")
    except Exception as error:  # Errors of git, or of a network.
        what = shortened(" ".join(str(error).split()))
        raise ValueError(f"new: git cannot download '{name}': {what}") from error
    return Path(next(getattr(module, key) for key in _PATHS if hasattr(module, key)))
