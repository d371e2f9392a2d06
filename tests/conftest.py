"""Fixtures: a test that takes ``device`` runs on every device of the machine."""

# ruff: noqa: E402
import os

# Each worker has a core: threads of linear algebra would wait for one another. NumPy reads this when it is imported.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# Programs that tests start need not compile the package's modules again each time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import gc

import pytest
import warp as wp

#: Each worker takes some gigabytes in the end, and compiles its kernels first.
MOST_WORKERS = 4

wp.config.quiet = True
# As the command line has it. Newton's kernels have adjoints otherwise, which take most of the time to compile.
wp.config.enable_backward = False
wp.init()

from warp_corot.inputs import loading

#: Folders whose tests have loops in real time, in which nothing may be compiled.
IN_TIME = {"haptics", "viewing"}
_compiles_all = [False]


def _begin_loading(names, device, kernels=(), begin=loading.begin_loading):
    """Simulations load all kernels of their laws before the first step. On the CPU tests compile only those that they
    launch, which takes two thirds of the time; programs that tests start, as test_loading does, load all of them."""
    return begin(names, device, kernels) if _compiles_all[0] or wp.get_device(device).is_cuda else []


# Before modules of the package take it by name.
loading.begin_loading = _begin_loading


def pytest_runtest_setup(item: pytest.Item) -> None:
    _compiles_all[0] = item.path.parent.name in IN_TIME


def pytest_sessionstart() -> None:
    """Collect no garbage while modules and tests are collected: imports make next to none."""
    gc.disable()


def pytest_collection_finish() -> None:
    """From now on collections look through what tests make, not through the syntax trees of all kernels."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A worker for each core, up to four; none for a single file or test, which is done before workers start."""
    if len(config.args) == 1 and ".py" in config.args[0]:
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A browser's tests, half a minute each, come before Newton's: no worker waits for them alone at the end."""
    pages = [item for item in items if item.path.name == "test_page.py"]
    others = [item for item in items if item.path.name != "test_page.py"]
    at = next((k for k, item in enumerate(others) if item.path.parent.name == "newton"), 0)
    items[:] = [*others[:at], *pages, *others[at:]]


@pytest.fixture(params=["cpu", *(str(device) for device in wp.get_cuda_devices())])
def device(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def rng():
    import numpy as np

    return np.random.default_rng(20130705)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A new folder, which is also the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
