"""A small network that tells the light from one image, taught by the renderer alone, with shadows and without.

    python demos/examples/train_light_estimator.py [--scenes 1024] [--epochs 40] [--resume]
    python demos/examples/train_light_estimator.py --recipe RECIPE.toml [--shards FOLDER]
    torchrun --nproc_per_node=2 demos/examples/train_light_estimator.py

The network sees a ray-traced image of a random scene, its known reflectance divided out, and predicts the light in
spherical harmonics. Nobody tells it the light: the scene, whose geometry is known, too, is drawn again in the predicted
light, and the network learns from the difference of the images. One network learns through a renderer with shadows, its
twin through direct illumination. Then both look at scenes that they have not seen, and their estimates relight a bunny.

Several processes share the scenes (DistributedDataParallel: gloo on a CPU, nccl on GPUs), and the first of them writes
the files. A run that was interrupted goes on with --resume, to the same numbers as if it had not been.

The scenes may be those of the first split of a recipe (warpshadow/dataset/README.md). Their images may come from shards
that ``warpshadow dataset`` wrote; if it ray traced them as this does, into OpenEXR, the losses are the same to the last
bit.
"""

import argparse
import dataclasses
import itertools
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import distributed, nn
from torch.utils.data.distributed import DistributedSampler
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.examples.bunny import contact_sheet
from demos.scenes import image_error, on_ground, shipped_mesh
from warpshadow.dataset import DataSet, load_recipe, read_shard
from warpshadow.inverse import checkpoint
from warpshadow.maths import sh
from warpshadow.scene.random_scenes import RandomScenes, primitives
from warpshadow.torch import TorchRenderer

ORDER = 4
RENDERERS = {"directional": ws.Visibility(method="directional"), "none": ws.Visibility(method="none", order=ORDER)}
RAY_TRACED = ws.Visibility(method="ray-traced", samples=256)
LABELS = {"directional": "with shadows", "none": "without"}
EVEN_LIGHT = np.eye(ORDER**2, 1) * np.full(3, math.sqrt(4 * math.pi))  # radiance 1 from everywhere
MIRROR = torch.from_numpy(sh.harmonic_rotation(ORDER, np.diag([-1.0, 1.0, 1.0])))  # of light: left is right
PICTURED = 3


