"""Every kernel of the package compiles for CUDA, without a GPU: Warp's NVRTC makes PTX of each module."""

import ast
import importlib
import pkgutil
from functools import partial
from pathlib import Path

import pytest
import warp as wp
from warp._src.context import user_modules

import warpshadow
from warpshadow import batch, raster, silhouette, transfer
from warpshadow.visibility import directional, exponential, log_sh

ARCHITECTURES = [75, 90]

LANES = 1
"""Receivers of a thread on a GPU, lanes.lane_count."""

# Warp's modules are named after the kernel that they hold, or after the file.
FACTORIES = {
    **{
        f"{make.__name__} {order} {horizon}": partial(make, order, horizon, LANES)
        for make in (log_sh._accumulate_kernel, log_sh._accumulate_adjoint_kernel)
        for order, horizon in [(2, False), (8, True)]
    },
    **{f"product {order}": partial(log_sh._product_kernel, order, LANES) for order in (2, 8)},
    **{
        f"exponentiate {order} {base} {keeps}": partial(exponential._exponentiate_kernel, order, base, keeps, LANES)
        for order, base, keeps in [(2, "quadratic", True), *((8, base, False) for base in exponential.THRESHOLDS)]
    },
    **{
        f"exponentiate adjoint {order} {base}": partial(exponential._exponentiate_adjoint_kernel, order, base, LANES)
        for order, base in [(2, "quadratic"), *((8, base) for base in exponential.THRESHOLDS)]
    },
    **{
        f"transmit {has_horizon}": partial(directional._transmit_kernel, has_horizon, LANES)
        for has_horizon in (False, True)
    },
    "transmit adjoint": partial(directional._transmit_adjoint_kernel, LANES),
    **{
        f"{make.__name__} {order} {is_shadowed}": partial(make, order, is_shadowed, LANES)
        for make in (transfer._sh_transfer_kernel, transfer._sh_transfer_adjoint_kernel)
        for order, is_shadowed in [(2, True), (8, True), (8, False)]
    },
    **{
        f"{make.__name__} {dtype.__name__}": partial(make, dtype)
        for make in (
            raster._interpolation,
            silhouette._add_kernel,
            silhouette._blend_kernel,
            silhouette._blend_adjoint_kernel,
        )
        for dtype in (wp.float32, wp.vec2, wp.vec3, wp.vec4)
    },
    **{f"copy {dtype.__name__}": partial(batch._copy_kernel, dtype) for dtype in (wp.float32, wp.vec3)},
}


def package_modules():
    """Names of the package's modules that can be imported without running anything."""
    names = (info.name for info in pkgutil.walk_packages(warpshadow.__path__, "warpshadow."))
    return [name for name in names if not name.endswith("__main__")]


@pytest.fixture(scope="module", autouse=True)
def imported():
    for name in package_modules():
        importlib.import_module(name)


def compile_for_cuda(module, folder):
    """Compile a Warp module; returns its PTX files."""
    wp.compile_aot_module(module, device=None, arch=ARCHITECTURES, module_dir=folder, use_ptx=True)
    return sorted(folder.glob("*.ptx"))


def check_ptx(files, kernel_names):
    """There is one file an architecture, and each has an entry for every kernel."""
    assert len(files) == len(ARCHITECTURES)
    for file, architecture in zip(files, ARCHITECTURES, strict=True):
        text = file.read_text(errors="replace")
        assert f".target sm_{architecture}" in text
        for name in kernel_names:
            assert any(".entry" in line and name in line for line in text.splitlines()), name


def warp_modules():
    """Warp modules that belong to files of the package: those not made by factories."""
    return {name: module for name, module in user_modules.items() if name.startswith("warpshadow") and module.kernels}


@pytest.mark.parametrize("name", FACTORIES)
def test_kernels_made_by_factories_compile_for_cuda(name, tmp_path):
    kernel = FACTORIES[name]()
    check_ptx(compile_for_cuda(kernel.module, tmp_path), [kernel.func.__name__])


def test_kernels_of_files_compile_for_cuda(tmp_path):
    modules = warp_modules()
    assert {"warpshadow.shading", "warpshadow.raster", "warpshadow.mesh", "warpshadow.camera"} <= set(modules)
    for name, module in modules.items():
        folder = tmp_path / name
        folder.mkdir()
        check_ptx(compile_for_cuda(module, folder), [kernel.func.__name__ for kernel in module.kernels.values()])


def test_no_kernel_of_the_package_is_left_out():
    """Reads the source: each function under @wp.kernel is one that the tests above compile."""
    written = set()
    for path in Path(warpshadow.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(d) for d in node.decorator_list):
                written.add(node.name)
    compiled = {make().func.__name__ for make in FACTORIES.values()}
    for module in warp_modules().values():
        compiled |= {kernel.func.__name__ for kernel in module.kernels.values()}
    assert len(written) > 10
    assert written <= compiled
