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

BANNED = {
    # bare verbs, adverbs and prepositions: they do not say what a variable holds
    *("across", "along", "among", "apart", "around", "asked", "beside", "between", "beyond", "each", "found", "given"),
    *("along_normals", "among_senders", "kept", "sent"),
    *("least", "meant", "most", "past", "said", "taken", "told", "wanted"),
    *("agreed", "ahead", "amount", "answered", "arm", "aside", "at_corner", "at_once", "at_origin", "bend"),
    *("blurred", "brought", "climbs", "closest", "compared", "computed", "consumed", "cropped", "dark", "decline"),
    *("descended", "developed", "dilates", "doubled", "doubtful", "dragged", "early", "edge_found", "ended"),
    *("enters", "escaping", "evaluated", "faded", "failed", "farther", "fewer", "following", "forced", "gained"),
    *("held", "here", "inside", "is_met", "lack", "large", "later", "lean", "leaning", "leanings", "learned", "less"),
    *("lies_on", "loaded", "look", "measured", "meets", "more", "nearer", "opened", "padded", "painted", "parsed"),
    *("pending", "picked", "plus", "previewed", "ranked", "reaches", "reaching", "refused", "rendered", "repeated"),
    *("resumed", "rolled", "same", "saved", "sense", "shadowed", "shifted", "sized", "slab", "solved", "spanned"),
    *("spun", "standing", "started", "stopping", "summed", "surrounding", "takes_part", "tested", "there", "timed"),
    *("toward", "tried", "turning", "untimed", "untried", "viewed", "want", "warned", "way", "worst", "worth"),
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
    *("add_to_corners", "add_to_vertices", "adj_turned", "adj_unblocked", "at_point", "at_uv", "Covers", "depth_of"),
    *("Descended", "edge_at", "edge_between", "edge_of", "find_blocker", "find_in_plane", "find_turned", "hit_sides"),
    *("image_of", "light_cells", "load_place", "looks_at_rays", "loudness", "make_look_up", "mean_light"),
    *("merge_where_far", "number_places", "numbers_of", "of_rays", "on_host", "over_nothing", "own_count"),
    *("own_shares", "own_sides", "place_receiver", "place_weights", "PlaneCover", "points_seen", "radiosity_before"),
    *("ReceiverInPlane", "scaled_to_sky", "see_samples", "SeenSurface", "trace_factors", "transmittance_towards"),
    *("turn_from_planes", "unblocked_batch", "with_rows", "with_tail", "without_owners"),
    *("find_openness", "HIT_ROWS", "load_hit", "node_centers", "open_shares", "open_weights", "Openness", "SIDE_ROWS"),
    *("BeamAdjoint", "NearestBorder", "on_static", "towards"),
    *("placed_blockers", "ShellLight"),
    *("contact_density", "FLAT", "Fronts", "Rays", "TOLERANCES", "touching_points"),
    *("BLEND_START", "BodyExtents", "GLOSS_METHODS", "positions_cycle"),
}
BANNED_EVERYWHERE = {
    *("bulging", "decide", "emitter_projection", "free_projection", "free_projection_of", "has_proxies", "in_words"),
    *("is_before_planes", "joins_cached", "last_light", "last_shell", "lights_samples", "news", "one_transfer"),
    *("project_free_light", "sharp_share", "solid_bodies", "total_light", "_blocked", "_blurred", "_exits"),
    *(
        "apply_geometry",
        "lifted_points_and_fronts",
        "shaded_points",
        "_LightAndCells",
        "_static_shadows",
        "_visibility_of",
    ),
    *("_find_numbers", "_lobe_cells", "_projected_from_scene", "_projected_if_given", "_REUSED", "_Same", "_shining"),
    *("_touching_points", "_towards", "_warn_of_nothing"),
    *("LitPoints", "lit_points"),
    *("OwnBody", "own_coverage", "own_parts"),
    *("announced", "one_at_a_time", "takes", "uncompiled"),
    *("_CORE", "_EDGE", "_HIDDEN", "_OWN_REACH", "_SUNK", "MANY", "TOUCH"),
    *("light_of_visibility", "shades_transmittance", "widens_edges"),
    *("NodeStage",),
    *("ShellPatches", "shell_patches"),
    *("PortionedDirectLight", "PortionedShading", "PortionedTransfer", "PortionedVisibility"),
    *("_ById", "_see_by", "DirectLightOfPortion", "lobe_sum", "projected_patches", "ProjectedPatches"),
    *("shows_gloss", "total_grazing", "VisibilityOfPortion", "where_edges_are"),
    *("Bouncing", "casting_mesh", "CatchersAlone", "find_mean_slopes", "for_picture", "Gathering", "hold_fragments"),
    *("NearLight", "own_shell", "own_tape", "share", "shares", "wants_samples"),
}
"""Replaced names of methods and fields, too, which were not to be understood even with their object's name."""
BANNED_PARTS = {"asked", "kept", "meant", "most", "pull", "pulled", "said", "taken", "told", "wanted"}
"""Words that no name has among its parts. A preposition may be one, as in ``planes_around``, where an object follows it
or it follows one."""

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
def test_a_module_uses_no_banned_name(path):
    tree = tree_of(path)
    banned = {f"{name} (line {line})" for name, line in names(tree) if name in BANNED}
    for name, line in all_names(tree):
        if name in BANNED_EVERYWHERE or BANNED_PARTS.intersection(name.lower().split("_")):
            banned.add(f"{name} (line {line})")
    assert not banned


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
