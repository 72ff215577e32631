"""Names and docstrings: one word, one meaning."""

import ast
import functools
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "warpshadow"
FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted(Path(__file__).parent.rglob("test_*.py"))

PREPOSITIONS = set(
    """across against ahead along amid among apart around aside beside besides between beyond by despite during each
    except for from here in inside on past per since than there through throughout till toward towards under
    underneath until upon via with""".split()  # noqa: SIM905
)
"""And adverbs, that no name is; in one, as in ``planes_around``, an object follows it or it follows one."""
VAGUE = set(
    """agreed asked bend blurred climbs closest compared computed cropped dark doubled doubtful dragged early ended
    enters escaping evaluated faded failed farther fewer forced found gained given held large later least less look
    loaded meets more most narrow nearer padded painted parsed pending picked presence ranked reaches refused rendered
    repeated resumed rolled same saved sent shadowed shifted sized solved spot standing stands
    started summed timed tried untimed untried viewed warned""".split()  # noqa: SIM905
)
"""Verbs, participles, comparatives and words of many senses: none is a name, since it does not say of what."""
REPLACED = set(
    """amount answered arm asked assembly brought consumed decline developed exitance flats gained hold kept
    lack lean leaning learned lenders loudness meant most news opened partwise portioned presence previewed pull pulled
    pulls reaching rooms said seat sense sites slab spun taken takes told torque truth walk want wanted way worst
    worth""".split()  # noqa: SIM905
)
"""Words that no name has among its parts; the glossary of warpshadow/README.md has others for what they meant."""
SHARES = {"share", "shares"}  # as names of fields, too: of what, see the glossary


