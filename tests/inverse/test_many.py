"""Many fits: each ends as it would alone, and what is wrong with one costs only that one."""

import contextlib
import csv
import dataclasses
import functools
import importlib.util
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow import inverse
from warpshadow.assets.image import exr_bytes
from warpshadow.cli import app
from warpshadow.device.cluster import run_on_ray
from warpshadow.inverse import checkpoint, many

ITERATIONS = 6
TIME = 120.0  # for what takes seconds [s]
SCENE = """
light = {sh = [[1, 1, 1], [0.4, 0.4, 0.4], [0, 0, 0], [0, 0, 0]]}
[camera]
eye = [0, 2, 4]
target = [0, 0.5, 0]
size = [16, 16]
[visibility]
directions = 32
[[body]]
mesh = "ball.obj"
translation = [0, 0.8, 0]
scale = 0.6
spheres = "ball.npz"
[[body]]
primitive = "plane"
size = 4
segments = 4
"""
FIT = f"""
scene = "../scene.toml"
tolerance = 0
[[target]]
image = "photo.exr"
[[free.pose]]
body = "ball"
[[stage]]
iterations = {ITERATIONS}
"""
BROKEN = {
    "no mesh": (("../scene.toml", "scene.toml"), "no mesh/fit.toml: scene: "),
    "NaN": (("photo.exr", "nan.exr"), "NaN/fit.toml: 1st [[target]]"),
    "size": (("photo.exr", "wide.exr"), "size/fit.toml: targets: got an image of 24 × 16 pixels"),
}
GOOD = ("a", "b", "c")


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of fits of a ball's pose, three of which are broken."""
    folder = tmp_path_factory.mktemp("many") / "photos"
    folder.mkdir()
    mesh = ws.icosphere(subdivisions=1)
    mesh.write(folder / "ball.obj")
    ws.Spheres([[0, 0, 0]], [0.9]).write(folder / "ball.npz")
    (folder / "scene.toml").write_text(SCENE)
    for number, name in enumerate((*GOOD, *BROKEN)):
        (folder / name).mkdir()
        (folder / name / "fit.toml").write_text(FIT.replace(*BROKEN[name][0]) if name in BROKEN else FIT)
        (folder / "true.toml").write_text(SCENE.replace("[0, 0.8, 0]", f"[{0.1 + 0.02 * number}, 0.8, 0]"))
        image = ws.render(ws.load_scene(folder / "true.toml"))
        ws.write_image(folder / name / "photo.exr", image)
    (folder / "NaN" / "nan.exr").write_bytes(exr_bytes(dict.fromkeys("RGBA", np.full(image.shape[:2], np.nan))))
    ws.write_image(folder / "size" / "wide.exr", np.zeros((16, 24, 4), np.float32))
    return folder


@pytest.fixture(scope="module")
def alone(photos):
    """The values of the good fits, each done by itself."""
    return {name: inverse.load_fit(photos / name / "fit.toml").run(progress=False).values for name in GOOD}


class DyingOnce(inverse.QuasiNewton):
    """Kills its process once, at its fourth step."""

    def __init__(self, mark, parameters, lr):
        super().__init__(parameters, lr=lr)
        self.mark, self.steps = mark, 0

    def step(self, closure=None):
        loss = super().step(closure)
        self.steps += 1
        if self.steps == 4 and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return loss


def killed(photos, mark):
    """The first of the fits, whose worker is killed before the mark is there."""
    problem = inverse.load_fit(photos / "a" / "fit.toml").problem
    return inverse.Fit(problem, (inverse.Stage(ITERATIONS),), functools.partial(DyingOnce, mark), 0.0, 0)


@pytest.fixture(scope="module")
def results(photos):
    """What became of all fits, one of them with a worker that is killed, on two workers; and their folder."""
    folder = photos.parent / "results"
    fits = inverse.find_fits(photos / "*" / "fit.toml") | {"killed": killed(photos, photos / "mark")}
    return inverse.fit_many(fits, folder, workers=2, checkpoint_seconds=0.0, progress=False), folder


