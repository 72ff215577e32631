"""Pages are true: links lead somewhere, names exist, commands start, and snippets run as they stand."""

import ast
import dataclasses
import importlib
import itertools
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow.cli import app
from warpshadow.dataset import Recipe, load_recipe
from warpshadow.inverse.fit_file import load_fit
from warpshadow.maths.directions import fibonacci
from warpshadow.maths.suns import _MAX_SUNS
from warpshadow.pipeline.views import scene_views
from warpshadow.scene import blockers
from warpshadow.scene.visibility import DIRECTIONS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
FOLDERS = ("demos", "tests", "warpshadow")
PAGES = [*sorted(ROOT.glob("*.md")), *(page for folder in FOLDERS for page in sorted((ROOT / folder).rglob("*.md")))]
FILES = [str(path.relative_to(ROOT)) for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")]
MAKEFILE = (ROOT / "Makefile").read_text("utf-8")


def name_of(page):
    return str(page.relative_to(ROOT))


each_page = pytest.mark.parametrize("page", PAGES, ids=name_of)
each_page_of_today = pytest.mark.parametrize("page", [p for p in PAGES if p.name != "CHANGELOG.md"], ids=name_of)


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


def prose(page):
    return re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def code(page):
    """What a page has between backticks, and its commands: a line each, and those that go on farther to the right."""
    spans = re.findall(r"`([^`]+)`", prose(page))
    indented = re.findall(r"^    (\S.*(?:\n {8}\S.*)*)$", prose(page), re.MULTILINE)
    return [*spans, *indented, *"".join(blocks(page, "sh")).splitlines()]


def links(page):
    return re.findall(r"\]\(([^)\s]+)\)", prose(page))


def anchors(page):
    """What GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


# ------------------------------------------------------------------------------------------------ what pages name


@each_page
def test_links_lead_to_files_and_headings(page):
    for link in links(page):
        if not re.match(r"https?:", link):
            path, _, anchor = link.partition("#")
            target = page.parent / path if path else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_every_page_is_found_from_the_first():
    found, left = set(), [ROOT / "README.md"]
    while left:
        page = left.pop()
        found.add(page)
        targets = {(page.parent / link.partition("#")[0]).resolve() for link in links(page) if link[0] != "#"}
        left += [target for target in targets if target.suffix == ".md" and target not in found]
    assert set(PAGES) == found


def test_the_first_page_takes_a_few_minutes_to_read():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150


@each_page_of_today
def test_files_that_a_page_names_exist(page):
    """By their ends; what users write or get, such as scene.toml, is not looked for."""
    for text in code(page):
        for name in re.findall(r"[\w./]+\.(?:py|json)\b", text):
            assert name == "transforms.json" or any(f"/{file}".endswith(f"/{name}") for file in FILES), name


STAGES = ROOT / "warpshadow" / "stages"


@pytest.mark.parametrize(
    ("folder", "files"),
    [
        (STAGES, sorted(STAGES.rglob("*.py"))),
        (ROOT / "tests", sorted((ROOT / "tests").glob("test_*.py"))),
        (ROOT / "demos", sorted((ROOT / "demos").rglob("*.py"))),
    ],
    ids=["stages", "tests", "demos"],
)
def test_every_file_of_a_folder_stands_on_its_page(folder, files):
    page = (folder / "README.md").read_text("utf-8")
    assert not [name_of(file) for file in files if file.stem != "__init__" and f"`{file.name}`" not in page]


def has_adjoint_by_hand(text):
    """Whether a file of stages has a kernel that is an adjoint, a gradient of a function, or puts one on the tape."""
    for node in ast.walk(ast.parse(text)):
        for decorator in map(ast.unparse, getattr(node, "decorator_list", ())):
            if decorator.startswith("wp.func_grad") or (decorator.startswith("wp.kernel") and "adjoint" in node.name):
                return True
    return bool(re.search(r"\b(launch_with_adjoint|differentiable|record_adjoint)\(", text))


def test_every_adjoint_by_hand_stands_on_the_page_of_stages_with_its_reason_and_folder():
    page = (STAGES / "README.md").read_text("utf-8")
    (table,) = re.findall(r"^\| why \|.*\n(?:\|.*\n)+", page, re.MULTILINE)
    named = set(re.findall(r"`([\w/]+(?:\.py|/))`", table))
    assert not [name for name in named if not (STAGES / name).exists()]
    texts = {file.relative_to(STAGES).as_posix(): file.read_text("utf-8") for file in STAGES.rglob("*.py")}
    by_hand = {name for name, text in texts.items() if has_adjoint_by_hand(text)}
    assert len(by_hand) > 20
    assert not [name for name in by_hand if name not in named and f"{name.partition('/')[0]}/" not in named]
    assert not [name for name in named if name in texts and "adjoint" not in texts[name]]
    shared = {name for name, text in texts.items() if re.search(r"@wp\.func.*\n *def \w*adjoint", text)} - by_hand
    (list_of_shared,) = re.findall(r"^Functions that these.*(?:\n.+)+", page, re.MULTILINE)
    named |= set(re.findall(r"`([\w/]+\.py)`", list_of_shared))
    assert len(shared) > 5 and not [name for name in shared - named if f"{name.partition('/')[0]}/" not in named]


def test_every_room_of_the_pipeline_stands_on_its_page_with_classes_that_it_has():
    pipeline = ROOT / "warpshadow" / "pipeline"
    (table,) = re.findall(r"^\| room \|.*\n(?:\|.*\n)+", (pipeline / "README.md").read_text("utf-8"), re.MULTILINE)
    rooms = {path.name + "/" * path.is_dir() for path in pipeline.iterdir() if not path.name.startswith("__")}
    assert not [room for room in rooms - {"README.md"} if f"`{room}`" not in table]
    for row in table.splitlines()[2:]:
        room, *_, classes = [cell.strip(" `") for cell in row.strip("|").split("|")]
        places = [f"/pipeline/{name}" for name in re.findall(r"[\w.]+/?", room)]
        source = "".join(text for file, text in SOURCES.items() if any(place in file.as_posix() for place in places))
        assert not [name for name in re.findall(r"`([A-Z]\w+)`", f"`{classes}`") if f"class {name}" not in source], room


def test_the_page_of_tests_has_the_folders_shared_files_fixtures_and_tolerances_that_there_are():
    tests, text = ROOT / "tests", (ROOT / "tests" / "README.md").read_text("utf-8")
    folders = [path for path in tests.rglob("*") if path.is_dir() and list(path.glob("test_*.py"))]
    assert not [
        path
        for path in folders
        if not list(ROOT.glob(f"{path.relative_to(tests)}/*.py"))
        and not list((ROOT / "warpshadow").glob(f"{path.relative_to(tests)}/*.py"))
    ]
    assert not [path.name for path in tests.glob("*.py") if f"| `{path.name}`" not in text and path.stem[:5] != "test_"]
    names = [path.name for path in tests.rglob("test_*.py")]
    assert len(names) == len(set(names))
    fixtures = re.findall(
        r"^@pytest.fixture(?!.*autouse).*\ndef (\w+)", (tests / "conftest.py").read_text(), re.MULTILINE
    )
    assert len(fixtures) > 5 and not [name for name in fixtures if f"`{name}`" not in text]
    tolerances = re.findall(r"^    ([A-Z0-9_]+ = .*)$", text, re.MULTILINE)
    assert tolerances and not [
        line for line in tolerances if not any(line in file.read_text("utf-8") for file in tests.rglob("test_*.py"))
    ]


CACHING = ("cached", "_cached", "cached_for_bodies", "cached_for_light")  # methods that take the node's name first


def test_every_cached_node_stands_on_the_page_that_says_when_it_is_made_anew():
    pipeline = ROOT / "warpshadow" / "pipeline"
    text, names = (pipeline / "views" / "README.md").read_text("utf-8"), set()
    for path in pipeline.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "attr", "") in CACHING:
                literals = [part for part in ast.walk(call.args[0]) if isinstance(part, ast.Constant)]
                names |= {literals[0].value.strip()} if literals else set()
    assert len(names) > 20
    assert not [name for name in names if f"`{name}`" not in text and f"`{name} …`" not in text]


@each_page_of_today
def test_names_of_the_package_exist(page):
    for text in [*code(page), *blocks(page, "python")]:
        for name in re.findall(r"\bws\.(\w+)", text):
            assert hasattr(ws, name), name
        for path in re.findall(r"\bwarpshadow(?:\.\w+)+", text):
            if not path.endswith((".py", ".toml")):
                assert resolved(path), path


def resolved(path):
    """Whether a dotted path leads to a module or what is in it."""
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(value, part):
                return False
            value = getattr(value, part)
        return True
    return False


SOURCES = {file: file.read_text("utf-8") for file in sorted((ROOT / "warpshadow").rglob("*.py"))}
MODULES = {name for file in SOURCES for name in (file.stem, file.parent.name)}
DEFINED = MODULES | {
    getattr(node, key)
    for text in SOURCES.values()
    for node in ast.walk(ast.parse(text))
    for key in ("name", "id", "attr", "arg")
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.arg) or isinstance(getattr(node, "ctx", None), ast.Store)
    if hasattr(node, key)
}
CLASSES = {
    node.name: node for text in SOURCES.values() for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)
}
ROLES = re.compile(r":(func|class|meth|data|mod|attr):`~?([\w.]+)`")


def is_stored(node):
    return isinstance(node.ctx, ast.Store)


def members(name):
    """Methods, fields and attributes of a class of the package, inherited ones included; none of others."""
    if name not in CLASSES:
        return set()
    found = {node.name for node in CLASSES[name].body if isinstance(node, ast.FunctionDef)}
    fields = [node for node in CLASSES[name].body if isinstance(node, ast.Assign | ast.AnnAssign)]
    found |= {part.attr for part in ast.walk(CLASSES[name]) if isinstance(part, ast.Attribute) and is_stored(part)}
    found |= {part.id for field in fields for part in ast.walk(field) if isinstance(part, ast.Name) and is_stored(part)}
    bases = [base.value if isinstance(base, ast.Subscript) else base for base in CLASSES[name].bases]
    return found.union(*(members(getattr(base, "id", None) or getattr(base, "attr", "")) for base in bases))


def test_members_are_those_of_the_class():
    assert {"white_samples", "image", "cached"} <= members("View") and "white" not in members("View")


def unknown_members(parts):
    """Names after that of a class which it does not have."""
    return [name for owner, name in itertools.pairwise(parts) if owner in CLASSES and name not in members(owner)]


@pytest.mark.parametrize("file", SOURCES, ids=name_of)
def test_names_that_docstrings_refer_to_exist(file):
    for role, path in ROLES.findall(SOURCES[file]):
        if path.startswith("warpshadow."):
            assert resolved(path), path
            assert (path in sys.modules) == (role == "mod"), path
        else:
            parts = path.strip(".").split(".")
            assert DEFINED.issuperset(parts) and not unknown_members(parts), path
            if role == "mod":
                assert MODULES.issuperset(parts), path


@each_page_of_today
def test_methods_and_constants_that_a_page_names_exist(page):
    texts = code(page)
    for owner, name in (match.groups() for text in texts if (match := re.match(r"([A-Z]\w*)\.(\w+)(?:$|\()", text))):
        assert not unknown_members((owner, name)), f"{owner}.{name}"
    for name in (text for text in texts if re.fullmatch(r"(?!WARP_|MALLOC_|G?OMP_)_?[A-Z]+(?:_[A-Z]+)+", text)):
        assert any(name in text for text in SOURCES.values()), name


# ------------------------------------------------------------------------------------------------ figures


MEASUREMENTS = (ROOT / "demos" / "benchmarks" / "README.md").read_text("utf-8")


def table_rows(heading):
    """Cells of the tables below a heading of the page of measurements, by row; a mark of boldness is left out."""
    text = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", MEASUREMENTS, re.DOTALL | re.MULTILINE)[1]
    return [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]


def numbers(cells):
    return [float(re.match(r"[\d.]+", cell)[0]) for cell in cells]


def row_of(heading, label):
    return next(numbers(row[1:]) for row in table_rows(heading) if row[0] == label)


def summaries(heading, label_count):
    """The rows of means and worst values of a table of errors, which are those of its columns."""
    rows = [row for row in table_rows(heading)[2:] if re.match(r"[\d.]+%?$", row[label_count])]
    *rows, means, worst = [numbers(cell for cell in row[label_count:] if re.match(r"[\d.]+%?$", cell)) for row in rows]
    for column, mean, highest in zip(zip(*rows, strict=True), means, worst, strict=True):
        assert mean == pytest.approx(sum(column) / len(column), abs=0.051) and highest == max(column)
    return len(rows), means, worst


def test_figures_of_the_first_page_are_those_that_were_measured():
    stated = re.sub(r"\]\([^)]*\)|[\[*]", "", (ROOT / "README.md").read_text("utf-8")).replace("\n ", "")
    count, means, worst = summaries("Accuracy", 2)
    assert count == 9 and f"off by {means[4]}% on average, {worst[4]}% at worst, on nine meshes" in stated
    assert f"without shadows by {means[0]}% and {worst[0]}%" in stated
    count, means, worst = summaries("Scenes of all kinds", 1)
    assert f"on {count} scenes, by {means[0]}% and {worst[0]}%" in stated
    stills = (ROOT / "warpshadow" / "pipeline" / "README.md").read_text("utf-8")
    assert f"[off by {means[0]}%]" in stills and f"on average, renderers' images by {means[2]}%" in stills
    bunny, ball = (row_of("Set-up", mesh) for mesh in ("bunny", "ball"))
    assert f"{bunny[4]:.0f} s for {bunny[0]:.0f},000 vertices, {ball[4]:.0f} s for {ball[0]:.0f},000" in stated
    loops = re.search(r"\| body \| diffuse \| metal .*?\n\n", MEASUREMENTS, re.DOTALL)[0].splitlines()[2:]
    factors = [float(factor) for row in loops for factor in re.findall("([0-9.]+) ×", "|".join(row.split("|")[3:5]))]
    assert f"in {min(factors)} to {max(factors)} times the time" in stated
    image, light, texture, pose = (
        row_of("Speed", label)[1]
        for label in (
            "an image of bodies that have moved, `directional`",
            "an iteration in torch, forward and backward: light",
            "… a texture of 256 × 256",
            "… a pose",
        )
    )
    assert f"moved bodies takes {image:.0f} ms, an iteration of a light or texture fit {texture:.0f} ms" in stated
    assert f"of a pose {pose:.0f} ms" in stated and light == pytest.approx(texture, rel=0.2)
    factors = [
        [float(factor) for row in table_rows("Error against time") for factor in re.findall(cell, "|".join(row))]
        for cell in (r"\|(\d+) times(?: as long)?\|", r"\|(\d+) times(?: as long|; .*)?$")
    ]
    (low, high), (low_bounces, high_bounces) = ((min(each), max(each)) for each in factors)
    assert f"{low:.0f} to {high:.0f} times as long, with bounces {low_bounces:.0f} to {high_bounces:.0f}" in stated
    _, small, _, large = row_of("Gradients", "by pose, 2 × 2 samples per pixel (default): `directional`")
    assert table_rows("Gradients")[0][1:] == ["32²", "64²", "128²", "256²"]
    assert f"within {large}% of differences under a sun in images of 256², {small}% in 64²" in stated


def test_pages_say_how_many_suns_are_reflected_one_by_one():
    number = ("four", "five", "six", "seven", "eight")[_MAX_SUNS - 4]
    texts = [page.read_text("utf-8") for page in PAGES if page.name != "CHANGELOG.md"]
    stated = [word for text in texts for word in re.findall(r"[uU]p to (\w+) (?:suns|of 6°)", text)]
    assert len(stated) == 4 and set(stated) == {number}


# ------------------------------------------------------------------------------------------------ commands


def test_extras_that_are_to_be_installed_exist_and_all_of_them_are_one():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    everyones = set(extras) - {"all", "dev"}
    assert set(re.search(r"\[(.*)\]", extras["all"][0])[1].split(",")) == everyones
    texts = [path.read_text("utf-8") for path in (*PAGES, *(ROOT / "warpshadow").rglob("*.py"))]
    named = [match for text in texts for match in re.findall(r"pip install \"(?:warpshadow|\.)\[([\w,]+)\]", text)]
    named += [match for text in texts for match in re.findall(r"missing\(.*\"(\w+)\"\)", text)]
    assert len(named) > 5 and {extra for names in named for extra in names.split(",")} <= set(extras)


@each_page_of_today
def test_commands_and_their_options_exist(page):
    for text in code(page):
        for target in re.findall(r"^make (?!PYTHON)([a-z-]+)", text):
            assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), text
        if match := re.match(r"(?:warpshadow) ([a-z]+)\b", text):
            assert_options(text, warpshadow_help(match[1]))
        if match := re.search(r"(demos/\w+/\w+\.py)", text):
            assert_options(text, (ROOT / match[1]).read_text("utf-8"))


def warpshadow_help(command):
    result = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"})
    assert result.exit_code == 0, command
    return result.output


def assert_options(text, accepted):
    for option in re.findall(r"(?<!\S)\[?(--[a-z-]+)", text.partition("#")[0]):
        assert option in ("--help", "--nproc_per_node") or option in accepted, text


# ------------------------------------------------------------------------------------------------ snippets


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files that snippets read."""
    monkeypatch.chdir(tmp_path)
    ws.icosphere(0.6, 3).write("bunny.obj")
    ws.synthetic_sky(height=32).write("sky.exr")
    pixels = np.full((64, 64, 3), 0.5, np.float32)
    ws.write_image("photo.png", pixels)
    ws.write_image("mask.png", pixels)
    return tmp_path


def scene_file():
    """The one with all keys."""
    return blocks(ROOT / "warpshadow" / "scene" / "README.md", "toml")[1]


def test_the_scene_file_is_one(folder):
    short, scene, inserted = blocks(ROOT / "warpshadow" / "scene" / "README.md", "toml")
    (path,) = blocks(ROOT / "warpshadow" / "cli" / "README.md", "toml")
    (automatic,) = blocks(ROOT / "warpshadow" / "tuning" / "README.md", "toml")
    Path("short.toml").write_text(short, "utf-8")
    assert [body.casts_shadow for body in ws.load_scene("short.toml").bodies] == [True, True]
    Path("scene.toml").write_text(scene, "utf-8")
    Path("path.toml").write_text(path, "utf-8")
    Path("inserted.toml").write_text(inserted, "utf-8")
    assert ws.CameraPath.read("path.toml").frame_count == 73
    assert ws.load_scene("inserted.toml").catchers == (1,)
    loaded = ws.load_scene("scene.toml")
    assert len(loaded.bodies) == 2
    plain = ws.Visibility("directional")  # as it says, all are defaults, or the number that None means
    numbers = {"samples": plain.ray_count, "directions": DIRECTIONS}
    assert dataclasses.asdict(loaded.visibility) == dataclasses.asdict(plain) | numbers
    assert ws.Visibility(**tomllib.loads(automatic)["visibility"]).method == "auto"


def test_the_fit_files_are_some(folder):
    Path("scene.toml").write_text(scene_file(), "utf-8")
    fit, stages = blocks(ROOT / "warpshadow" / "inverse" / "README.md", "toml")
    for text in (fit, re.sub(r"^stages = .*\n", "", fit, flags=re.MULTILINE) + stages):
        Path("fit.toml").write_text(text, "utf-8")
        assert load_fit("fit.toml").problem.free


def test_the_recipe_is_one(folder):
    """Of the defaults, but for its folders and splits."""
    (recipe,) = blocks(ROOT / "warpshadow" / "dataset" / "README.md", "toml")
    Path("recipe.toml").write_text(recipe, "utf-8")
    for name in ("meshes", "maps"):
        Path(name).mkdir()
    loaded = load_recipe("recipe.toml")
    assert set(loaded.splits) == {"train", "val", "test"} and loaded.meshes and loaded.maps
    plain = Recipe(2000)
    for name in ("seed", "shard", "layers", "blockers", "size", "ranges", "supersampling", "bounces"):
        assert getattr(loaded, name) == getattr(plain, name), name


def test_the_stage_that_a_page_adds_has_an_adjoint(tmp_path, monkeypatch):
    """It is linear, so the adjoint is its transpose: ⟨w, darken(x)⟩ = ⟨adjoint(w), x⟩."""
    (snippet,) = blocks(ROOT / "warpshadow" / "README.md", "python")
    (tmp_path / "vignette.py").write_text(snippet, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    x, w = np.random.default_rng(0).random((2, 2, 5, 7, 4)).astype(np.float32)
    image = wp.array(x, dtype=wp.vec4, requires_grad=True, device="cpu")
    with wp.Tape() as tape:
        darkened = importlib.import_module("vignette").darken_corners(image, 0.6)
    tape.backward(grads={darkened: wp.array(w, dtype=wp.vec4, device="cpu")})
    assert np.array_equal(darkened.numpy()[..., 3], x[..., 3])
    assert (darkened.numpy()[:, 0, 0, :3] < 0.6 * x[:, 0, 0, :3]).all()
    assert np.vdot(w, darkened.numpy()) == pytest.approx(np.vdot(image.grad.numpy(), x), rel=1e-6)


def test_the_node_that_a_page_adds_is_one_of_the_image(tmp_path, monkeypatch):
    """Pasted where the page says; then explain lists it, and the corners are darker."""
    page = (ROOT / "warpshadow" / "README.md").read_text("utf-8")
    (snippet,) = blocks(ROOT / "warpshadow" / "README.md", "python")
    (lines,) = re.findall(r"^    (averaged = .*\n    return .*)$", page, re.MULTILINE)
    replaced = "return" + lines.partition("\n")[0].removeprefix("averaged =")
    source = (ROOT / "warpshadow" / "pipeline" / "views" / "view.py").read_text("utf-8")
    assert source.count(replaced) == 1
    (tmp_path / "vignette.py").write_text(snippet, "utf-8")
    pasted = source.replace(replaced, lines.replace("\n", "\n    "))
    (tmp_path / "darker_view.py").write_text("from vignette import darken_corners\n" + pasted, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    camera = ws.Camera.look_at((0, 2, 0.1), (0, 0, 0), size=(8, 8))
    scene = ws.Scene([ws.Body(ws.plane(9.0, 4), receivers="pixel")], ws.EnvironmentMap.constant(), camera)
    plain = ws.render(scene)
    monkeypatch.setattr(scene_views, "View", importlib.import_module("darker_view").View)
    renderer = ws.Renderer(scene)
    assert renderer.explain()["vignette"]
    darkened = renderer.render()
    assert (darkened[0, 0, :3] < 0.8 * plain[0, 0, :3]).all()
    assert np.allclose(darkened[4, 4], plain[4, 4], rtol=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_snippets_run_as_they_stand(folder, monkeypatch, capsys):
    """Those of the first page, and then of the others with its scene: but the spheres are known, not fitted, and images
    have a sixteenth of the pixels; the loop compares one 76 times in place of 151.
    """
    balls = ws.Spheres(0.5 * fibonacci(64), np.full(64, 0.1))
    monkeypatch.setattr(blockers, "fit_spheres", lambda *_, **__: SimpleNamespace(spheres=balls))
    framing = ws.Camera.framing
    monkeypatch.setattr(ws.Camera, "framing", lambda *shown, **given: framing(*shown, **{"size": (64, 64)} | given))
    names = {}

    def run(page):
        for snippet in blocks(page, "python"):
            for written, smaller in (("size=(256, 256)", "size=(64, 64)"), ("151", "76"), ("150", "75")):
                snippet = snippet.replace(written, smaller)
            exec(snippet, names)

    run(ROOT / "README.md")
    image = ws.read_image("out.exr")
    assert image[..., :3].max() > 0.1
    said = re.findall(r"shifted by (.*), light (.*)% off", capsys.readouterr().out)
    (_, light_before), (shift, light) = [tuple(map(float, each)) for each in said]
    assert shift < 0.06 and light < 50 < light_before  # a ball, whose turn nobody sees, and its light
    assert Path("iteration_0.jpg").exists() and Path("iteration_75.jpg").exists()
    recovered = ws.render(ws.load_scene(Path("recovered", "scene.toml")))
    assert np.abs(recovered - image).mean() < 0.1 * image.mean()
    ws.write_image("photo.exr", image)
    for page in ("assets", "cli", "scene", "torch", "pipeline", "inverse"):
        run(ROOT / "warpshadow" / page / "README.md")
    assert "receivers" in capsys.readouterr().out  # what explain says
    assert Path("layers.exr").exists() and Path("explained.exr").exists()
    assert Path("found", "scene.toml").exists()
