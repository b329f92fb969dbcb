"""Where a result comes from: the command line and the versions, kept beside what it wrote."""

from __future__ import annotations

import shlex
import sys


def command_line() -> str:
    """The command as it was typed."""
    return shlex.join(["drake-safety", *sys.argv[1:]])


def versions() -> dict[str, str]:
    """Versions of the library and of what its figures depend on."""
    import importlib.metadata

    import drake_safety

    names = ("drake", "numpy", "scipy", "scikit-learn", "torch")
    installed = {name: importlib.metadata.version(name) for name in names}
    return {"drake_safety": drake_safety.__version__, **installed}
