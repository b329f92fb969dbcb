"""Builds as setuptools does; an editable install then says which folder shadows the package.

Python takes a folder `drake_safety` beside a script, such as a clone, for a namespace package, and
finds it before an editable install: every name would be missing, without a reason.
"""

import zipfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403


def build_editable(wheel_directory, config_settings=None, metadata_directory=None):
    """Adds `shadow.py` to setuptools' wheel, which is imported whenever Python starts."""
    name = build_meta.build_editable(wheel_directory, config_settings, metadata_directory)
    with zipfile.ZipFile(Path(wheel_directory, name), "a") as wheel:
        wheel.write(Path(__file__).with_name("shadow.py"), "_drake_safety_shadow.py")
        wheel.writestr("drake_safety_shadow.pth", "import _drake_safety_shadow\n")
    return name
