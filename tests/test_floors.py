"""The house's rules, read from the source: each rule is a function that returns its offences."""

import ast
import functools
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

import pytest

from drake_safety.extras import MODULES

ROOT = Path(__file__).resolve().parents[1]

# Each room and the rooms it may import besides itself. `models`, `diagrams` and
# `assessments` are the folders beside the library. A scenario names its task by import path, so no
# room imports `diagrams`.
ALLOWED = {
    "learning": set(),
    "robots": set(),
    "assessments": {"learning"},
    "models": {"robots"},
    "plants": {"learning", "robots"},
    "control": {"learning", "plants", "robots"},
    "policies": {"control", "robots"},
    "systems": {"learning", "control", "plants", "policies", "robots"},
}
ALLOWED["simulation"] = {*ALLOWED["systems"], "systems", "models"}
ALLOWED["planning"] = {*ALLOWED["simulation"], "simulation"}
ALLOWED["evaluation"] = {*ALLOWED["planning"], "planning"}
ALLOWED["diagrams"] = {*ALLOWED["evaluation"], "evaluation"}
LEAVES = ("importing", "live", "logs")
ALLOWED |= {leaf: {*ALLOWED["diagrams"], "diagrams"} for leaf in LEAVES}
ALLOWED["cli"] = {*ALLOWED["diagrams"], "diagrams", "assessments", *LEAVES}
# Every room may name the extra that it needs, and write files.
EVERYWHERE = ("extras", "files")
ALLOWED |= {"extras": set(), "files": set()}
BESIDE = ("models", "diagrams", "assessments")
# An online run needs none of these, so importing the library must not either.
HEAVY = {"torch", "tslearn", "dtaidistance", "openTSNE", "sklearn", "pyarrow", "matplotlib"}
HEAVY |= {"mcap", "rosbags", "pandas", "mujoco", "onnx", "trimesh", "collada"}
# Each extra and the files that may import what only it brings.
EXTRAS = {
    "cluster": ("drake_safety/simulation/cluster",),
    "live": ("drake_safety/live/page",),
    "logs": ("drake_safety/logs/",),
    "mujoco": ("drake_safety/plants/mujoco", "drake_safety/importing/mjcf.py"),
    "onnx": ("drake_safety/learning/onnx_graph.py",),
    "report": ("drake_safety/evaluation/report.py",),
    "robots": ("drake_safety/robots/",),
    "train": (
        "drake_safety/policies/policy_network.py",
        "drake_safety/evaluation/baselines.py",
        "drake_safety/evaluation/shift_study.py",
        "drake_safety/learning/",
        "drake_safety/simulation/dataset.py",
        "drake_safety/simulation/episode_shards.py",
    ),
    "walking": ("drake_safety/policies/policy_network.py",),
}
ONLY_IN = {
    "cloudpickle": ("drake_safety/simulation/worker_processes.py",),
    "torch": (
        "drake_safety/learning/maps.py",
        "drake_safety/learning/state_predictor.py",
        "drake_safety/policies/policy_network.py",
    ),
    "tslearn": ("drake_safety/learning/distance.py",),
    "dtaidistance": ("drake_safety/learning/distance.py",),
    "mujoco": ("drake_safety/plants/mujoco_model.py", "drake_safety/importing/mjcf.py"),
}
PICKLING = {"pickle", "cPickle", "dill", "shelve", "marshal"}
PICKLING_CALLS = {"torch.save", "torch.load", "joblib.dump", "joblib.load", "pd.read_pickle"}
PORT_WORDS = re.compile(r"(.*\.)?(LeafSystem|VectorSystem|Declare\w*Port|Export(In|Out)put)")
# The attribute of a node of the source that holds a word.
WORDS = {ast.Name: "id", ast.Attribute: "attr", ast.alias: "name"}
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "manager", "managers", "data"}


def source_files(*folders):
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def relative(path):
    return path.relative_to(ROOT).as_posix()


LIBRARY = source_files("drake_safety", *BESIDE)
PYTHON = LIBRARY + source_files("studies", "tests", "benchmarks", "tutorials")


