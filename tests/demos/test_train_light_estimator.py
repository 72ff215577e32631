"""The demo that trains a light estimator, at a size at which it takes no time."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import warpshadow as ws
from demos.examples import train_light_estimator as demo
from warpshadow.dataset import DataSet, load_recipe, write_shards
from warpshadow.inverse import checkpoint
from warpshadow.maths import sh
from warpshadow.scene.random_scenes import RandomScenes

SPHERE = ws.Body(ws.icosphere(0.5, 2), blockers=ws.Spheres(np.zeros((1, 3)), [0.5]), receivers="pixel")
ALONE = demo.Team(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def lessons():
    torch.set_num_threads(1)
    return demo.own_share(RandomScenes(0, 4, size=(16, 16), bodies=[SPHERE], supersampling=1), ALONE)


def parameters(network):
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


def some_shading(count=2):
    shading = torch.rand(count, 16, 16, 4, generator=torch.Generator().manual_seed(0)) + 0.1
    shading[..., 3] = 1
    return shading


def test_light_is_as_bright_and_as_colored_as_the_image():
    network, shading = demo.LightEstimator((16, 16)), some_shading()
    light = network(shading)
    assert light.shape == (2, demo.ORDER**2, 3)
    torch.testing.assert_close(network(shading * torch.tensor([2.0, 2.0, 2.0, 1.0])), 2 * light)
    torch.testing.assert_close(network(shading[..., [2, 0, 1, 3]]), light[..., [2, 0, 1]])


def test_shading_is_the_image_over_its_reflectance(lessons):
    for lesson in lessons:
        bodies = [
            dataclasses.replace(body, albedo=(1, 1, 1), texture=None, receivers="pixel") for body in lesson.scene.bodies
        ]
        scene = lesson.scene
        white = ws.Scene(bodies, scene.light, scene.camera, demo.RAY_TRACED, scene.supersampling)
        expected = ws.render(white)
        inside = expected[..., 3] == 1
        ratios = lesson.shading.numpy()[inside, :3] / expected[inside, :3]
        # where bodies share a pixel, means of ratios are not those of means
        assert np.median(np.abs(ratios - 1)) < 1e-5
        assert np.quantile(np.abs(ratios - 1), 0.7) < 1e-4


def test_the_light_of_whoever_looks_is_turned_to_the_world(lessons):
    for lesson in lessons:
        right = lesson.scene.camera.rotation[0]
        seen = torch.from_numpy(sh.evaluate(demo.ORDER, np.array([[1.0, 0, 0], [0, 1, 0]])).T).float()
        expected = sh.evaluate(demo.ORDER, np.array([right, [0, 1, 0]])).T
        np.testing.assert_allclose(lesson.to_world @ seen, expected, atol=1e-5)


def test_a_mirrored_image_is_that_of_mirrored_light():
    """A sphere in the middle, seen from the front, is its own mirror image; so only the light is mirrored."""
    ground = ws.Body(ws.plane(6.0, 1), blockers=1, receivers="pixel")
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(16, 16))
    light = np.zeros((demo.ORDER**2, 3), np.float32)
    light[0], light[3] = 3, 1  # from the right
    body = ws.Body(ws.icosphere(0.5, 4), blockers=SPHERE.blockers, translation=(0, 0.5, 0), receivers="pixel")
    scene = ws.Scene((body, ground), light, camera, demo.RENDERERS["none"])
    mirrored = demo.MIRROR.numpy() @ light
    image, other = (ws.render(scene), ws.Renderer(scene).render(mirrored.astype(np.float32)))
    np.testing.assert_allclose(image[:, ::-1], other, atol=0.02)
    assert np.abs(image - other).max() > 0.2


@pytest.mark.slow
@pytest.mark.parametrize("through", ["directional", "none"])
def test_training_lessens_the_difference_of_the_images(lessons, through, tmp_path):
    def loss_after(epochs):
        path = tmp_path / f"{epochs}"
        demo.train(lessons, demo.Course(through, epochs, batch=2), ALONE, path)
        return checkpoint.load(path)["loss"]

    assert loss_after(30) < 0.6 * loss_after(1)


@pytest.fixture
def interrupted(monkeypatch):
    """Let training end as if it were killed when a given epoch begins."""
    batches = demo.batches

    def interrupt_at(last_epoch):
        def some_batches(lessons, epoch, *others):
            if epoch == last_epoch:
                raise KeyboardInterrupt
            return batches(lessons, epoch, *others)

        monkeypatch.setattr(demo, "batches", some_batches)

    return interrupt_at


COURSE = demo.Course("none", 5, batch=2)


def test_what_was_interrupted_and_resumed_ends_bit_for_bit_as_what_was_not(lessons, tmp_path, interrupted):
    expected = demo.train(lessons, COURSE, ALONE, tmp_path / "whole")
    interrupted(3)
    with pytest.raises(KeyboardInterrupt):
        demo.train(lessons, COURSE, ALONE, tmp_path / "parts")
    assert checkpoint.load(tmp_path / "parts")["epoch"] == 3
    interrupted(None)
    resumed = demo.train(lessons, COURSE, ALONE, tmp_path / "parts", resume=True)
    assert torch.equal(parameters(resumed), parameters(expected))
    assert checkpoint.load(tmp_path / "parts")["loss"] == checkpoint.load(tmp_path / "whole")["loss"]


def test_a_truncated_checkpoint_is_noticed_and_the_one_before_it_serves(lessons, tmp_path, interrupted):
    expected = demo.train(lessons, COURSE, ALONE, tmp_path / "whole")
    interrupted(3)
    with pytest.raises(KeyboardInterrupt):
        demo.train(lessons, COURSE, ALONE, tmp_path / "parts")
    content = (tmp_path / "parts").read_bytes()
    (tmp_path / "parts").write_bytes(content[: len(content) // 2])
    interrupted(None)
    with pytest.warns(UserWarning, match="going on from parts.previous"):
        resumed = demo.train(lessons, COURSE, ALONE, tmp_path / "parts", resume=True)
    assert torch.equal(parameters(resumed), parameters(expected))


def test_a_checkpoint_of_another_course_is_refused(lessons, tmp_path):
    demo.train(lessons, demo.Course("none", 1), ALONE, tmp_path / "state")
    with pytest.raises(ValueError, match=r"was begun with {'epochs': 1}, expected {'epochs': 2}"):
        demo.train(lessons, demo.Course("none", 2), ALONE, tmp_path / "state", resume=True)


def test_without_resume_training_begins_anew(lessons, tmp_path):
    first, second = (demo.train(lessons, COURSE, ALONE, tmp_path / "state") for _ in range(2))
    assert torch.equal(parameters(first), parameters(second))


RECIPE = """
images = 3
layers = ["color"]
[camera]
size = [16, 16]
supersampling = 1
[visibility]
method = "ray-traced"
samples = 256
[splits]
train = 0.67
test = 0.33
"""


def test_the_loss_is_the_same_from_shards_as_from_scenes_that_are_drawn(tmp_path):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(RECIPE)
    write_shards(DataSet(load_recipe(recipe)), tmp_path / "shards", workers=1)
    scenes, split = demo.of_recipe(recipe)
    paths = sorted((tmp_path / "shards").glob(f"{split}-*.tar"))
    random = RandomScenes(0, 2, (16, 16), scenes.bodies, supersampling=1)
    shares = demo.own_share(random, ALONE), demo.own_share(scenes, ALONE, paths)
    losses = []
    for number, lessons in enumerate(shares):
        demo.train(lessons, COURSE, ALONE, tmp_path / f"{number}")
        losses.append(checkpoint.load(tmp_path / f"{number}")["loss"])
    assert len(shares[1]) == 2 and losses[0] == losses[1]
    with pytest.raises(ValueError, match="shards: got none with image 0, expected all of the split"):
        demo.own_share(scenes, ALONE, sorted((tmp_path / "shards").glob("test-*.tar")))


TWO_PROCESSES = """
import sys
sys.path[:0] = {paths!r}
import torch
import test_train_light_estimator as test
from test_train_light_estimator import demo, RandomScenes
folder = demo.Path(sys.argv[1])
team = demo.assemble("cpu")
scenes = RandomScenes(0, 4, size=(16, 16), bodies=[test.SPHERE], supersampling=1)
lessons = demo.own_share(scenes, team)
assert [lesson.number for lesson in lessons] == [team.rank, team.rank + 2]
course = demo.Course("none", 3, batch=4)
network = demo.train(lessons, course, team, folder / "state")
torch.save(test.parameters(network), folder / f"{{team.rank}}.pt")

