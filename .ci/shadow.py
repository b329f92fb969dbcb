"""Part of an editable install: an import of a folder in place of the package is an error."""

import sys
from importlib.machinery import PathFinder


class Shadow:
    """Finds nothing, but looks first."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        """Raises an error for a folder of the package's name that is no package."""
        if name == "drake_safety":
            spec = PathFinder.find_spec(name)
            if spec is not None and spec.origin is None:
                (folder, *_) = spec.submodule_search_locations
                raise ImportError(
                    f"the folder {folder} hides the installed package drake_safety, because Python "
                    "looks beside the script first; rename the folder, or run the script from a "
                    "file elsewhere"
                )


sys.meta_path.insert(0, Shadow)