def module_of(name):
    """`drake_safety/learning/grid.py` → `drake_safety.learning.grid`; `models/x.py` likewise."""
    parts = name.removesuffix(".py").split("/")
    if parts[0] in BESIDE:
        parts.insert(0, "drake_safety")
    return ".".join(parts)


def room_of(module):
    """The room of a dotted name inside the package, or None for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


@functools.cache
def imports_of(source, name):
    """Every import of a file: (dotted name, line, whether it runs when the file is imported)."""
    found = []

    def add(node, dotted, runs):
        found.append((dotted, node.lineno, runs))

    def visit(node, runs):
        if isinstance(node, ast.Import):
            for alias in node.names:
                add(node, alias.name, runs)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module_of(name).removesuffix(".__init__").split(".")
                climbs = node.level - name.endswith("/__init__.py")
                kept = package[: len(package) - climbs]
                base = ".".join([*kept, *([node.module] if node.module else [])])
            for alias in node.names:
                add(node, f"{base}.{alias.name}", runs)
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called.split(".")[-1] in ("import_module", "__import__") and node.args:
                if isinstance(node.args[0], ast.Constant):
                    add(node, str(node.args[0].value), runs)
        for child in ast.iter_child_nodes(node):
            is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            is_typing = isinstance(node, ast.If) and ast.unparse(node.test).endswith(
                "TYPE_CHECKING"
            )
            inside = is_function or (is_typing and child not in node.orelse)
            visit(child, runs and not inside)

    visit(ast.parse(source), True)
    return found


def upward_imports(source, name):
    room = room_of(module_of(name))
    offences = []
    for dotted, line, _ in imports_of(source, name):
        if dotted.split(".")[0] == "studies":
            offences.append(f"{name}:{line} imports {dotted}, which is not installed")
        if dotted.split(".")[0] != "drake_safety" or room == "__init__":
            continue
        target = room_of(dotted)
        if target is not None and target not in ALLOWED:
            if target != "__version__":
                offences.append(f"{name}:{line} imports {dotted}: import it from its own room")
        elif target not in {None, room, *EVERYWHERE} | ALLOWED.get(room, set()):
            offences.append(f"{name}:{line} in {room} imports {dotted}")
    return offences


DRAWING = {
    f"drake_safety/evaluation/{name}.py"
    for name in (
        *(
            f"{what}_figure"
            for what in ("embedding", "gate", "interval", "path", "robot", "timeline")
        ),
        *("truth_figure", "figure_style", "reliability", "shift_study"),
    )
}


def forbidden_imports(source, name):
    room = room_of(module_of(name))
    offences = []
    for dotted, line, runs in imports_of(source, name):
        top = dotted.split(".")[0]
        if room == "learning" and top == "pydrake":
            offences.append(f"{name}:{line} learning imports {dotted}")
        if name not in ONLY_IN.get(top, [name]):
            rooms = " or ".join(ONLY_IN[top])
            offences.append(f"{name}:{line} imports {dotted}, which belongs in {rooms}")
        # Modules of commands and of figures are imported when a command is called.
        draws = top == "matplotlib" and (room == "cli" or name in DRAWING)
        if top in HEAVY and runs and not draws:
            offences.append(f"{name}:{line} imports {dotted} outside a function")
    return offences


def forbidden_anywhere(source, name):
    offences = []
    for dotted, line, _ in imports_of(source, name):
        top = dotted.split(".")[0]
        if top in PICKLING:
            offences.append(f"{name}:{line} imports {dotted}")
        if dotted.startswith("pydrake.all"):
            offences.append(f"{name}:{line} imports pydrake.all")
        if top in BESIDE:
            offences.append(f"{name}:{line} imports {dotted}: it is drake_safety.{dotted}")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in PICKLING_CALLS or called.endswith(".to_pickle"):
                offences.append(f"{name}:{node.lineno} calls {called}, which pickles")
            for keyword in node.keywords:
                allows = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
                if keyword.arg == "allow_pickle" and allows:
                    offences.append(f"{name}:{node.lineno} allows pickle")
    return offences


def ports(source, name):
    words = [
        (node.lineno, getattr(node, WORDS[type(node)]))
        for node in ast.walk(ast.parse(source))
        if type(node) in WORDS
    ]
    return [
        f"{name}:{line} has ports: {word}" for line, word in words if PORT_WORDS.fullmatch(word)
    ]


def words_of(text):
    """Splits at whatever is no letter or digit and before capitals: `Spot2Arm` → ` spot2 arm `."""
    words = re.findall(r"[A-Z]+(?![a-z])[0-9]*|[A-Z]?[a-z0-9]+", text)
    return f" {' '.join(words).lower()} "


def named_robots(text, name, robots):
    return [
        f"{name}:{number} names the robot {robot}"
        for number, line in enumerate(text.splitlines(), 1)
        for robot in robots
        if words_of(robot) in words_of(line)
    ]


def borrowed_tests(source, name):
    """Imports from a test module, whose own tests would be imported and its fixtures not found."""
    return [
        f"{name}:{line} imports {dotted}: what tests share stands in a module without `test_`"
        for dotted, line, _ in imports_of(source, name)
        if dotted.split(".")[0].startswith("test_")
    ]


def offences_in(rule, paths):
    sources = ((path.read_text(encoding="utf-8"), relative(path)) for path in paths)
    return [offence for source, name in sources for offence in rule(source, name)]


def test_imports_only_go_down():
    assert offences_in(upward_imports, LIBRARY) == []


def test_learning_is_free_of_drake_and_heavy_imports_stay_inside_functions():
    assert offences_in(forbidden_imports, LIBRARY) == []


def test_control_has_no_ports():
    assert offences_in(ports, source_files("drake_safety/control")) == []


def test_nothing_pickles_or_imports_all_of_drake_or_the_folders_as_packages():
    assert offences_in(forbidden_anywhere, PYTHON) == []


def test_no_test_module_imports_from_another():
    assert offences_in(borrowed_tests, source_files("tests")) == []


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def names_of(requirements):
    return {re.match(r"[\w-]+", line)[0].lower() for line in requirements}


def test_every_package_the_library_imports_is_a_declared_dependency():
    declared = names_of(PROJECT["dependencies"])
    # What an extra brings may be imported under its modules' names, in that extra's files alone.
    optional = {
        (name, place)
        for extra, files in EXTRAS.items()
        for name in MODULES[extra]
        for place in files
    }
    providers = packages_distributions()
    imported = {
        (dotted.split(".")[0], relative(path))
        for path in LIBRARY
        for dotted, _, _ in imports_of(path.read_text(encoding="utf-8"), relative(path))
    }
    own = {"drake_safety", "__future__"} | sys.stdlib_module_names
    third_party = {(name, path) for name, path in imported if name not in own}
    assert {"numpy", "pydrake", "rosbags"} <= {name for name, _ in third_party}
    assert [
        (name, path)
        for name, path in sorted(third_party)
        if not any((name, place) in optional and path.startswith(place) for _, place in optional)
        and not any(provider.lower() in declared for provider in providers.get(name, [name]))
    ] == []


def test_each_extra_declares_what_the_library_imports_of_it():
    providers = packages_distributions()
    assert MODULES.keys() == EXTRAS.keys()
    for extra, modules in MODULES.items():
        declared = names_of(PROJECT["optional-dependencies"][extra])
        for name in modules:
            # What is not installed here is provided by nothing.
            assert not find_spec(name) or {one.lower() for one in providers[name]} & declared


def test_no_robot_is_named_in_the_library_or_in_a_task():
    robots = [path.parent.name for path in (ROOT / "models").glob("*/robot.yaml")]
    assert robots
    files = [
        path
        for path in (ROOT / "drake_safety").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    files += source_files("diagrams", "assessments")
    assert offences_in(lambda text, name: named_robots(text, name, robots), files) == []
    assert [path for path in files if named_robots(path.name, path.name, robots)] == []


def test_every_module_stands_in_a_room_and_says_what_it_is():
    rooms = {room_of(module_of(relative(path))) for path in LIBRARY}
    assert rooms <= {*ALLOWED, "__init__"}
    assert [relative(path) for path in LIBRARY if path.stem in VAGUE_NAMES] == []
    # A folder of a robot is no Python package.
    assert list((ROOT / "models").glob("*/**/__init__.py")) == []


ROOM = "drake_safety/{}/a.py".format
LEARNING, EVALUATION, CONTROL = map(ROOM, ("learning", "evaluation", "control"))
IN_FUNCTIONS = "if TYPE_CHECKING:\n    import torch\ndef f():\n    import torch"


@pytest.mark.parametrize(
    ("rule", "name", "source", "message"),
    [
        (upward_imports, ROOM("systems"), "import drake_safety.cli", "imports"),
        (upward_imports, ROOM("systems"), "from ..simulation import x", "simulation"),
        (upward_imports, ROOM("systems"), "from .. import evaluation", "evaluation"),
        (upward_imports, "drake_safety/systems/__init__.py", "from ..cli import x", "cli"),
        (upward_imports, LEARNING, "def f():\n    from drake_safety.robots import r", "learning"),
        (upward_imports, ROOM("simulation"), "import_module('drake_safety.diagrams')", "diagrams"),
        (upward_imports, ROOM("cli"), "from drake_safety import Scenario", "own room"),
        (upward_imports, ROOM("cli"), "from studies import x", "not installed"),
        (upward_imports, "models/__init__.py", "from drake_safety.control.qp import x", "models"),
        (upward_imports, "diagrams/a.py", "from drake_safety.evaluation import x", "diagrams"),
        (forbidden_imports, LEARNING, "import pydrake.math", "learning"),
        (forbidden_imports, EVALUATION, "def f():\n    import torch.nn", "belongs in drake_safety"),
        (forbidden_imports, LEARNING, "import matplotlib", "outside"),
        (forbidden_imports, EVALUATION, "import matplotlib", "outside"),
        (forbidden_imports, EVALUATION, "class A:\n    from sklearn import svm", "outside"),
        (forbidden_anywhere, "tests/a.py", "from pydrake.all import x", "pydrake.all"),
        (forbidden_anywhere, "tests/a.py", "import pickle", "pickle"),
        (forbidden_anywhere, "tests/a.py", "from diagrams import balancing", "drake_safety.diag"),
        (forbidden_anywhere, "tests/a.py", f"np.load(f, allow_pickle={True})", "allows pickle"),
        (forbidden_anywhere, "tests/a.py", "torch.save(net, path)", "pickles"),
        (borrowed_tests, "tests/test_a.py", "from test_b import c", "without `test_`"),
        (borrowed_tests, "tests/a.py", "def f():\n    import test_b", "imports test_b"),
        (ports, CONTROL, "class A(LeafSystem): pass", "LeafSystem"),
        (ports, CONTROL, "s.DeclareVectorInputPort('u', 1)", "Port"),
        (ports, CONTROL, "from p import LeafSystem as L", "LeafSystem"),
        (upward_imports, ROOM("cli"), "from drake_safety.evaluation import report", None),
        (upward_imports, ROOM("systems"), "from . import b\nfrom ..control import c", None),
        (upward_imports, "models/__init__.py", "from drake_safety.robots.robot import x", None),
        (upward_imports, ROOM("cli"), "from drake_safety import __version__", None),
        (forbidden_imports, "drake_safety/learning/maps.py", IN_FUNCTIONS, None),
        (forbidden_imports, "drake_safety/evaluation/path_figure.py", "import matplotlib", None),
        (forbidden_anywhere, "tests/a.py", "np.load(path, allow_pickle=False)", None),
        (forbidden_anywhere, "tests/a.py", "import drake_safety.models", None),
        (borrowed_tests, "tests/test_a.py", "from lip_episodes import make_episodes", None),
    ],
)
def test_each_rule_catches_its_offence_and_no_other(rule, name, source, message):
    offences = rule(source, name)
    assert len(offences) == (message is not None)
    assert all(message in offence for offence in offences)


def test_a_robot_is_recognised_in_every_spelling_and_a_part_of_a_word_is_not():
    for text in ("an Arm7 walks", "arm7_balancing", "class Arm7Loop:", "ARM7"):
        assert named_robots(text, "a.py", ["arm7"]) == ["a.py:1 names the robot arm7"]
    assert named_robots("a SpotArm", "a.py", ["spot_arm"])
    assert not named_robots("data1 charm", "a.py", ["a1", "arm"])