def assert_same_values(folder, values):
    with np.load(folder / "parameters.npz") as found:
        expected = {f"{name}.{key}": each.numpy() for name, own in values.items() for key, each in own.items()}
        assert {*found} == {*expected}
        for name, each in expected.items():
            np.testing.assert_array_equal(found[name], each)


@pytest.mark.slow
def test_each_fit_ends_as_it_would_alone_to_the_bit(results, alone):
    endings, folder = results
    good = [ending for ending in endings if ending.name in GOOD]
    assert [(ending.reason, ending.iterations) for ending in good] == [("finished", ITERATIONS)] * len(GOOD)
    assert (folder.parent / "photos" / "mark").exists()
    assert_same_values(folder / "killed", alone["a"])
    for ending in good:
        assert_same_values(folder / ending.name, alone[ending.name])
        body = ws.load_scene(folder / ending.name / "scene.toml").bodies[0]
        assert ending.parameters["ball.translation"] == pytest.approx(body.translation)
        assert ending.loss_after < ending.loss_before


@pytest.mark.slow
def test_broken_files_are_named_and_cost_only_themselves(results):
    endings, folder = results
    failed = {ending.name: ending for ending in endings if not ending.is_good}
    assert failed.keys() == BROKEN.keys()
    for name, (_, message) in BROKEN.items():
        assert failed[name].reason == "failed" and message in failed[name].error
        assert not (folder / name / "summary.toml").exists()


