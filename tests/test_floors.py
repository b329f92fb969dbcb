"""Rules of the source that neither ruff nor import-linter can check."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

from drake_safety.extras import MODULES

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("drake_safety", "diagrams", "models", "assessments")
LIBRARY = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def words_of(text):
    """Splits at whatever is no letter or digit and before capitals: `Spot2Arm` → ` spot2 arm `."""
    words = re.findall(r"[A-Z]+(?![a-z])[0-9]*|[A-Z]?[a-z0-9]+", text)
    return f" {' '.join(words).lower()} "


def names_of(requirements):
    return {re.match(r"[\w-]+", line)[0].lower() for line in requirements}


def test_mathematics_and_learning_have_no_ports():
    ports = re.compile(r"\b(LeafSystem|VectorSystem|Declare\w*Port|Export(In|Out)put)\b")
    folders = ("control", "files", "learning", "policies", "robots")
    files = [path for name in folders for path in (ROOT / "drake_safety" / name).rglob("*.py")]
    assert [path for path in files if ports.search(path.read_text(encoding="utf-8"))] == []


def test_arrays_of_files_are_read_without_pickle():
    tracked = ("benchmarks", "diagrams", "docs", "drake_safety", "studies", "tests")
    files = [path for name in tracked for path in (ROOT / name).rglob("*.py")]
    allowed = re.compile(r"allow_pickle\s*=\s*" + "True")
    assert [path for path in files if allowed.search(path.read_text(encoding="utf-8"))] == []


def test_imported_packages_are_declared_as_dependencies():
    trees = [ast.walk(ast.parse(path.read_text(encoding="utf-8"))) for path in LIBRARY]
    nodes = [node for tree in trees for node in tree]
    names = {one.name for node in nodes if isinstance(node, ast.Import) for one in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    imported = {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"drake_safety"}
    assert {"numpy", "pydrake", "rosbags"} <= imported
    providers, declared = packages_distributions(), names_of(PROJECT["dependencies"])
    optional = {name for modules in MODULES.values() for name in modules}
    of_none = {
        name
        for name in imported - optional
        if not {one.lower() for one in providers.get(name, [name])} & declared
    }
    assert of_none == set()
    for extra, modules in MODULES.items():
        of_extra = names_of(PROJECT["optional-dependencies"][extra])
        for name in filter(find_spec, modules):
            assert {one.lower() for one in providers[name]} & of_extra


def test_no_robot_is_named_in_the_library_or_in_a_task():
    robots = [words_of(path.parent.name) for path in (ROOT / "models").glob("*/robot.yaml")]
    assert " laikago " in robots
    files = [path for path in (ROOT / "drake_safety").rglob("*") if path.suffix != ".pyc"]
    files += [path for path in LIBRARY if "drake_safety" not in path.parts[-3:]]
    offences = [
        (path.relative_to(ROOT), robot)
        for path in filter(Path.is_file, files)
        for text in (path.name, *path.read_text(encoding="utf-8").splitlines())
        for robot in robots
        if robot in words_of(text)
    ]
    assert offences == []


def test_a_robots_name_is_recognised_in_every_spelling_and_not_as_a_part_of_a_word():
    for text in ("an Arm7 walks", "arm7_balancing", "class Arm7Loop:", "ARM7"):
        assert " arm7 " in words_of(text)
    assert " arm " not in words_of("charm")
