"""A float64 build of the package, for tests: its sources, rewritten and imported under another name.

Rounding in float32 hides what is wrong in the fourth digit of a gradient; gradients of this build can be held against
central differences to eight. The package itself knows one precision and has no parameter for it.

Types and dtypes are renamed everywhere. Kernels need more, since Warp converts nothing implicitly:

    0.5                      wp.float64(0.5)
    float(n), x: float       wp.float64(n), x: wp.float64
    HALF, wp.static(…)       the same in float64 where it is a Python float; constants of kernels are in capitals
    wp.pi                    wp.float64(wp.pi)
    wp.cast(x, wp.int32)     wp.cast(wp.float32(x), wp.int32): the rasterizer sorts depths by their 32 bits
    C++ in strings           double for float and wp::float32

What the rules miss, Warp refuses to compile, since it mixes no types. So it does with kernels that trace rays or query
meshes, which it can do in float32 only.
"""

import ast
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import warp as wp

import warpshadow
from warpshadow.device.warp_internals import scalar_type

NAME = "double_warpshadow"

_KERNEL_DECORATORS = ("wp.kernel", "wp.func", "wp.struct")  # so wp.func_native and wp.func_grad


def build(folder: Path) -> ModuleType:
    """Write the float64 build into a folder and import it.

    Its modules are imported as ``double_warpshadow.stages.raster.rasterization``.
    """
    package = Path(warpshadow.__file__).parent
    for path in package.rglob("*.py"):
        target = folder / NAME / path.relative_to(package)
        target.parent.mkdir(parents=True, exist_ok=True)
        tree = ast.fix_missing_locations(_Doubled().visit(ast.parse(path.read_text("utf-8"))))
        target.write_text(ast.unparse(tree), "utf-8")
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(NAME)
    finally:
        sys.path.remove(str(folder))


class _Doubled(ast.NodeTransformer):
    """Rewrites a module."""

    def __init__(self) -> None:
        self.in_kernel = False

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.ClassDef) -> ast.AST:
        decorators, node.decorator_list = node.decorator_list, []
        outside = self.in_kernel
        self.in_kernel |= any(ast.unparse(decorator).startswith(_KERNEL_DECORATORS) for decorator in decorators)
        self.generic_visit(node)
        self.in_kernel = outside
        node.decorator_list = [self.visit(decorator) for decorator in decorators]
        return node

    visit_ClassDef = visit_FunctionDef

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        if node.module and node.level == 0:
            node.module = _renamed(node.module)
        return node

    def visit_alias(self, node: ast.alias) -> ast.AST:
        return ast.alias(_renamed(node.name), node.asname)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        value = getattr(wp, node.attr, None) if ast.unparse(node.value) == "wp" else None
        if node.attr == "float32":  # of Warp, NumPy or torch
            node.attr = "float64"
        elif scalar_type(value) is wp.float32:  # vec3 and vec3f, mat44, quat, …
            node.attr = node.attr.removesuffix("f") + "d"
        elif self.in_kernel and isinstance(value, float):
            return _call("wp.float64", node)
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        if self.in_kernel and node.id == "float":
            return _expression("wp.float64")
        if self.in_kernel and node.id.isupper():
            return _static(node)
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if isinstance(node.value, str):
            return ast.Constant(re.sub(r"\b(wp::float32|float)\b", "double", node.value))
        if self.in_kernel and isinstance(node.value, float):
            return _call("wp.float64", node)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if self.in_kernel and ast.unparse(node.func) == "wp.static":
            return _static(node.args[0])
        self.generic_visit(node)
        if self.in_kernel and ast.unparse(node.func) == "wp.cast" and ast.unparse(node.args[1]) == "wp.int32":
            node.args[0] = _call("wp.float32", node.args[0])
        return node

    def visit_keyword(self, node: ast.keyword) -> ast.AST:
        if node.arg == "dtype" and ast.unparse(node.value) == "float":
            node.value = _expression("wp.float64")
        return self.generic_visit(node)


def _renamed(module: str) -> str:
    """Name of a module in this build, where it is the package's."""
    return re.sub(r"^warpshadow\b", NAME, module)


def _expression(source: str) -> ast.expr:
    return ast.parse(source, mode="eval").body


def _call(function: str, argument: ast.expr) -> ast.expr:
    return ast.Call(_expression(function), [argument], [])


def _static(value: ast.expr) -> ast.expr:
    """A constant of a kernel, known when the kernel is made: in float64 if it is a Python float."""
    source = ast.unparse(value)
    return _expression(f"wp.static(wp.float64({source}) if isinstance({source}, float) else {source})")