@pytest.mark.slow
def test_the_table_has_a_row_for_each(results):
    endings, folder = results
    with (folder / "table.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert [*rows] == [ending.name for ending in endings] == [*sorted((*GOOD, *BROKEN)), "killed"]
    for ending in endings:
        row = rows[ending.name]
        assert (row["reason"], row["error"]) == (ending.reason, ending.error)
        if ending.is_good:
            assert float(row["loss_after"]) == ending.loss_after
            assert float(row["ball.translation[0]"]) == ending.parameters["ball.translation"][0]


@pytest.mark.slow
def test_what_has_ended_is_not_done_again(results, photos, monkeypatch):
    endings, folder = results
    monkeypatch.setattr(many, "_run_job", None)  # what a worker would do
    good = {name: photos / name / "fit.toml" for name in GOOD} | {"killed": killed(photos, photos / "mark")}
    assert inverse.fit_many(good, folder, progress=False) == [each for each in endings if each.is_good]


def test_a_fit_is_another_once_a_file_that_it_or_its_scene_names_has_changed(tmp_path):
    (tmp_path / "fit.toml").write_text('scene = "scene.toml"\nphoto = "bob\'s.exr"\n')
    (tmp_path / "scene.toml").write_text('mesh = "ball.obj"\n')
    digests = {many._digest(tmp_path / "fit.toml")}
    for count, name in enumerate(("bob's.exr", "ball.obj", "scene.toml", "fit.toml"), start=2):
        with (tmp_path / name).open("a") as file:
            file.write("# more\n")
        digests.add(many._digest(tmp_path / "fit.toml"))
        assert len(digests) == count
    assert many._digest(tmp_path / "fit.toml") in digests


def test_a_damaged_record_is_none(tmp_path):
    job = many._FitJob("a", tmp_path, tmp_path / "fit.toml", "digest", "cpu", 10.0)
    job.folder.mkdir()
    for text in ("{", "[]", "{}"):
        (job.folder / "ending.json").write_text(text)
        assert job.recorded() is None


@pytest.mark.slow
def test_the_command_goes_on_after_a_kill_and_says_how_many_ended_how(photos, alone, tmp_path):
    (photos / "some.txt").write_text("a/fit.toml\nsize/fit.toml\n")
    arguments = ["fit", str(photos / "some.txt"), "-o", str(tmp_path / "results"), "--checkpoint-seconds", "0"]
    arguments += ["--workers", "1"]
    program = [sys.executable, "-c", "from warpshadow.cli import app; app()"]
    with subprocess.Popen([*program, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as head:
        deadline = time.monotonic() + TIME
        while not (tmp_path / "results" / "a" / "checkpoint").exists():
            assert time.monotonic() < deadline and head.poll() is None
            time.sleep(0.005)
        head.kill()
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert result.stdout.strip() == f"{tmp_path / 'results' / 'table.csv'}: 1 finished, 1 failed"
    assert f"error: size failed: {photos / BROKEN['size'][1]}" in result.stderr
    assert_same_values(tmp_path / "results" / "a", alone["a"])


# ---------------------------------------------------------------------------------------------- on a Ray cluster


class KillingItsNode(inverse.QuasiNewton):
    """Kills a node of a cluster that is to die, at its fourth step there, and counts steps."""

    def __init__(self, counts, parameters, lr):
        super().__init__(parameters, lr=lr)
        self.counts, self.steps = counts, 0

    def step(self, closure=None):
        self.steps += 1
        with self.counts.open("a") as file:
            file.write("x")
        if self.steps == 4 and "TO_DIE" in os.environ:
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(TIME)  # until it is known that the node is no more
        return super().step(closure)


def start_node(*arguments, **environment):
    """Start a node of one core."""
    command = [sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", "--block", "--num-cpus=1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    node = subprocess.Popen([*command, "--disable-usage-stats", *arguments], env=os.environ | environment, **pipes)
    lines = [*itertools.takewhile(lambda line: "Ray runtime started" not in line, node.stdout)]
    assert node.poll() is None, lines
    return node


@pytest.fixture(scope="module")
def cluster():
    """The address of a real one, on this machine, and its head; it has two nodes, and asks for a token."""
    if importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed (the extra 'ray')")
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as nodes:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # where workers find this file
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", "of-tests-alone")
        folder = nodes.enter_context(tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True))
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        head = start_node("--head", f"--port={port}", "--include-dashboard=false", f"--temp-dir={folder}")
        nodes.callback(head.wait)
        nodes.callback(head.terminate)
        other = start_node(f"--address=127.0.0.1:{port}", TO_DIE="yes")
        nodes.callback(other.wait)
        nodes.callback(other.terminate)
        yield f"127.0.0.1:{port}", head


@pytest.mark.slow
def test_on_a_ray_cluster_fits_end_as_they_would_alone_though_a_worker_and_a_node_die(cluster, photos, alone, tmp_path):
    counts = tmp_path / "counts"
    fit = killed(photos, tmp_path / "mark")
    dying = dataclasses.replace(fit, optimizer=functools.partial(KillingItsNode, counts))
    fits = {"0": dying, "1": dying, "worker": fit, "b": photos / "b" / "fit.toml", "NaN": photos / "NaN" / "fit.toml"}
    options = {"ray": cluster[0], "checkpoint_seconds": 0.0, "progress": False}
    endings = inverse.fit_many(fits, tmp_path / "results", **options)
    assert {each.name: each.reason for each in endings} == dict.fromkeys(fits, "finished") | {"NaN": "failed"}
    assert BROKEN["NaN"][1] in endings[-1].error and (tmp_path / "mark").exists()
    assert counts.stat().st_size == 2 * ITERATIONS + 1  # nothing was done twice but the step that was cut off
    for folder, name in (("0", "a"), ("1", "a"), ("worker", "a"), ("b", "b")):
        assert_same_values(tmp_path / "results" / folder, alone[name])


@pytest.mark.slow
def test_who_has_no_token_for_a_ray_cluster_is_told_so(cluster, photos, tmp_path):
    program = [sys.executable, "-c", "from warpshadow.cli import app; app()"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    environment["RAY_NUM_REDIS_GET_RETRIES"] = "1"  # in place of 20, a second each
    command = [*program, "fit", photos, "-o", tmp_path / "results", "--ray", cluster[0]]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIME)
    assert result.returncode == 1
    said = result.stderr.strip().splitlines()[-1]
    assert said.startswith(f"error: ray: got '{cluster[0]}'") and "set RAY_AUTH_MODE=token" in said


@pytest.mark.slow
def test_the_death_of_the_head_of_a_ray_cluster_is_an_error(cluster, monkeypatch):
    """It comes last, as the cluster dies."""
    monkeypatch.setattr("warpshadow.device.cluster._HEAD_TIMEOUT", 1.0)
    ended = run_on_ray(time.sleep, [0.0, TIME], cluster[0])
    assert next(ended).task == 0.0
    cluster[1].kill()
    host, port = cluster[0].split(":")
    with contextlib.suppress(OSError):
        while True:
            socket.create_connection((host, int(port)), timeout=TIME).close()
            time.sleep(0.1)
    with pytest.raises(ConnectionError, match="ray: the head of the cluster at .* has died"):
        next(ended)


# ---------------------------------------------------------------------------------------------- of the folder


def test_others_do_not_write_into_the_folder_meanwhile(photos, tmp_path):
    (tmp_path / "results").mkdir()
    with checkpoint.exclusive(tmp_path / "results" / many.TABLE), pytest.raises(inverse.CheckpointError, match="table"):
        inverse.fit_many([photos / "a" / "fit.toml"], tmp_path / "results", progress=False)


# ---------------------------------------------------------------------------------------------- names


@pytest.fixture
def tree(tmp_path):
    for name in ("x/fit.toml", "y/z/fit.toml", "y/z/scene.toml", "y/pose.toml", "y.toml"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "list.txt").write_text("x/fit.toml\n\n../in/y/pose.toml\n")
    return tmp_path / "in"


@pytest.mark.parametrize(
    ("where", "names"),
    [
        ("", ["x", "y/z"]),
        ("**/fit.toml", ["x", "y/z"]),
        ("*/pose.toml", ["y"]),
        ("y/*.toml", ["pose"]),
        ("list.txt", ["x", "y/pose"]),
    ],
)
def test_fits_are_named_by_their_paths(tree, where, names):
    assert many.is_of_many(tree / where)
    found = inverse.find_fits(tree / where)
    assert [*found] == names and all(file.is_file() for file in found.values())


def test_several_files_are_named_from_the_folder_that_all_are_in(tree):
    assert [*inverse.find_fits([tree / "x" / "fit.toml", tree / "y" / "pose.toml"])] == ["x", "y/pose"]
    with pytest.raises(FileNotFoundError, match="none.toml"):
        inverse.find_fits([tree / "x" / "fit.toml", tree / "none.toml"])


def test_the_folder_of_one_fit_does_not_take_many(tree, tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "checkpoint").touch()
    with pytest.raises(FileExistsError, match="got the folder of one fit"):
        inverse.fit_many(inverse.find_fits(tree), tmp_path / "one")


def test_a_fit_file_is_one(tree):
    assert not many.is_of_many(tree / "y.toml")
    (tree / "[1].toml").touch()
    assert not many.is_of_many(tree / "[1].toml")


def test_names_of_one_folder_are_refused(tree):
    with pytest.raises(ValueError, match="'y' and 'y/pose', of which one is in the other"):
        inverse.find_fits(tree / "**" / "*.toml")
    with pytest.raises(FileNotFoundError, match=r"no\*: no fit file"):
        inverse.find_fits(tree / "no*")
    for name in ("../a", "/a", "", ".", many.TABLE):
        with pytest.raises(ValueError, match="expected that of a folder"):
            inverse.fit_many({name: tree / "y.toml"}, tree / "out")
    with pytest.raises(ValueError, match=r"the names 'a' and './a' of one folder"):
        inverse.fit_many({"a": tree / "y.toml", "./a": tree / "y.toml"}, tree / "out")
    assert not (tree / "out").exists()
