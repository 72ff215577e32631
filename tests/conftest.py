"""Fixtures shared by the tests: devices, and the optional data of real meshes, maps and golden values."""

from pathlib import Path

import pytest
import warp as wp

wp.config.quiet = True

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_generate_tests(metafunc):
    """Run a test that takes ``device`` once on every device that is available."""
    if "device" in metafunc.fixturenames:
        wp.init()
        metafunc.parametrize("device", [device.alias for device in wp.get_devices()])


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real meshes, environment maps and golden values."""
    if not SHARED_DATA.is_dir():
        pytest.skip("shared/data (real meshes, environment maps, golden values) is not beside this checkout")
    return SHARED_DATA


@pytest.fixture
def verified_tape(monkeypatch):
    """Let Warp report arrays that a tape sees overwritten. Kernels compile anew for it, so only tape tests ask."""
    monkeypatch.setattr(wp.config, "verify_autograd_array_access", True)