batches = demo.batches
demo.batches = lambda lessons, epoch, *others: batches(lessons, epoch, *others) if epoch < 2 else 1 / 0
try:
    demo.train(lessons, course, team, folder / "parts")
except ZeroDivisionError:
    demo.batches = batches
team.wait()
resumed = demo.train(lessons, course, team, folder / "parts", resume=True)
assert torch.equal(test.parameters(resumed), test.parameters(network))
demo.part(team)
"""


@pytest.mark.slow
def test_two_processes_learn_the_same_as_one_and_resume_together(lessons, tmp_path):
    """A batch of all scenes has the same gradient wherever its halves are computed, up to rounding."""
    program = tmp_path / "program.py"
    program.write_text(TWO_PROCESSES.format(paths=[str(Path(__file__).parents[2]), str(Path(__file__).parent)]))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", program, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    assert torch.equal(first, second)
    course = demo.Course("none", 3, batch=4)
    alone = parameters(demo.train(lessons, course, ALONE, tmp_path / "alone"))
    torch.testing.assert_close(first, alone, atol=1e-4, rtol=0)
    untrained = parameters(demo.train(lessons, demo.Course("none", 0), ALONE, tmp_path / "untrained"))
    assert (untrained - alone).abs().max() > 1e-3
    assert checkpoint.load(tmp_path / "state")["about"]["processes"] == 2


def test_errors_of_light_are_those_of_the_sky_alone():
    truths = torch.zeros(3, demo.ORDER**2, 3)
    truths[:, 0] = 1
    lights = truths * torch.tensor([1.0, 0.5, 3.0])[:, None, None]
    np.testing.assert_allclose(demo.light_errors(lights, truths), [0, 0.5, 2], atol=1e-6)


@pytest.mark.slow
def test_the_whole_demo_judges_and_draws(tmp_path, capsys):
    pytest.importorskip("pxr", reason="the bunny is a USD file")
    demo.main(tmp_path, scenes=2, epochs=1, held_out=1, size=16, bodies=[SPHERE], picture_size=48)
    printed = capsys.readouterr().out
    assert "learned with shadows" in printed and "learned without" in printed
    picture = ws.read_image(tmp_path / "light_estimator.png")
    assert picture.shape[1] == 4 * 48
    assert np.ptp(picture[..., :3]) > 0.1
    assert {path.name for path in tmp_path.glob("*.checkpoint")} == {
        "light_estimator_directional.checkpoint",
        "light_estimator_none.checkpoint",
    }
