"""Data sets: recipes, splits, and what a sample has."""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws
from warpshadow.assets.image import exr_channels
from warpshadow.dataset import DataSet, Recipe, RecipeError, Sample, load_recipe
from warpshadow.dataset import data_set as data_sets
from warpshadow.dataset.samples import render_sample
from warpshadow.scene.random_scenes import Ranges

PLAIN = ws.Visibility("none")  # fits no spheres
ALL_LAYERS = ("color", "shadow", "depth", "normals", "bodies", "masks", "light")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Ten meshes and ten maps, which are small and differ."""
    folder = tmp_path_factory.mktemp("stock")
    for name in ("meshes/more", "maps"):
        (folder / name).mkdir(parents=True)
    for k in range(10):
        mesh = ws.icosphere(0.5, 1)
        mesh.transformed(scale=(1, 1 + 0.1 * k, 1)).write(folder / ("meshes/more" if k % 2 else "meshes") / f"{k}.obj")
        ws.EnvironmentMap.constant((1.0, 1.0 + k, 0.5), 8).write(folder / "maps" / f"{k}.exr")
    return folder


@pytest.fixture
def recipe(folder):
    return Recipe(
        20, seed=1, splits={"train": 0.5, "val": 0.3, "test": 0.2}, meshes=folder / "meshes", maps=folder / "maps",
        size=(16, 16), layers=ALL_LAYERS, visibility=PLAIN, supersampling=1,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------ splits


def test_no_mesh_and_no_map_is_in_two_splits_and_each_is_in_one(recipe):
    stocks = DataSet(recipe).stocks
    for kind in ("meshes", "maps"):
        named = [getattr(stock, kind) for stock in stocks.values()]
        names = [name for each in named for name in each]
        assert len(names) == len(set(names)) == 10
        assert all(named)
    assert "more/1.obj" in [name for stock in stocks.values() for name in stock.meshes]


def test_a_mesh_with_another_texture_is_another(recipe, tmp_path):
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"
    (tmp_path / "square.obj").write_text("mtllib square.mtl\nusemtl paint\n" + square)
    (tmp_path / "square.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    hashes = []
    for color in ("red", "blue"):
        Image.new("RGB", (4, 4), color).save(tmp_path / "paint.png")
        hashes.append(DataSet(replace(recipe, meshes=tmp_path, splits={"train": 1.0})).hashes["meshes"]["square.obj"])
    assert hashes[0] != hashes[1]


def test_scenes_have_the_meshes_and_maps_of_their_split(recipe):
    data_set = DataSet(recipe)
    assert [len(data_set.numbers(split)) for split in recipe.splits] == [10, 6, 4]
    for number in range(len(data_set)):
        about = json.loads(render_sample(data_set, number)["json"])
        stock = data_set.stocks[data_set.split_of(number)]
        assert about["split"] == data_set.split_of(number)
        assert {body["mesh"] for body in about["bodies"]} - {"ground"} <= set(stock.meshes)
        assert about["light"]["map"] in stock.maps


def test_a_file_that_is_added_moves_no_others_and_a_copy_is_in_the_same_split(recipe, tmp_path):
    before = DataSet(recipe).stocks
    copies = tmp_path / "meshes"
    copies.mkdir()
    for path in recipe.meshes.rglob("*.obj"):
        (copies / path.name).write_bytes(path.read_bytes())
        (copies / f"copy of {path.name}").write_bytes(path.read_bytes())
    ws.icosphere(0.3, 1).write(copies / "new.obj")
    after = DataSet(replace(recipe, meshes=copies)).stocks
    for split, stock in before.items():
        names = {name.rpartition("/")[2] for name in stock.meshes}
        found = set(after[split].meshes) - {"new.obj"}
        assert found == names | {f"copy of {name}" for name in names}


def test_another_seed_makes_other_splits(recipe):
    assert DataSet(recipe).stocks != DataSet(replace(recipe, seed=7, splits={"train": 0.5, "test": 0.5})).stocks


def test_a_split_without_meshes_is_refused(recipe, tmp_path):
    ws.icosphere(0.5, 1).write(tmp_path / "only.obj")
    with pytest.raises(RecipeError, match=r"\[splits\]: \w+ got none of the 1 meshes \(train \d, val \d, test \d\)"):
        DataSet(replace(recipe, meshes=tmp_path))


def test_broken_files_are_all_named_at_the_start(recipe, tmp_path):
    ws.icosphere(0.5, 1).write(tmp_path / "good.obj")
    (tmp_path / "broken.obj").write_text("f 1 2 3")
    (tmp_path / "empty.ply").write_text("")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(RecipeError) as error:
        DataSet(replace(recipe, meshes=tmp_path))
    assert str(error.value).startswith("meshes: got 3 of 4 that cannot be used:\n")
    assert all(name in str(error.value) for name in ("broken.obj: ", "empty.ply: ", "nan.obj: "))
    assert "good.obj" not in str(error.value)
    (tmp_path / "negative.exr").write_bytes(b"no")
    with pytest.raises(RecipeError, match=r"maps: got 1 of 1 that cannot be used:\n.*negative.exr"):
        DataSet(replace(recipe, maps=tmp_path))
    with pytest.raises(RecipeError, match="maps: got the folder .* without any, expected files .exr"):
        DataSet(replace(recipe, maps=recipe.meshes))


# ------------------------------------------------------------------------------------------------ samples


def test_a_sample_is_the_scene_s_image_and_layers(recipe):
    data_set = DataSet(recipe)
    files = render_sample(data_set, 3)
    channels, about = exr_channels(files["exr"]), json.loads(files["json"])
    scene = data_set.draw(3).scene
    renderer = ws.Renderer(scene)
    np.testing.assert_array_equal(np.stack([channels[name] for name in "RGBA"], axis=-1), renderer.render())
    for name, values in renderer.layers().channels().items():
        np.testing.assert_array_equal(channels[name], values)
    assert [name for name in channels if name.startswith("mask")] == [f"mask.{k}" for k in range(4)]
    assert [channels[f"mask.{k}"].any() for k in range(len(scene.bodies), 4)] == [False] * (4 - len(scene.bodies))
    np.testing.assert_array_equal(np.float32(about["light"]["sh"]), scene.light.sh(4))
    again = ws.EnvironmentMap.read(recipe.maps / about["light"]["map"])
    again = again.rotated(about["light"]["rotation"]).scaled(about["light"]["scale"])
    np.testing.assert_array_equal(again.radiance, scene.light.radiance)
    for body, said in zip(scene.bodies, about["bodies"], strict=True):
        np.testing.assert_array_equal(body.albedo, np.float32(said["albedo"]))
        for name in ("rotation", "translation", "scale"):
            np.testing.assert_array_equal(getattr(body, name), said[name])
    camera = about["camera"]
    np.testing.assert_array_equal(scene.camera.rotation, camera["rotation"])


def test_a_sample_says_how_bodies_shine_and_how_near_light_is(recipe):
    ranges = Ranges(glossy=1.0, radius=(2.0, 2.0))
    data_set = DataSet(replace(recipe, ranges=ranges, layers=("color",)))
    files, scene = render_sample(data_set, 0), data_set.draw(0).scene
    about, channels = json.loads(files["json"]), exr_channels(files["exr"])
    *bodies, ground = about["bodies"]
    for body, said in zip(scene.bodies, bodies, strict=False):
        assert np.float32(said["roughness"]) == body.roughness and said["metallic"] == body.metallic
    assert "roughness" not in ground and about["light"]["radius"] == pytest.approx(scene.light.radius)
    diffuse = DataSet(replace(recipe, layers=("color",)))
    assert not np.array_equal(channels["R"], exr_channels(render_sample(diffuse, 0)["exr"])["R"])
    for name in ("glossy", "radius"):
        with pytest.raises(ValueError, match=f"{name}: got .*, which 'log-sh' does not show, expected none, or method"):
            replace(recipe, visibility=ws.Visibility("log-sh"), ranges=Ranges(**{name: getattr(ranges, name)}))


def test_only_the_layers_that_are_asked_for_are_written(recipe):
    files = render_sample(DataSet(replace(recipe, layers=("bodies", "depth"))), 0)
    assert set(files) == {"exr", "json"}
    assert set(exr_channels(files["exr"])) == {"Z", "body"}
    assert "sh" not in json.loads(files["json"])["light"]
    sample = Sample("0", exr_channels(files["exr"]), None, {})
    with pytest.raises(ValueError, match='channels: got Z, body, expected R, G, B, A, of the layer "color"'):
        _ = sample.color


def test_the_shadow_is_direct_light_over_that_which_nothing_blocks(recipe):
    """Without spheres nothing is blocked; and with bounces the ratio is still of direct light."""
    shadows = {}
    for bounces in (0, 1):
        given = {"layers": ("shadow",), "visibility": ws.Visibility("ray-traced", samples=64), "bounces": bounces}
        files = render_sample(DataSet(replace(recipe, **given)), 0)
        channels = exr_channels(files["exr"])
        shadows[bounces] = np.stack([channels[f"shadow.{color}"] for color in "RGB"], axis=-1)
    np.testing.assert_array_equal(shadows[0], shadows[1])
    assert 0 <= shadows[0].min() < 0.5 and shadows[0].max() == pytest.approx(1, abs=1e-5)
    scene = DataSet(replace(recipe, visibility=ws.Visibility("ray-traced", samples=64))).draw(0).scene
    white = [replace(body, albedo=(1, 1, 1)) for body in scene.bodies]
    plain = [replace(body, blockers=0) for body in white]
    one, other = (ws.render(replace(scene, bodies=bodies))[..., :3] for bodies in (white, plain))
    batch = ws.Renderer(scene, cameras=[scene.camera] * 2).shadow()
    np.testing.assert_array_equal(batch[0], shadows[0])
    inside = other > 0
    np.testing.assert_allclose(shadows[0][inside], (one[inside] / other[inside]), rtol=1e-6)
    assert (shadows[0][~inside] == 1).all()


def test_spheres_are_where_the_bodies_are(recipe, monkeypatch):
    """The spheres that a mesh gets are on its vertices; so those of a sample are on those in the world."""

    def on_vertices(mesh, count, **_):
        return SimpleNamespace(spheres=ws.Spheres(mesh.positions[:count], np.full(count, 0.1)))

    monkeypatch.setattr(data_sets, "fit_spheres", on_vertices)
    data_set = DataSet(replace(recipe, layers=("spheres",), blockers=5))
    files = render_sample(data_set, 2)
    rows = np.load(io.BytesIO(files["spheres.npy"]))
    *bodies, _ = data_set.draw(2).scene.bodies
    assert set(files) == {"json", "spheres.npy"} and rows.dtype == np.float32
    assert rows.shape == (5 * len(bodies), 5)
    for number, body in enumerate(bodies):
        own = rows[rows[:, 4] == number]
        np.testing.assert_allclose(own[:, :3], body.world_mesh().positions[:5], atol=1e-6)
        np.testing.assert_allclose(own[:, 3], 0.1 * body.scale, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ recipes

RECIPE = """
images = 30
seed = 3
shard = 8
layers = ["color", "masks"]
[bodies]
meshes = "meshes"
blockers = 16
creased = 30
count = [2, 2]
size = [0.5, 1]
upright = 1
albedo = [0.5, 0.6]
glossy = 0.5
roughness = [0.3, 0.5]
metal = 0.1
[light]
maps = "maps"
rotation = [0, 90]
scale = [1, 1]
radius = [1.5, 2]
bounces = 1
[camera]
size = [64, 32]
supersampling = 1
fov_y = [30, 50]
[visibility]
method = "directional"
directions = 64
[splits]
train = 0.75
test = 0.25
"""


def test_a_recipe_is_read(folder):
    (folder / "recipe.toml").write_text(RECIPE)
    recipe = load_recipe(folder / "recipe.toml")
    assert (recipe.images, recipe.seed, recipe.shard, recipe.layers) == (30, 3, 8, ("color", "masks"))
    assert (recipe.meshes, recipe.maps, recipe.blockers) == (folder / "meshes", folder / "maps", 16)
    assert recipe.creased == 30
    drawn = {"count": (2, 2), "size": (0.5, 1), "upright": 1, "albedo": (0.5, 0.6)}
    drawn |= {"glossy": 0.5, "roughness": (0.3, 0.5), "metal": 0.1}
    ranges = Ranges(**drawn, rotation=(0, 90), scale=(1, 1), radius=(1.5, 2), fov_y=(30, 50))
    assert recipe.ranges == ranges
    assert (recipe.size, recipe.supersampling, recipe.bounces) == ((64, 32), 1, 1)
    assert vars(recipe.visibility) == vars(ws.Visibility("directional", directions=64))
    assert recipe.splits == {"train": 0.75, "test": 0.25}


@pytest.mark.parametrize(
    ("line", "instead", "message"),
    [
        ("images = 30", "", "images: missing, expected a whole number of at least 1"),
        ("images = 30", "image = 30", "the recipe: unknown key 'image' (did you mean 'images'?)"),
        ('"masks"', '"mask"', "layers: got 'mask', expected one of "),
        ('"masks"', '"color"', "layers: got ['color', 'color'], expected one or more, each once"),
        ("shard = 8", "shard = 0", "shard: got 0, expected a whole number of images, at least 1"),
        ('meshes = "meshes"', 'meshes = "mesh"', "[bodies]: meshes: no such folder: "),
        ('meshes = "meshes"', "", "[bodies]: blockers: got it without meshes, for which it is"),
        ("blockers = 16", "blockers = -1", "[bodies]: blockers: got -1, expected a whole number of at least 0"),
        ("creased = 30", "creased = true", "[bodies]: creased: got True, expected degrees from 0 to 180"),
        ("images = 30", 'images = 30\nformat = "jpg"', "format: got 'jpg', expected one of 'exr', 'png'"),
        ("count = [2, 2]", "count = [2, 9]", "[bodies]: count: got [2, 9], expected two whole numbers from 1 to 6"),
        ("count = [2, 2]", "count = [2, 2.5]", "[bodies]: count: got [2, 2.5], expected two whole numbers from 1 to 6"),
        ("size = [0.5, 1]", "size = [1, 0.5]", "[bodies]: size: got [1, 0.5], expected two numbers from 0.01 to 1.5"),
        ("size = [0.5, 1]", "sizes = [1, 1]", "[bodies]: unknown key 'sizes' (did you mean 'size'?)"),
        ("upright = 1", "upright = 2", "[bodies]: upright: got 2, expected a part of all, from 0 to 1"),
        ("albedo = [0.5, 0.6]", "albedo = 0.5", "[bodies]: albedo: got 0.5, expected two numbers from 0 to 1"),
        ('maps = "maps"', "", "[light]: rotation: got it without maps, which it turns"),
        ("bounces = 1", "bounces = 17", "[light]: bounces: got 17, expected a whole number from 0 to 16"),
        ("size = [64, 32]", "size = [64]", "[camera]: size: got [64], expected width and height"),
        ("directions = 64", "directions = 9", "[visibility]: directions: got 9"),
        ("glossy = 0.5", "glossy = 2", "[bodies]: glossy: got 2, expected a part of all, from 0 to 1"),
        ("radius = [1.5, 2]", "radius = [0.5, 2]", "[light]: radius: got [0.5, 2], expected two numbers from 1.01"),
        ("test = 0.25", "test = 0.5", "[splits]: splits: got parts with the sum 1.25, expected 1"),
        ("test = 0.25", "test = 0", "[splits]: test: got 0, expected a part of all images, above 0 up to 1"),
        ("test = 0.25", '"a b" = 0.25', "[splits]: splits: got the name 'a b', expected letters, digits and _ alone"),
    ],
)
def test_a_mistake_in_a_recipe_is_named(folder, line, instead, message):
    path = folder / "wrong.toml"
    assert line in RECIPE
    path.write_text(RECIPE.replace(line, instead, 1))
    with pytest.raises((RecipeError, FileNotFoundError)) as error:
        load_recipe(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
