"""What the tests share: devices, golden values, and the optional data of real meshes and maps."""

import gc
import importlib
import math
import pkgutil
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import warp as wp

import warpshadow
from warpshadow.device import cuda_graph, lanes, parallel, progress
from warpshadow.pipeline.bodies import self_visibility
from warpshadow.stages.self_visibility import trace

warpshadow.quiet()

START = time.monotonic()
SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_addoption(parser):
    parser.addoption("--devices", help="run only tests that take a device, on these: cuda:0, or cpu,cuda:0")
    parser.addoption("--seconds", type=float, help="begin no further test after so many seconds")


def pytest_generate_tests(metafunc):
    """Run a test that takes ``device`` once on every device that is available, or that was asked for."""
    if "device" in metafunc.fixturenames:
        wp.init()
        asked = metafunc.config.getoption("devices")
        aliases = asked.split(",") if asked else [device.alias for device in wp.get_devices()]
        metafunc.parametrize("device", aliases)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among the two million objects of modules and tests: they last as long as the session."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


def pytest_collection_modifyitems(config, items):
    """Begin with the files that take longest; leave out tests that take no device, where devices were asked for.

    The last file then leaves no process idle for long. A slow test takes as long as ten others.
    """
    work = Counter()
    for item in items:
        work[item.path] += 10 if item.get_closest_marker("slow") else 1
    items.sort(key=lambda item: (-work[item.path], item.path))
    if config.getoption("devices"):
        others = [item for item in items if "device" not in item.fixturenames]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if "device" in item.fixturenames]


def pytest_runtest_teardown(item):
    """End the session after this test, once its time is up."""
    seconds = item.config.getoption("seconds")
    if seconds is not None and time.monotonic() - START > seconds:
        item.session.shouldstop = f"{seconds:.0f} s are over"


@pytest.fixture(scope="session", autouse=True)
def note_of_tests(request, record_testsuite_property):
    """A JUnit report says how many tests there were to run, as well as which were run."""
    record_testsuite_property("collected", request.session.testscollected)


@pytest.fixture(autouse=True)
def no_lines(monkeypatch):
    """Tests that compile kernels take as long as they take: no line says how far they are."""
    monkeypatch.setattr(progress, "_LINE_INTERVAL", 3600.0)


@pytest.fixture(scope="session")
def golden_data() -> Path:
    """Folder of values computed in float64; its README says of what."""
    return Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real meshes and environment maps."""
    if not SHARED_DATA.is_dir():
        pytest.skip("shared/data (real meshes, environment maps) is not beside this checkout")
    return SHARED_DATA


@pytest.fixture(scope="module")
def one_thread():
    """Small tensors gain nothing from threads, which wait for each other where cores are shared; and sums differ."""
    import torch

    count = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(count)


@pytest.fixture
def few_rays(monkeypatch):
    """Find shadows of bodies on themselves by 512 rays a point: tests that compare two images need no finer ones.

    Where none are cached, as in CI, they take most of the time of such a test.
    """
    for module in (self_visibility, trace):
        monkeypatch.setattr(module, "RAYS", 512)


@pytest.fixture
def verified_tape(monkeypatch):
    """Let Warp report arrays that a tape sees overwritten. Kernels compile anew for it, so only tape tests ask."""
    monkeypatch.setattr(wp.config, "verify_autograd_array_access", True)


@pytest.fixture
def poisoned_outputs(monkeypatch):
    """Fill what is allocated with NaN or −1, so that what a kernel leaves unwritten or reads too early shows."""
    empty = wp.empty

    def poisoned(*args, **kwargs):
        array = empty(*args, **kwargs)
        size = array.size * wp.types.type_size_in_bytes(array.dtype)
        if size:  # all bits 1 are NaN or −1
            wp.array(ptr=array.ptr, dtype=wp.uint8, shape=size, device=array.device).fill_(255)
        return array

    monkeypatch.setattr(wp, "empty", poisoned)
    monkeypatch.setattr(
        wp, "empty_like", lambda a, **options: poisoned(a.shape, **{"dtype": a.dtype, "device": a.device} | options)
    )


@pytest.fixture
def gpu_branches(monkeypatch):
    """Let the CPU launch what a GPU would: a lane a thread, a thread a sample, nothing that can be read for free.

    Arguments of kernels are those of a GPU, too. The order of threads is not: the CPU runs one after another.
    """
    for info in pkgutil.walk_packages(warpshadow.__path__, "warpshadow."):
        if not info.name.endswith("__main__"):
            importlib.import_module(info.name)

    def launch_whole(kernel, dim, *, cost, inputs, outputs, scratch=(), sums=(), device):
        dim = (dim,) if isinstance(dim, int) else dim
        rows = [wp.empty((math.prod(dim), *shape), dtype=dtype, device=device) for shape, dtype in scratch]
        arguments = [0, -1, *inputs, *rows, *outputs, *sums]
        wp.launch(kernel, dim=dim, inputs=arguments, device=device, record_tape=False)

    def launch_whole_adjoint(kernel, dim, *, cost, inputs, outputs, shared, device):
        arguments = [*inputs, *outputs]
        gradients = [value.grad if isinstance(value, wp.array) else wp.Tape().get_adjoint(value) for value in arguments]
        options = {"adj_inputs": [None, None, *gradients], "adjoint": True, "record_tape": False}
        wp.launch(kernel, dim=dim, inputs=[0, -1, *arguments], device=device, **options)

    replaced = {
        parallel.run_length: lambda device, width: 1,
        parallel.run_dimensions: lambda device, runs, instances: (instances, runs),
        parallel.strip_count: lambda device: 16,
        parallel.launch_slices: launch_whole,
        parallel.launch_adjoint_slices: launch_whole_adjoint,
        lanes.lane_count: lambda device: 1,
        lanes.sector_count: lambda device, direction_count: direction_count // lanes.CHUNK,
        cuda_graph.is_readable: lambda device: False,
    }
    for module in [module for name, module in sys.modules.items() if name.startswith("warpshadow")]:
        for old, new in replaced.items():
            if getattr(module, old.__name__, None) is old:
                monkeypatch.setattr(module, old.__name__, new)
