"""What a stranger gets: sdist → wheel → a clean environment, used from `/`."""

import importlib.metadata
import os
import resource
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from drake_safety.extras import MODULES

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# What is installed: the other folders of the source tree stand in the first.
FOLDERS = ("drake_safety", "models", "diagrams", "assessments")
# Shipped assessments come and go; this one is always there, so that the way is.
SHIPPED = {"assessments/pendulum/sharpened.safetensors", "assessments/pendulum/evaluation.json"}

pytestmark = pytest.mark.slow


def run(*command, cwd):
    """Runs a command as a stranger would: nothing of this process's Python settings is passed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    command = [str(word) for word in command]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def files_under(folder):
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def pins(name):
    """The lines of a file of exact versions."""
    lines = (ROOT / name).read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def call_backend(hook, source, out):
    """Builds with the setuptools of this environment, as `python -m build` would, offline."""
    out.mkdir()
    code = "import sys; sys.path.insert(0, '.ci'); import build_backend as b; "
    code += f"b.{hook}(sys.argv[1])"
    run(sys.executable, "-c", code, out, cwd=source)
    (built,) = out.iterdir()
    return built


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    work = tmp_path_factory.mktemp("packaging")
    checkout = work / "checkout"
    # A copy: building in place would leave egg-info and build folders in the checkout.
    kept_out = (".[!c]*", "__pycache__", "*.egg-info", "build", "dist", "runs")
    shutil.copytree(ROOT, checkout, ignore=shutil.ignore_patterns(*kept_out))
    for name in SHIPPED:
        (checkout / name).parent.mkdir(exist_ok=True)
        (checkout / name).write_text("not really one")
    return call_backend("build_sdist", checkout, work / "sdist")


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    work = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as archive:
        archive.extractall(work, filter="data")
    (source,) = work.iterdir()
    return call_backend("build_wheel", source, work / "wheel")


def environment_of(wheel, folder):
    """Makes an environment with the wheel alone; returns its site-packages."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd="/")
    python = folder / "bin" / "python"
    install = ["install", "--quiet", "--no-index", "--no-deps", wheel]
    run(sys.executable, "-m", "pip", "--python", python, *install, cwd="/")
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    return Path(run(python, "-c", code, cwd="/").strip())


def needed_by(*names):
    """Packages and all that they bring, as pip would install them."""
    found, wanted = set(), [*names]
    while wanted:
        name = wanted.pop()
        if canonicalize_name(name) not in found:
            found.add(canonicalize_name(name))
            required = map(Requirement, importlib.metadata.requires(name) or ())
            here = {"extra": ""}
            wanted += [r.name for r in required if r.marker is None or r.marker.evaluate(here)]
    return found


@pytest.fixture(scope="module")
def light_environment(wheel, tmp_path_factory):
    """An environment with the wheel and what pip installs with it, this one's, and no extra."""
    folder = tmp_path_factory.mktemp("light") / "environment"
    site_packages = environment_of(wheel, folder)
    for name in needed_by(*(Requirement(line).name for line in PROJECT["dependencies"])):
        distribution = importlib.metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
            link = site_packages / top
            if not link.exists():
                link.symlink_to(distribution.locate_file(top))
    return folder


LOOP = """
import importlib.util
import numpy as np
from pydrake.systems.analysis import Simulator
from drake_safety import load_assessment, load_scenario
loop = load_scenario({0!r}).make_loop(assessment=load_assessment({0!r}))
simulator = Simulator(loop)
loop.reset(simulator.get_mutable_context(), np.random.default_rng(0))
simulator.AdvanceTo(0.2)
print(loop.GetOutputPort("safety_probability").Eval(simulator.get_context())[0])
print(*(name for name in {1} if importlib.util.find_spec(name)))
"""
# What the extras bring, directly or not.
ABSENT = [*{name for extra in MODULES.values() for name in extra}, "numba", "statsmodels"]


def test_a_loop_with_an_assessment_runs_in_the_light_install(light_environment):
    code = LOOP.format("laikago_balancing", ABSENT)
    printed = run(light_environment / "bin" / "python", "-c", code, cwd="/")
    probability, *found = printed.splitlines()
    assert 0.0 <= float(probability) <= 1.0
    assert found == [""]


