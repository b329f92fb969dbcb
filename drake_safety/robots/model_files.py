"""Where model files are: in this package, in one that pip installed, or beside a YAML file."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlparse

from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant

_EXTRAS = {"example-robot-data": "robots"}
"""Packages of models that an extra installs."""


class MissingExtraError(ValueError):
    """A model is in a package that is not installed, and an extra would install it."""


def models_package_xml() -> Path:
    """The ``package.xml`` behind ``package://drake_safety_models/``."""
    return Path(str(files("drake_safety.models"))) / "package.xml"


def add_to_package_map(package_map: PackageMap, url: str = "") -> None:
    """Makes ``package://drake_safety_models/…`` known to a parser's package map.

    Args:
        package_map: The parser's.
        url: A ``package://NAME/…`` whose package, installed by pip, becomes known too.
    """
    if not package_map.Contains("drake_safety_models"):
        package_map.AddPackageXml(str(models_package_xml()))
    parts = urlparse(url)
    if parts.scheme == "package" and not package_map.Contains(parts.netloc):
        folder = _installed_folder(parts.netloc)
        if folder is not None:
            package_map.Add(parts.netloc, str(folder))


def package_parser(plant: MultibodyPlant, url: str = "") -> Parser:
    """A parser that knows the packages of :func:`add_to_package_map`.

    Models of a name that the plant has already are renamed.

    Args:
        plant: Where models go, before ``Finalize``.
        url: As there.
    """
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    add_to_package_map(parser.package_map(), url)
    return parser


@lru_cache
def _installed_folder(name: str) -> Path | None:
    """Where pip put the files of a package: its ``share/NAME``, or else the Python package."""
    try:
        distribution = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in distribution.files or ():
        for depth in range(1, len(file.parts)):
            if file.parts[depth - 1 : depth + 1] == ("share", name):
                return Path(str(distribution.locate_file(Path(*file.parts[: depth + 1]))))
    spec = importlib.util.find_spec(name.replace("-", "_"))
    locations = None if spec is None else spec.submodule_search_locations
    return Path(next(iter(locations))) if locations else None


def model_file(url: str, folder: str = "") -> Path:
    """The file behind a ``package://…`` URL, or behind a path that starts in ``folder``.

    A package is this one's (``drake_safety_models``), Drake's, or one that pip installed.

    Raises:
        MissingExtraError: The package is one that an extra installs, and is not installed.
        ValueError: The package is unknown.
    """
    parts = urlparse(url)
    if parts.scheme != "package":
        return Path(folder) / url
    package_map = PackageMap()
    add_to_package_map(package_map, url)
    if package_map.Contains(parts.netloc):
        return Path(package_map.GetPath(parts.netloc)) / parts.path.lstrip("/")
    if parts.netloc in _EXTRAS:
        raise MissingExtraError(
            f"'{url}': the package '{parts.netloc}' is not installed: "
            f"pip install 'drake_safety[{_EXTRAS[parts.netloc]}]'"
        )
    raise ValueError(f"'{url}': no package '{parts.netloc}'; add its files by path")


def is_installed(url: str) -> bool:
    """Whether the package of a ``package://…`` URL can be found; of a path it is always so.

    Args:
        url: The URL, or a path.
    """
    parts = urlparse(url)
    package_map = PackageMap()
    add_to_package_map(package_map, url)
    return parts.scheme != "package" or package_map.Contains(parts.netloc)