class LightEstimator(nn.Module):
    """Tells light from shading, in the frame of whoever looks: x to the right, y up, z level and backward.

    Red, green and blue are looked at one by one, each at its own exposure: light twice as bright, or of another color,
    is told twice as bright, or of that color.

    Args:
        size: Height and width of the images [pixels], multiples of 8.
        order: Number of SH bands of the light.
    """

    def __init__(self, size: tuple[int, int], order: int = ORDER):
        super().__init__()
        widths = (2, 16, 32, 64)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.SiLU()]
        cell_count = (size[0] // 8) * (size[1] // 8)
        self.look = nn.Sequential(*layers, nn.Flatten(), nn.Linear(widths[-1] * cell_count, 128), nn.SiLU())
        self.tell = nn.Linear(128, order**2)
        with torch.no_grad():  # to begin with, nearly the same light from everywhere, whatever is seen
            self.tell.weight.mul_(0.1)
            self.tell.bias.zero_()
            self.tell.bias[0] = math.sqrt(4 * math.pi)

    def forward(self, shading: torch.Tensor) -> torch.Tensor:
        """Estimate the light of shading and coverage [batch, height, width, 4]: coefficients [batch, order², 3]."""
        channels = shading[..., :3].permute(0, 3, 1, 2)
        coverage = shading[..., 3][:, None].expand_as(channels)
        exposure = channels.mean(dim=(2, 3), keepdim=True) / coverage.mean(dim=(2, 3), keepdim=True)
        tones = torch.log1p(4 * channels / exposure)
        told = self.tell(self.look(torch.stack([tones, coverage], dim=2).flatten(0, 1)))
        return (told.unflatten(0, channels.shape[:2]) * exposure[..., 0]).transpose(1, 2)


class Lesson(NamedTuple):
    """A scene to learn from.

    Args:
        number: The scene's own, whichever process has it.
        scene: The scene.
        image: Ray traced, [height, width, 4].
        shading: The image over the reflectance that it shows, and coverage: [height, width, 4].
        to_world: Turn of coefficients from the frame of whoever looks, [coefficient, coefficient].
    """

    number: int
    scene: ws.Scene
    image: torch.Tensor
    shading: torch.Tensor
    to_world: torch.Tensor


def prepare(number: int, scene: ws.Scene, device: torch.device, image: np.ndarray | None = None) -> Lesson:
    """Divide the reflectance out of an image, by default ray traced here: it shows in even light without shadows."""
    if image is None:
        image = ws.render(dataclasses.replace(scene, visibility=RAY_TRACED), device=str(device))
    even = dataclasses.replace(scene, visibility=RENDERERS["none"], light=EVEN_LIGHT)
    reflectance = ws.render(even, device=str(device))[..., :3]
    shading = np.where(reflectance > 0, image[..., :3] / np.maximum(reflectance, 1e-3), 0)
    right, up = scene.camera.rotation[0], np.array([0.0, 1.0, 0.0])
    to_world = sh.harmonic_rotation(ORDER, np.stack([right, up, np.cross(right, up)], axis=1))
    arrays = (image, np.concatenate([shading, image[..., 3:]], axis=-1), to_world.astype(np.float32))
    return Lesson(number, scene, *(torch.from_numpy(array).to(device) for array in arrays))


# ------------------------------------------------------------------------------------------------- processes


class Team(NamedTuple):
    """The processes that train together; each has a device of its own, and one alone is a team, too."""

    rank: int
    count: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes."""
        return self.rank == 0

    def wait(self) -> None:
        """Go on when all processes are here."""
        if self.count > 1:
            distributed.barrier()


def assemble(device: str) -> Team:
    """Meet the processes that torchrun started, if it did."""
    torch.set_num_threads(1)
    local, count = int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    own = torch.device(device if device == "cpu" or ":" in device else f"{device}:{local}")
    if own.type == "cuda":
        torch.cuda.set_device(own)
    if count > 1:
        distributed.init_process_group("nccl" if own.type == "cuda" else "gloo")
        return Team(distributed.get_rank(), distributed.get_world_size(), own)
    return Team(0, 1, own)


def part(team: Team) -> None:
    """Leave together, so that nobody waits for one who is gone."""
    if team.count > 1:
        team.wait()
        distributed.destroy_process_group()


def own_share(scenes: RandomScenes, team: Team, shards: Sequence[Path] = ()) -> list[Lesson]:
    """Prepare the scenes that fall to this process: every team.count-th; their images may be in shards."""
    numbers = list(DistributedSampler(scenes, team.count, team.rank, shuffle=False))
    samples = (sample for path in shards for sample in read_shard(path))
    images = {int(sample.key): sample.color for sample in samples if int(sample.key) in numbers}
    if shards and (missing := [number for number in numbers if number not in images]):
        raise ValueError(f"shards: got none with image {missing[0]}, expected all of the split")
    bar = tqdm(numbers, desc="preparing images", unit="scene", disable=not team.is_first or None)
    return [prepare(number, scenes[number], team.device, images.get(number)) for number in bar]


def of_recipe(path: Path) -> tuple[RandomScenes, str]:
    """The scenes of the first split of a recipe, and what that is called."""
    recipe = load_recipe(path)
    split = next(iter(recipe.splits))
    data_set = DataSet(recipe)
    return dataclasses.replace(data_set.scenes(split), count=len(data_set.numbers(split))), split


# ------------------------------------------------------------------------------------------------- training


class Course(NamedTuple):
    """What a training run is, but for the scenes: a checkpoint goes on only with what it was begun with."""

    through: str
    epochs: int
    batch: int = 16
    learning_rate: float = 2e-3
    seed: int = 0


def train(lessons: Sequence[Lesson], course: Course, team: Team, path: Path, *, resume: bool = False) -> LightEstimator:
    """Teach a network through the renderer named by the course.

    Args:
        lessons: This process's share of the scenes.
        course: How to train.
        team: The processes that train together.
        path: The checkpoint, written after each epoch.
        resume: Go on from the checkpoint, if there is one.

    Returns:
        The network; the same in all processes.
    """
    height, width, _ = lessons[0].image.shape
    torch.manual_seed(course.seed)
    network = LightEstimator((height, width)).to(team.device)
    optimizer = torch.optim.Adam(network.parameters(), lr=course.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, course.epochs)
    parts = {"network": network, "optimizer": optimizer, "schedule": schedule}
    about = course._asdict() | {"scenes": team.count * len(lessons), "size": [height, width], "processes": team.count}
    first_epoch = restore(path, parts, about) if resume else 0
    team.wait()  # nobody writes while another still reads
    pupil = nn.parallel.DistributedDataParallel(network) if team.count > 1 else network

    renderers = {lesson.number: teacher(lesson.scene, course.through, team.device) for lesson in lessons}
    progress = {"desc": f"through {course.through}", "disable": not team.is_first or None}
    for epoch in (bar := tqdm(range(first_epoch, course.epochs), **progress)):
        losses = []
        for batch, mirrored in batches(lessons, epoch, course, team):
            optimizer.zero_grad()
            loss = loss_of(pupil, batch, mirrored, renderers)
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        schedule.step()
        bar.set_postfix(loss=f"{np.mean(losses):.4f}")
        if team.is_first:
            states = {name: part.state_dict() for name, part in parts.items()}
            checkpoint.save(path, {"epoch": epoch + 1, "about": about, "loss": float(np.mean(losses)), **states})
    return network


def loss_of(
    network: nn.Module, batch: Sequence[Lesson], mirrored: torch.Tensor, renderers: dict[int, TorchRenderer]
) -> torch.Tensor:
    """Draw the scenes of a batch in the light that a network tells, and compare with what it saw.

    Where it looks through a mirror, bool of shape [batch], what it tells is mirrored back.
    """
    shading = torch.stack([lesson.shading for lesson in batch])
    told = network(torch.where(mirrored[:, None, None, None], shading.flip(2), shading))
    lights = torch.where(mirrored[:, None, None], MIRROR.to(told) @ told, told)
    lights = torch.stack([lesson.to_world for lesson in batch]) @ lights
    drawn = torch.stack([renderers[lesson.number](light) for lesson, light in zip(batch, lights, strict=True)])
    return mean_difference(drawn, torch.stack([lesson.image for lesson in batch]))


def teacher(scene: ws.Scene, through: str, device: torch.device) -> TorchRenderer:
    """The renderer that a network learns through: while geometry does not move, an image is a matrix product."""
    scene = dataclasses.replace(scene, visibility=RENDERERS[through])
    return TorchRenderer(scene, device=device, basis=ws.HarmonicBasis(ORDER))


def mean_difference(drawn: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of colors, each image taken at its own exposure."""
    drawn, images, coverage = drawn[..., :3], images[..., :3], images[..., 3:]
    exposure = images.mean(dim=(1, 2, 3), keepdim=True) / coverage.mean(dim=(1, 2, 3), keepdim=True)
    return nn.functional.mse_loss(drawn / exposure, images / exposure)


def batches(
    lessons: Sequence[Lesson], epoch: int, course: Course, team: Team
) -> Iterator[tuple[list[Lesson], torch.Tensor]]:
    """Shuffle the lessons of an epoch, and look at half of them in a mirror.

    What is drawn depends on seed, epoch and scene alone, so there is no state of a generator to keep.

    Yields:
        Lessons, and which of them are mirrored, bool of shape [batch].
    """
    generator = torch.Generator().manual_seed(course.seed * 1_000_003 + epoch)
    draws = torch.rand(team.count * len(lessons), 2, generator=generator)
    draws = draws[[lesson.number for lesson in lessons]]
    for chosen in draws[:, 0].argsort().split(max(course.batch // team.count, 1)):
        yield [lessons[k] for k in chosen.tolist()], (draws[chosen, 1] < 0.5).to(team.device)


def restore(path: Path, parts: dict[str, object], about: dict[str, object]) -> int:
    """Take up the state of a checkpoint, if there is one, and return the number of epochs that are done."""
    state = checkpoint.load(path)
    if state is None:
        return 0
    differing = {name for name in about if state["about"].get(name) != about[name]}
    if differing:
        was, wanted = ({name: settings.get(name) for name in sorted(differing)} for settings in (state["about"], about))
        raise ValueError(f"{path}: was begun with {was}, expected {wanted}; train anew without --resume")
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return state["epoch"]


# ------------------------------------------------------------------------------------------------- judgment


@torch.no_grad()
def estimate(network: LightEstimator, lessons: Sequence[Lesson]) -> torch.Tensor:
    """Estimate the light of scenes in the world, [scene, order², 3]."""
    told = network(torch.stack([lesson.shading for lesson in lessons]))
    return torch.stack([lesson.to_world for lesson in lessons]) @ told


def light_errors(lights: torch.Tensor, truths: torch.Tensor) -> np.ndarray:
    """Relative L2 errors of lights [scene, order², 3] over the sky; what comes from below a ground is never seen."""
    directions = sh.equirectangular_directions(32)[:16].reshape(-1, 3)
    weights = np.repeat(np.sqrt(sh.pixel_solid_angles(32)[:16]), 64)[:, None, None]
    functions = weights * sh.evaluate(ORDER, directions)[:, :, None]
    difference, truth = (
        np.linalg.norm((functions * values[:, None]).sum(axis=2), axis=(1, 2))
        for values in ((lights - truths).cpu().numpy(), truths.cpu().numpy())
    )
    return difference / truth


class Relighting:
    """A bunny on a ground, which no network has seen, in any light.

    Args:
        size: Width and height of the images [pixels].
        device: Where to render.
    """

    def __init__(self, size: int, device: torch.device):
        scene = on_ground(shipped_mesh("bunny"), ws.EnvironmentMap.constant(), ground=ws.Body(ws.plane(6.0, 1)))
        camera = scene.camera.resized(size / scene.camera.width)
        scene = dataclasses.replace(scene, camera=camera, visibility=RAY_TRACED, supersampling=1)
        self.renderer = TorchRenderer(scene, device=device, basis=ws.HarmonicBasis(ORDER))

    def in_map(self, light: ws.EnvironmentMap) -> np.ndarray:
        """The image in known light, [height, width, 4]."""
        return self.renderer(light).cpu().numpy()

    def in_harmonics(self, lights: torch.Tensor) -> np.ndarray:
        """Images in lights [light, order², 3], shape [light, height, width, 4]."""
        return self.renderer(lights).cpu().numpy()


def judge(estimates: dict[str, torch.Tensor], lessons: Sequence[Lesson], relighting: Relighting) -> None:
    """Print how far estimates of the light of scenes, [scene, order², 3], are off, and the bunny in them."""
    maps = [lesson.scene.light for lesson in lessons]
    truths = torch.from_numpy(np.stack([light.sh(ORDER) for light in maps])).to(relighting.renderer.device)
    wanted = [relighting.in_map(light) for light in tqdm(maps, desc="ray tracing the bunny", disable=None)]

    def bunny_errors(lights: torch.Tensor) -> np.ndarray:
        return np.array(list(map(image_error, relighting.in_harmonics(lights), wanted)))

    errors = {through: bunny_errors(lights) for through, lights in estimates.items()}
    print(f"{f'mean relative error over {len(lessons)} held-out scenes':44}{'light':>8}{'bunny relit':>14}")
    for through, lights in estimates.items():
        light_error = light_errors(lights, truths).mean()
        print(f"  learned {LABELS[through]:34}{light_error:>8.1%}{errors[through].mean():>14.1%}")
    print(f"  {f'the true light, {ORDER} bands of it':42}{'':>8}{bunny_errors(truths).mean():>14.1%}")
    if len(errors) == 2:
        share = np.mean(errors["directional"] < errors["none"])
        print(f"what was learned with shadows relights the bunny better in {share:.0%} of the scenes")


def draw_picture(estimates: dict[str, torch.Tensor], lessons: Sequence[Lesson], path: Path, size: int) -> None:
    """Draw what the network sees and the bunny in each estimate and in truth, a row for each of a few scenes."""
    relighting = Relighting(size, lessons[0].image.device)
    rows = []
    for number, lesson in enumerate(lessons):
        truth = relighting.in_map(lesson.scene.light)
        row = [(enlarged(lesson.image.cpu().numpy(), size), "what the networks see\nof a held-out scene")]
        for through, lights in estimates.items():
            image = relighting.in_harmonics(lights[number])
            row.append((image, f"learned {LABELS[through]}\n{image_error(image, truth):.1%} error"))
        rows.append([*row, (truth, "true light\nray traced")])
    contact_sheet(rows).save(path)


def enlarged(image: np.ndarray, size: int) -> np.ndarray:
    """An image [height, width, 4] drawn in squares, shape [size, size, 4]."""
    rows, columns = (np.arange(size) * count // size for count in image.shape[:2])
    return image[rows][:, columns]


# ------------------------------------------------------------------------------------------------- the whole


def main(
    output: Path,
    *,
    scenes: int,
    epochs: int,
    held_out: int,
    size: int,
    seed: int = 0,
    through: Sequence[str] = tuple(RENDERERS),
    device: str = "cpu",
    resume: bool = False,
    bodies: Sequence[ws.Body] | None = None,
    picture_size: int = 192,
    recipe: Path | None = None,
    shards: Path | None = None,
) -> None:
    ws.quiet()
    start = time.perf_counter()
    team = assemble(device)
    output.mkdir(parents=True, exist_ok=True)
    if recipe is None:
        bodies = primitives() if bodies is None else bodies
        split, random = "", RandomScenes(2 * seed, scenes, (size, size), bodies, supersampling=1)
    else:
        random, split = of_recipe(recipe)
    if "directional" in through:
        fit_blockers(random.bodies, team)
    lessons = own_share(random, team, sorted(shards.glob(f"{split}-*.tar")) if shards else ())
    networks = {}
    for name in through:
        course = Course(name, epochs, seed=seed)
        networks[name] = train(lessons, course, team, output / f"light_estimator_{name}.checkpoint", resume=resume)
    if team.is_first:
        others = dataclasses.replace(random, seed=random.seed + 1, count=held_out)
        exam = [prepare(number, scene, team.device) for number, scene in enumerate(others)]
        estimates = {name: estimate(network, exam) for name, network in networks.items()}
        judge(estimates, exam, Relighting(96, team.device))
        draw_picture(estimates, exam[:PICTURED], output / "light_estimator.png", picture_size)
        print(f"wrote {output / 'light_estimator.png'}; {time.perf_counter() - start:.0f} s in all")
    part(team)


def fit_blockers(bodies: Sequence[ws.Body], team: Team) -> None:
    """Fit the spheres of bodies once, in the first process; the others find them in the cache."""
    if team.is_first:
        for body in bodies:
            if not isinstance(body.blockers, ws.Spheres):
                ws.fit_spheres(body.mesh, body.blockers, device=str(team.device))
    team.wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for checkpoints and the picture")
    parser.add_argument("--scenes", type=int, default=1024, help="number of scenes to learn from")
    parser.add_argument("--epochs", type=int, default=40, help="how often each is looked at")
    parser.add_argument("--held-out", type=int, default=48, help="number of scenes to judge by")
    parser.add_argument("--size", type=int, default=32, help="width and height of the images [pixels], a multiple of 8")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes and of the training")
    parser.add_argument("--through", choices=[*RENDERERS, "both"], default="both", help="renderer to learn through")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda: each process takes a GPU of its own")
    parser.add_argument("--recipe", type=Path, help="whose scenes are taken, in place of --scenes and --size")
    parser.add_argument("--shards", type=Path, help="folder of the recipe's shards, for their images")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoints in the output folder")
    options = vars(parser.parse_args())
    if options["shards"] and not options["recipe"]:
        parser.error("--shards: got it without --recipe, expected the recipe of the shards, which has their scenes")
    name = options.pop("through")
    main(options.pop("output"), through=list(RENDERERS) if name == "both" else [name], **options)
