"""What importing the package does, and what it leaves alone."""

import logging
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import drake_safety
from drake_safety import load_scenario

ROOT = Path(__file__).resolve().parents[1]


def test_only_what_is_installed_is_found_under_the_packages_name():
    for name in ("benchmarks", "tests", "tutorials", "docs", "drake_safety"):
        assert find_spec(f"drake_safety.{name}") is None
    assert list(drake_safety.__path__) == [str(ROOT / "drake_safety")]


def test_a_checkout_needs_no_installation():
    # Without the finder that an editable install, be it of another checkout, has left behind.
    code = (
        "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'ditable' not in repr(f)]; "
        "import drake_safety.models as m, drake_safety.diagrams.pendulum.task as d; "
        "print(m.__file__, d.__file__)"
    )
    said = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True)
    modules = ("models/__init__.py", "diagrams/pendulum/task.py")
    assert said.split() == [str(ROOT / name) for name in modules]


def test_drakes_log_is_not_filtered_and_a_loop_gives_no_cause_to():
    drake = logging.getLogger("drake")
    said = []
    handler = logging.Handler()
    handler.emit = said.append
    drake.addHandler(handler)
    try:
        loop = load_scenario("laikago_balancing").make_loop()
        loop.reset(loop.CreateDefaultContext(), np.random.default_rng(0))
    finally:
        drake.removeHandler(handler)
    assert drake.filters == []
    assert said == []
