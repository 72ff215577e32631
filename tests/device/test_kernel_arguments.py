"""Comments in a kernel's signature: arguments under ``# out`` are outputs of its launches, those under ``# sums`` sums.

In a launch with a cost one row writes to a place of an output, and all rows add to a sum; see ``launch``.
"""

import ast
import functools
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "warpshadow"
FILES = [path for path in sorted(PACKAGE.rglob("*.py")) if "@wp.kernel" in path.read_text("utf-8")]
RESULTS = {"launch": (0, "outputs", "sums"), "launch_with_adjoint": (1, "variables", "shared")}
"""By the function that launches: number of the kernel's argument, and names of those of its outputs and sums."""


def kernels_in(node):
    """Kernels of a function, which may be one or make some."""
    functions = (each for each in ast.walk(node) if isinstance(each, ast.FunctionDef))
    return [each for each in functions if any("wp.kernel" in ast.unparse(mark) for mark in each.decorator_list)]


def argument_counts(kernel, lines):
    """How many arguments stand under each comment of a signature, by its first word."""
    counts, comment, line_number = {}, "", kernel.lineno
    for argument in kernel.args.args:
        comments = re.findall(r"^ +# (\w+)", "\n".join(lines[line_number : argument.lineno - 1]), re.MULTILINE)
        comment, line_number = [comment, *comments][-1], argument.lineno
        counts[comment] = counts.get(comment, 0) + 1
    return counts


def launched_kernels(kernel, scope, known):
    """Kernels that the first argument of a launch may be; none where it is not one of the file by its name."""
    body = kernel.body if isinstance(kernel, ast.Lambda) else kernel
    name = getattr(body.func if isinstance(body, ast.Call) else body, "id", "")
    if name in known:
        return known[name]
    assigned = (node for node in ast.walk(scope) if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call))
    makers = (node.value for node in assigned if name in [getattr(target, "id", "") for target in node.targets])
    return next((known[maker.func.id] for maker in makers if getattr(maker.func, "id", "") in known), [])


def length(values):
    """How many items a list in the source has; None where that is not to be read there."""
    if values is None:
        return 0
    items = getattr(values, "elts", [None])
    return (
        len(items) if all(isinstance(item, ast.expr) and not isinstance(item, ast.Starred) for item in items) else None
    )


@functools.cache
def launches(path):
    """Kernel, its counts of arguments, and numbers of outputs and sums of each launch in a file."""
    text = path.read_text("utf-8")
    tree, found = ast.parse(text), []
    known = {node.name: kernels_in(node) for node in tree.body if isinstance(node, ast.FunctionDef)}
    known = {name: kernels for name, kernels in known.items() if kernels}
    for scope in tree.body:
        for call in (node for node in ast.walk(scope) if isinstance(node, ast.Call)):
            if (function := getattr(call.func, "id", "")) in RESULTS:
                position, *names = RESULTS[function]
                given = {keyword.arg: keyword.value for keyword in call.keywords}
                for kernel in launched_kernels(call.args[position], scope, known):
                    counts = argument_counts(kernel, text.splitlines())
                    found.append((kernel.name, counts, *(length(given.get(name)) for name in names)))
    return found


def test_most_launches_are_read():
    assert sum(len(launches(path)) for path in FILES) > 150


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_comments_of_signatures_tell_outputs_from_sums(path):
    for name, counts, output_count, sum_count in launches(path):
        assert output_count in (None, counts.get("out", 0)), name
        assert sum_count == counts.get("sums", 0) or (sum_count is None and "sums" in counts), name
