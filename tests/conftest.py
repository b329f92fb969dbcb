"""Settings of every run of the tests: one thread and one process, unless a test asks for more.

The tests' arrays are small, so threads of BLAS and OpenMP would mostly wait for each other, and
workers would mostly start. Both cores are used by running two tests at a time (`make test`).
"""

import os

from hypothesis import Phase, settings

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# What joblib counts where no number of workers is given; a number that is given stays as it is.
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")
# Laws are tried on the same few examples every time, and no example is slow by accident.
settings.register_profile(
    "few",
    derandomize=True,
    max_examples=20,
    deadline=None,
    database=None,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
)
settings.load_profile("few")


def pytest_collection_modifyitems(items):
    """Hands out files with slow tests first, so that no core waits for the last of them."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        slow = {item.path for item in items if item.get_closest_marker("slow")}
        items.sort(key=lambda item: item.path not in slow)