def test_targets_are_asked_for_in_the_light_install_and_answered_at_once(light_environment):
    def cpu_s():
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        return spent.ru_utime + spent.ru_stime

    started = cpu_s()
    ask = ["ask", "atlas_reaching", "--target", "0.7", "0.3", "1.0"]
    answer = run(light_environment / "bin" / "drake-safety", *ask, cwd="/")
    assert "safe: probability" in answer and str(light_environment) in answer
    # Of the processor, as other tests may run beside; on an idle machine the clock shows no more.
    assert cpu_s() - started < 5.0


def test_a_robot_is_written_and_checked_in_the_light_install(light_environment, tmp_path):
    command, folder = light_environment / "bin" / "drake-safety", tmp_path / "mine"
    urdf = ROOT / "models" / "laikago" / "laikago.urdf"
    run(command, "new", "mine", "--urdf", urdf, "--out", folder, cwd="/")
    assert "ready: " in run(command, "check", folder / "balancing.yaml", "--quick", cwd="/")


@pytest.mark.parametrize(
    ("command", "extra"), [("train pendulum --out {}", "train"), ("play pendulum", "live")]
)
def test_a_command_names_its_extra_before_it_does_anything(
    light_environment, tmp_path, command, extra
):
    folder = tmp_path / "out"
    words = [light_environment / "bin" / "drake-safety", *command.format(folder).split()]
    done = subprocess.run([str(word) for word in words], cwd="/", capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stdout.splitlines()
    assert line.startswith(f"error: {command.split()[0]}: the package '")
    assert line.endswith(f"is not installed: pip install 'drake_safety[{extra}]'")
    assert not folder.exists()


def test_the_sdist_holds_what_is_needed_to_build_and_test(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    top = "pyproject.toml LICENSE README.md constraints.txt lowest.txt Makefile"
    assert {*top.split(), ".ci/build_backend.py", ".ci/shadow.py", *SHIPPED} <= names
    for folder in ("tests", "studies", "assessments", "examples"):
        assert {f"{folder}/{name}" for name in files_under(ROOT / folder)} <= names


def test_a_folder_that_hides_an_editable_install_is_named(sdist, tmp_path):
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (source,) = (tmp_path / "unpacked").iterdir()
    environment_of(call_backend("build_editable", source, tmp_path / "wheel"), tmp_path / "own")
    python, scripts = tmp_path / "own/bin/python", tmp_path / "scripts"
    (scripts / "drake_safety").mkdir(parents=True)
    script = scripts / "mine.py"
    script.write_text(
        "try:\n    import drake_safety\nexcept ImportError as error:\n    print(error)"
    )
    assert f"the folder {scripts / 'drake_safety'} hides the" in run(python, script, cwd="/")
    (scripts / "drake_safety").rename(scripts / "other")
    script.write_text("import drake_safety\nprint(drake_safety.__file__)")
    assert run(python, script, cwd="/").strip() == str(source / "drake_safety/__init__.py")


def test_every_file_of_the_library_and_of_the_folders_beside_it_is_in_the_wheel_and_no_other(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    metadata = {name for name in names if ".dist-info/" in name}
    paths = (f"{folder}/{name}" for folder in FOLDERS for name in files_under(ROOT / folder))
    expected = {f"drake_safety/{path.removeprefix('drake_safety/')}" for path in paths}
    expected |= {f"drake_safety/{name}" for name in SHIPPED}
    assert names - metadata == expected
    assert any(name.endswith("/licenses/LICENSE") for name in metadata)


def test_no_dependency_names_an_index_or_an_address():
    listed = sum(PROJECT["optional-dependencies"].values(), PROJECT["dependencies"])
    pinned = pins("constraints.txt") + pins("lowest.txt")
    assert not [line for line in listed + pinned if "://" in line or line.startswith("-")]
    assert all(line.count("==") == 1 for line in pinned)


def test_every_lower_bound_of_what_users_install_is_a_version_that_is_tested():
    lowest = map(Requirement, pins("lowest.txt"))
    tested = {canonicalize_name(pinned.name): pinned.specifier for pinned in lowest}
    listed = [*PROJECT["dependencies"]]
    for extra, lines in PROJECT["optional-dependencies"].items():
        listed += lines if extra not in {"dev", "docs", "test"} else []
    for line in map(Requirement, listed):
        if line.name != PROJECT["name"]:
            (bound,) = [one.version for one in line.specifier if one.operator == ">="]
            assert tested[canonicalize_name(line.name)].contains(bound), line
