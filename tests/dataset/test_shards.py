"""Shards: the same bits in any order, on any number of workers, and after an interruption; read by torch's loaders."""

import contextlib
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tarfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from trimesh import creation
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow.cli import app
from warpshadow.dataset import DataSet, load_recipe, read_shard, shards, write_shards
from warpshadow.dataset.samples import render_sample

PAGE = Path(__file__).parents[2] / "warpshadow" / "dataset" / "README.md"

RECIPE = """
images = 14
shard = 3
layers = ["color", "depth", "normals", "bodies", "light"]
[bodies]
meshes = "meshes"
[camera]
size = [16, 16]
supersampling = 1
[visibility]
method = "none"
[splits]
train = 0.5
val = 0.5
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    """A recipe of balls of several sizes, which needs no fits."""
    folder = tmp_path_factory.mktemp("recipe")
    (folder / "meshes").mkdir()
    for k in range(8):
        ws.icosphere(0.1 + 0.1 * k, 1).write(folder / "meshes" / f"{k}.obj")
    (folder / "recipe.toml").write_text(RECIPE)
    return folder / "recipe.toml"


@pytest.fixture(scope="module")
def written(recipe, tmp_path_factory):
    """Shards that one process wrote."""
    folder = tmp_path_factory.mktemp("written") / "shards"
    write_shards(DataSet(load_recipe(recipe)), folder, workers=1)
    return folder


def bits(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if not path.name.startswith(".")}


def test_shards_have_each_sample_once_in_order_and_say_nothing_of_who_wrote_them_when(written):
    names = ["train-000000", "train-000001", "train-000002", "val-000000", "val-000001", "val-000002"]
    assert list(bits(written)) == ["dataset.json", *(f"{name}.tar" for name in names)]
    index = json.loads((written / "dataset.json").read_text())
    assert index["splits"]["val"]["shards"] == [f"{name}.tar" for name in names[3:]]
    keys = []
    for name in names:
        with tarfile.open(written / f"{name}.tar") as archive:
            members = archive.getmembers()
        keys += [member.name for member in members]
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in members} == {(0, 0, 0, "", "", 0o644)}
    assert keys == [f"{number:09d}.{ending}" for number in range(14) for ending in ("exr", "json")]


def test_a_sample_is_read_as_it_was_rendered(recipe, written):
    data_set = DataSet(load_recipe(recipe))
    samples = [sample for path in sorted(written.glob("val-*.tar")) for sample in read_shard(path)]
    assert [sample.key for sample in samples] == [f"{number:09d}" for number in range(7, 14)]
    assert [sample.scene["number"] for sample in samples] == list(range(7, 14))
    np.testing.assert_array_equal(samples[0].color, ws.render(data_set.draw(7).scene))
    assert samples[0].spheres is None


def test_a_sample_has_the_same_bits_in_any_order_on_any_number_of_threads(recipe):
    """With shadows by spheres and traced ones, and a ratio of two images."""
    plain = load_recipe(recipe)
    data_set = DataSet(replace(plain, layers=("color", "shadow", "masks"), blockers=0, size=(32, 32)))
    data_set.recipe.__dict__["visibility"] = ws.Visibility()
    try:
        ws.set_thread_count(1)
        forward = [render_sample(data_set, number) for number in (0, 1, 8)]
        ws.set_thread_count(3)
        backward = [render_sample(data_set, number) for number in (8, 1, 0)]
    finally:
        ws.set_thread_count(None)
    assert forward == backward[::-1]


def test_a_warning_is_said_once_with_the_number_of_the_first_image_and_creased_meshes_draw_none(recipe, tmp_path):
    """Boxes, whose corners have one normal each."""
    (tmp_path / "meshes").mkdir()
    for name, width in (("box", 1.0), ("bar", 2.0)):
        box = creation.box((width, 1, 1))
        ws.Mesh(box.vertices, box.faces).write(tmp_path / "meshes" / f"{name}.obj")
    plain = replace(load_recipe(recipe), images=4, splits={"train": 1.0}, meshes=tmp_path / "meshes")
    with pytest.warns(UserWarning) as said:
        write_shards(DataSet(plain), tmp_path / "rounded", workers=1)
    (message,) = [str(each.message) for each in said]
    assert re.match(r"image 0: body 0 \('b..'\) has sharp edges", message)
    creased = DataSet(replace(plain, creased=30))
    assert creased.hashes == DataSet(plain).hashes and len(creased.draw(0).scene.bodies[0].mesh.positions) == 24
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_shards(creased, tmp_path / "creased", workers=1)


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed_write_the_same_bits_as_one(recipe, written, tmp_path, monkeypatch):
    run_tasks, killed = shards.run_tasks, []

    def run_and_kill(*args, **options):
        with contextlib.closing(run_tasks(*args, **options)) as ended:
            for count, each in enumerate(ended):
                if count == 4:
                    killed.append(multiprocessing.active_children()[0])
                    os.kill(killed[0].pid, signal.SIGKILL)
                yield each

    monkeypatch.setattr(shards, "run_tasks", run_and_kill)
    write_shards(DataSet(load_recipe(recipe)), tmp_path / "shards", workers=2)
    assert [process.exitcode for process in killed] == [-signal.SIGKILL]
    assert bits(tmp_path / "shards") == bits(written)


@pytest.mark.slow
def test_what_is_killed_goes_on_to_the_same_bits_and_keeps_what_is_whole(recipe, written, tmp_path):
    folder = tmp_path / "shards"
    command = [sys.executable, "-m", "warpshadow", "dataset", str(recipe), "-o", str(folder), "--workers", "1"]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    try:
        end = time.monotonic() + 120
        while not (folder / "train-000001.tar").exists():
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.001)
    finally:
        process.kill()
        process.wait()
    whole = {path.name: path.stat().st_mtime_ns for path in folder.glob("[!.]*.tar")}
    (folder / ".0123456789ab.unfinished.tar").write_bytes(b"what a process that was killed leaves")
    result = CliRunner().invoke(app, ["dataset", str(recipe), "-o", str(folder), "--workers", "1"])
    assert result.exit_code == 0, result.output
    assert re.search(r"shards: 6 shards, 14 images, \S+ MB, \d+ s", result.output)
    assert bits(folder) == bits(written)
    assert not list(folder.glob(".*.unfinished.tar"))
    assert {name: (folder / name).stat().st_mtime_ns for name in whole} == whole


def test_a_folder_of_another_data_set_is_refused_and_stays_as_it_is(recipe, written, tmp_path, monkeypatch):
    before = bits(written)
    other = tmp_path / "other.toml"
    meshes = json.dumps(str(recipe.parent / "meshes"))
    for line, instead, difference in (
        ("images = 14", "images = 15", "recipe: images: was 14, is 15"),
        ("size = [16, 16]", "size = [16, 24]", "recipe: size: was [16, 16], is [16, 24]"),
        ("[splits]", "order = 5\n[splits]", "recipe: visibility: order: was 8, is 5"),
    ):
        other.write_text(RECIPE.replace('"meshes"', meshes).replace(line, instead))
        result = CliRunner().invoke(app, ["dataset", str(other), "-o", str(written)])
        assert result.exit_code == 1
        assert f"got shards of another data set ({difference}), expected those of this one" in result.output
    monkeypatch.setattr(shards, "ALGORITHM_VERSION", -1)
    with pytest.raises(FileExistsError, match=r"made_by: spheres: was \d+, is -1"):
        write_shards(DataSet(load_recipe(recipe)), written)
    assert bits(written) == before
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").touch()
    with pytest.raises(
        FileExistsError, match="got a folder with thesis.tex in it, expected a new one or one of shards"
    ):
        write_shards(DataSet(load_recipe(recipe)), tmp_path / "folder")


def test_a_damaged_shard_is_named(written, tmp_path):
    whole = (written / "train-000000.tar").read_bytes()
    path = tmp_path / "part.tar"
    for content in (b"", b"no tar" * 200, whole[: len(whole) // 3]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{re.escape(str(path))}: "):
            list(read_shard(path))


# ------------------------------------------------------------------------------- the reader of the page


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """The module that the page shows."""
    (snippet,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    (tmp_path / "shard_reader.py").write_text(snippet, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "shard_reader", raising=False)
    import shard_reader

    return shard_reader


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("start", [None, "fork", "spawn"])
def test_torch_s_loader_reads_each_sample_once(reader, written, start):
    if start == "fork" and not hasattr(os, "fork"):
        pytest.skip("this system has no fork")
    workers = {"num_workers": 2, "multiprocessing_context": start} if start else {}
    loader = torch.utils.data.DataLoader(reader.Shards(f"{written}/train-*.tar"), batch_size=2, **workers)
    batches = list(loader)
    assert [tuple(part.shape) for part in batches[0]] == [(2, 16, 16, 4), (2, 16, 3)]
    found = sorted(image.numpy().tobytes() for images, _ in batches for image in images)
    samples = [sample for path in written.glob("train-*.tar") for sample in read_shard(path)]
    assert found == sorted(sample.color.tobytes() for sample in samples)