def parts(name: str) -> list[str]:
    """The words of a name, in small letters."""
    return re.sub("(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().strip("_").split("_")


FIRST_WORDS = ("Those ", "That which ", "Whatever ")
WITHOUT_SUBJECT = re.compile(
    r"^(the same|these|others?)\b|\b(of which|those that|those which|likewise)\b", re.IGNORECASE
)
WHAT = re.compile(r"\bwhat\b", re.IGNORECASE)


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def trees() -> Iterator[tuple[str, ast.Module]]:
    for path in FILES:
        yield str(path.relative_to(PACKAGE)), tree_of(path)


def names(node: ast.AST) -> Iterator[tuple[str, int]]:
    """Names of classes, functions, arguments and variables; a method or field is read with its object's name."""
    for child in ast.iter_child_nodes(node):
        is_function = isinstance(child, ast.FunctionDef) and not isinstance(node, ast.ClassDef)
        if is_function or isinstance(child, ast.ClassDef):
            yield child.name, child.lineno
        elif isinstance(child, ast.arg):
            yield child.arg, child.lineno
        elif isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
            yield child.id, child.lineno
        is_field = isinstance(node, ast.ClassDef) and isinstance(child, ast.Assign | ast.AnnAssign)
        if not is_field:
            yield from names(child)


def all_names(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Each name, fields, attributes, functions and methods included."""
    for node in ast.walk(tree):
        stored = isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store)
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.arg) or stored:
            yield next(getattr(node, key) for key in ("name", "arg", "id", "attr") if hasattr(node, key)), node.lineno


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Docstrings of modules, classes and functions, and the strings below constants and fields."""
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            value = child.value if isinstance(child, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value.strip(), child.lineno


def types_in(tree: ast.Module) -> Iterator[str]:
    """Names of classes, and of a module's type aliases: words that begin with a capital letter, but type variables."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            maker = getattr(getattr(node.value, "func", None), "id", "")
            is_type = isinstance(target, ast.Name) and re.match("[A-Z][A-Za-z0-9]*[a-z]|[A-Z]$", target.id)
            if is_type and maker not in ("TypeVar", "ParamSpec"):
                yield target.id
    yield from (node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef))


CLASSES = {node.name: node for _, tree in trees() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def arguments(node: ast.AST) -> set[str]:
    """Arguments of a function; of a class those of its constructor, and its fields, inherited ones included."""
    if isinstance(node, ast.FunctionDef):
        signature = node.args
        variable = [argument for argument in (signature.vararg, signature.kwarg) if argument is not None]
        return {item.arg for item in (*signature.posonlyargs, *signature.args, *signature.kwonlyargs, *variable)}
    names = set()
    for child in node.body:
        if isinstance(child, ast.FunctionDef) and child.name == "__init__":
            names |= arguments(child)
        elif isinstance(child, ast.AnnAssign):
            names.add(child.target.id)
    bases = [CLASSES[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in CLASSES]
    return names.union(*map(arguments, bases))


def documented_arguments(docstring: str) -> Iterator[str]:
    """Names of the entries of a docstring's section "Args"."""
    section = re.search(r"^Args:\n((?: +.*\n?|\n)*)", docstring, re.MULTILINE)
    lines = section[1].splitlines() if section else []
    indents = [len(line) - len(line.lstrip()) for line in lines]
    for line, indent in zip(lines, indents, strict=True):
        if line.strip() and indent == indents[0]:
            yield from (name.strip(" *") for name in line.partition(":")[0].split(","))


def test_no_two_classes_or_type_aliases_have_one_name():
    counts = Counter(name for _, tree in trees() for name in types_in(tree))
    assert len(counts) > 200 and not [name for name, count in counts.items() if count > 1]


def test_types_are_classes_and_aliases():
    tree = ast.parse("A: TypeAlias = int\nB = TypeVar()\nC = Union[int, str]\nd = 1\nclass E: pass\nE_MAX = F[0] = 2")
    assert list(types_in(tree)) == ["A", "C", "E"]


def test_no_two_files_of_stages_have_public_functions_of_one_name():
    functions = {
        (path, node.name)
        for path, tree in trees()
        if path.startswith("stages")
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }
    counts = Counter(name for _, name in functions)
    assert len(counts) > 200 and not [name for name, count in counts.items() if count > 1]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_names_say_what_they_hold(path):
    tree = tree_of(path)
    vague = {f"{name} (line {line})" for name, line in names(tree) if name in PREPOSITIONS | VAGUE}
    for name, line in all_names(tree):
        if REPLACED.intersection(parts(name)) or name in SHARES:
            vague.add(f"{name} (line {line})")
    assert not vague


def test_a_name_has_the_words_between_underscores_and_capitals():
    assert parts("_OwnBody2Faces") == ["own", "body2", "faces"] and parts("MAX_SITES") == ["max", "sites"]


def test_no_file_has_more_than_500_lines():
    assert not [f"{path}: {count}" for path in FILES if (count := len(path.read_text("utf-8").splitlines())) > 500]


def test_names_of_functions_and_of_members_are_read():
    tree = ast.parse("class A:\n    x: int = 0\n    def f(self): self.y = 1\ndef g(a): b = 2")
    assert {name for name, _ in names(tree)} == {"A", "self", "g", "a", "b"}
    assert {name for name, _ in all_names(tree)} == {"A", "x", "f", "self", "y", "g", "a", "b"}


def test_indices_into_batches_are_called_so():
    texts = [path.read_text("utf-8") for path in FILES]
    indices = [name for text in texts for name in re.findall(r"(\w+) = instance_in\(", text)]
    assert len(indices) > 40 and not [name for name in indices if not name.endswith("_batch")]


def test_only_a_scene_is_called_scene():
    texts = {path: path.read_text("utf-8") for path in FILES}
    assert not [
        path for path, text in texts.items() if re.search(r"^ +scene(, \w+)? = \S*merged_scene(,|$)", text, re.M)
    ]


def test_no_docstring_or_message_has_what_in_place_of_a_noun():
    texts = [(f"{path}:{line}", text) for path, tree in trees() for text, line in docstrings(tree)]
    assert len(texts) > 1000
    nodes = [(path, node) for path, tree in trees() for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    texts += [(f"{path}:{node.lineno}", node.value) for path, node in nodes if isinstance(node.value, str)]
    assert not [f"{place}: {text[:60]}" for place, text in texts if text.startswith(FIRST_WORDS) or WHAT.search(text)]


def test_the_first_line_of_a_docstring_names_its_subject():
    """So that it can be read by itself, in lists of functions: "the same" as which, and "those" of what?"""
    lines = [(path, text.partition("\n")[0], line) for path, tree in trees() for text, line in docstrings(tree)]
    assert not [f"{path}:{line}: {text}" for path, text, line in lines if WITHOUT_SUBJECT.search(text)]


def test_names_of_tests_are_sentences():
    """Of three words or more, that is; the rest is for readers."""
    texts = [path.read_text("utf-8") for path in TESTS]
    tests = [name for text in texts for name in re.findall(r"^def test_(\w+)", text, re.MULTILINE)]
    assert len(tests) > 2000 and not [name for name in tests if name.count("_") < 2]


def test_docstrings_document_arguments_that_are_there():
    """Of functions, kernels and structs, too: an entry under "Args" is an argument of the signature, or a field."""
    unknown, count = [], 0
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and "Args:" in (
                docstring := ast.get_docstring(node) or ""
            ):
                names, count = list(documented_arguments(docstring)), count + 1
                assert names, f"{path}:{node.lineno}"
                unknown += [f"{path}:{node.lineno} {node.name}: {name}" for name in set(names) - arguments(node)]
    assert count > 450 and not unknown
