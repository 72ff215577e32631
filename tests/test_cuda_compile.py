"""Every kernel of the package compiles for CUDA, without a GPU: Warp's NVRTC makes PTX of each module.

Kernels with a budget of registers are left to ``demos/test_kernel_report.py``, which compiles them to machine code.
"""

import ast
from pathlib import Path

import pytest

import warpshadow
from demos.tools.cuda_kernels import FACTORIES, compile_module, file_modules, import_package
from demos.tools.kernel_report import BUDGETS

ARCHITECTURES = [75]  # the oldest; nothing in a kernel's source asks for its architecture


@pytest.fixture(scope="module", autouse=True)
def imported():
    import_package()


def check_ptx(files, kernel_names):
    """There is one file an architecture, and each has an entry for every kernel."""
    assert len(files) == len(ARCHITECTURES)
    for file, architecture in zip(files, ARCHITECTURES, strict=True):
        text = file.read_text(errors="replace")
        assert f".target sm_{architecture}" in text
        for name in kernel_names:
            assert any(".entry" in line and name in line for line in text.splitlines()), name


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FACTORIES if name not in BUDGETS])
def test_kernels_made_by_factories_compile_for_cuda(name, tmp_path):
    kernel = FACTORIES[name]()
    check_ptx(compile_module(kernel.module, ARCHITECTURES, tmp_path), [kernel.func.__name__])


@pytest.mark.slow
def test_kernels_of_files_compile_for_cuda(tmp_path):
    modules = file_modules()
    assert {
        "warpshadow.stages.light.shading",
        "warpshadow.stages.raster.rasterization",
        "warpshadow.stages.geometry.normals",
        "warpshadow.stages.raster.project",
    } <= set(modules)
    for name, module in ((name, module) for name, module in modules.items() if name not in BUDGETS):
        folder = tmp_path / name
        folder.mkdir()
        kernel_names = [kernel.func.__name__ for kernel in module.kernels.values()]
        check_ptx(compile_module(module, ARCHITECTURES, folder), kernel_names)


def test_no_kernel_of_the_package_is_left_out():
    """Reads the source: each function under @wp.kernel is one that the tests above compile."""
    written = set()
    for path in Path(warpshadow.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(d) for d in node.decorator_list):
                written.add(node.name)
    compiled = {make().func.__name__ for make in FACTORIES.values()}
    for module in file_modules().values():
        compiled |= {kernel.func.__name__ for kernel in module.kernels.values()}
    assert len(written) > 10
    assert written <= compiled
