"""Names and docstrings: one word, one meaning."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "warpshadow"
FILES = sorted(PACKAGE.rglob("*.py"))

BANNED = {
    # bare verbs, adverbs and prepositions: they do not say what a variable holds
    *("across", "along", "among", "apart", "around", "asked", "beside", "beyond", "each", "found", "given", "kept"),
    *("least", "meant", "most", "past", "said", "taken", "told", "wanted"),
    # words that the glossary has replaced: see "Glossary" in warpshadow/README.md
    *("assembly", "exitance", "flats", "lenders", "narrow", "own_light", "own_shadows", "past_all", "past_own"),
    *("past_solid", "seat", "sites", "stand_ins", "stands", "walk"),
    *("across_way", "colors_so_far", "falloff_pull", "first_site", "front_presence", "is_prepared"),
    *("narrow_past_planes", "open_sites", "own_bounces", "KEPT_METHOD", "OWN_BOUNCES"),
    *("Blocking", "InParts", "LitParts", "PartsOfGroup", "PlanesOfGroup", "Reflection", "SceneParts"),
    *("presence", "receiver_words", "solid_bodies", "READ_BY", "MEANT", "GLOSSY", "BOUNCING"),
    *("Assembly", "Flats", "Narrow", "Own", "Seen", "StandIns"),
    *("DirectLightPart", "PartVisibility", "PartwiseShading", "PART_SIZE", "rooms", "with_self_light"),
    *("find_spot", "pull", "pulled", "pulls", "spot", "spot_place", "TexelFootprint", "torque", "truth"),
}
FIRST_WORDS = ("What ", "Those ", "That which ", "Whatever ")


def trees() -> Iterator[tuple[str, ast.Module]]:
    for path in FILES:
        yield str(path.relative_to(PACKAGE)), ast.parse(path.read_text("utf-8"))


def names(node: ast.AST) -> Iterator[tuple[str, int]]:
    """Names of classes, arguments and variables; methods and fields are read after a dot, with their object's name."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield child.name, child.lineno
        elif isinstance(child, ast.arg):
            yield child.arg, child.lineno
        elif isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
            yield child.id, child.lineno
        is_field = isinstance(node, ast.ClassDef) and isinstance(child, ast.Assign | ast.AnnAssign)
        if not is_field:
            yield from names(child)


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Docstrings of modules, classes and functions, and the strings below constants and fields."""
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            value = child.value if isinstance(child, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value.strip(), child.lineno


def test_no_two_classes_have_one_name():
    counts = Counter(node.name for _, tree in trees() for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert len(counts) > 200 and not [name for name, count in counts.items() if count > 1]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_uses_no_banned_name(path):
    banned = {f"{name} (line {line})" for name, line in names(ast.parse(path.read_text("utf-8"))) if name in BANNED}
    assert not banned


def test_no_docstring_begins_with_what():
    texts = [(f"{path}:{line}", text) for path, tree in trees() for text, line in docstrings(tree)]
    assert len(texts) > 1000
    assert not [f"{place}: {text[:60]}" for place, text in texts if text.startswith(FIRST_WORDS)]
