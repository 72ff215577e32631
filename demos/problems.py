"""The inverse problems of the paper on a body and a ground: the true scene, where a fit starts, and how it is measured.

Targets are ray traced with sixteen samples a pixel, sampled otherwise than what a fit traces for itself, so that no fit
is given its own errors. With ``bounces`` they are path traced; ``Case.by`` says how often light bounces in the fit.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import warpshadow as ws
from demos.scenes import on_ground
from warpshadow import inverse

SIZE = 128  # pixels across and down
DIRECT = ws.Visibility(method="none")


@dataclass(frozen=True, eq=False)
class Case:
    """A problem whose answer is known.

    Args:
        problem: What a fit is given.
        truth: The scene that made the target.
        stages: How the fit goes about it.
        measure: Figures of a scene that a fit found, or of the start.
        shown: The scene of which a picture shows best what was found: by default itself.
    """

    problem: inverse.Problem
    truth: ws.Scene
    stages: tuple[inverse.Stage, ...]
    measure: Callable[[ws.Scene], dict[str, float]]
    shown: Callable[[ws.Scene], ws.Scene] = staticmethod(lambda scene: scene)

    def by(self, visibility: ws.Visibility | None, bounces: int = 0) -> inverse.Problem:
        """The problem, solved by another method wherever it is; None for rays where nothing moves.

        Args:
            visibility: The method.
            bounces: How often light bounces in the fit, whatever the targets have.
        """
        own = self.problem.scene
        if visibility is None and bounces == own.bounces:
            return self.problem
        scene = dataclasses.replace(own, visibility=visibility or own.visibility, bounces=bounces)
        return dataclasses.replace(self.problem, scene=scene, still=None if visibility else self.problem.still)


def ray_traced(scene: ws.Scene, samples: int = 2048) -> np.ndarray:
    """The image of a scene as the mesh itself shadows it."""
    visibility = ws.Visibility(method="ray-traced", samples=samples)
    return ws.render(dataclasses.replace(scene, visibility=visibility, supersampling=4))


def body_on_ground(
    mesh: ws.Mesh, sky: ws.EnvironmentMap, size: int = SIZE, spheres: int = 64, bounces: int = 0
) -> ws.Scene:
    """A body of 2 units on a ground of 6, an image of ``size`` × ``size`` pixels, and as many bounces of light."""
    scene = on_ground(mesh, sky, blockers=spheres)
    return dataclasses.replace(scene, camera=scene.camera.resized(size / scene.camera.width), bounces=bounces)


def unshadowed(scene: ws.Scene) -> ws.Scene:
    """A scene of which no more than what the camera sees is asked."""
    return dataclasses.replace(scene, visibility=DIRECT, bounces=0)


def changed(scene: ws.Scene, number: int, **changes: object) -> ws.Scene:
    """A scene with fields of a body replaced."""
    bodies = list(scene.bodies)
    bodies[number] = dataclasses.replace(bodies[number], **changes)
    return dataclasses.replace(scene, bodies=tuple(bodies))


# ------------------------------------------------------------------------------------------------ texture


def pattern(seed: int, size: int = 128) -> np.ndarray:
    """A texture of colored tiles under a slow change of brightness, linear RGB [size, size, 3]."""
    rng = np.random.default_rng(seed)
    tiles = rng.uniform(0.15, 0.85, (10, 10, 3))
    row, column = np.indices((size, size))
    colors = tiles[row * 10 // size, column * 10 // size]
    wave = 1 + 0.15 * np.sin(2 * np.pi * (row / size * rng.uniform(1, 3) + rng.random()))
    return np.clip(colors * wave[..., None], 0, 1).astype(np.float32)


def texture_case(
    mesh: ws.Mesh, sky: ws.EnvironmentMap, seed: int, *, is_hidden: bool = False, bounces: int = 0
) -> Case:
    """The texture of the ground, in the shadow of a body that the camera may not see; light and shapes are known.

    The image has 256 × 256 pixels, so that they are not much larger than texels.
    """
    truth = changed(body_on_ground(mesh, sky, size=256, bounces=bounces), 1, texture=pattern(seed))
    if is_hidden:
        camera = ws.Camera.look_at((1.9, 4.0, 0.2), (1.9, 0.0, 0.2), up=(0, 0, -1), fov_y=24)  # beside the body
        truth = dataclasses.replace(truth, camera=camera)
    start = changed(truth, 1, texture=np.full_like(truth.bodies[1].texture, 0.5))
    problem = inverse.Problem(start, inverse.Target(ray_traced(truth)), inverse.Texture(1))
    seen = ws.Renderer(unshadowed(truth)).seen_texels(1) >= 4  # samples: a pixel

    def measure(scene: ws.Scene) -> dict[str, float]:
        difference = (scene.bodies[1].texture - truth.bodies[1].texture)[seen]
        return {"texture MSE": float(np.mean(difference**2))}

    def evenly_lit(scene: ws.Scene) -> ws.Scene:
        return dataclasses.replace(scene, light=ws.EnvironmentMap.constant(1.0))

    return Case(problem, truth, (inverse.Stage(200, learning_rate=0.05),), measure, evenly_lit)


# ------------------------------------------------------------------------------------------------ light


def light_case(
    mesh: ws.Mesh, sky: ws.EnvironmentMap, others: list[ws.Mesh], *, light: inverse.Light | None = None, **options: int
) -> Case:
    """The light on a body and its ground, judged by the images of other bodies in it."""
    truth = body_on_ground(mesh, sky, **options)
    start = dataclasses.replace(truth, light=ws.EnvironmentMap.constant(0.5))
    problem = inverse.Problem(start, inverse.Target(ray_traced(truth)), light or inverse.Light())
    relit = [body_on_ground(other, sky, **options) for other in others]
    images = [ray_traced(scene) for scene in relit]

    def measure(scene: ws.Scene) -> dict[str, float]:
        errors = []
        for other, image in zip(relit, images, strict=True):
            covered = image[..., 3] == 1
            found = ray_traced(dataclasses.replace(other, light=scene.light))
            unit = np.mean(image[covered, :3] ** 2)
            errors.append(np.mean((found - image)[covered, :3] ** 2) / unit)
        return {"relighting MSE": float(np.mean(errors))}

    def on_another(scene: ws.Scene) -> ws.Scene:
        return dataclasses.replace(relit[0], light=scene.light)

    is_map = problem.free[0].directions is not None
    stage = inverse.Stage(500, learning_rate=0.15) if is_map else inverse.Stage(300, learning_rate=0.05)
    return Case(problem, truth, (stage,), measure, on_another)


# ------------------------------------------------------------------------------------------------ pose


def distance_error(found: ws.Body, true: ws.Body) -> float:
    """MDE: mean distance of vertices to where they belong, in percent of the true bounding box's diagonal."""
    wanted = true.world_mesh()
    low, high = wanted.bounds
    used = np.unique(wanted.faces)
    gaps = np.linalg.norm((found.world_mesh().positions - wanted.positions)[used], axis=1)
    return float(100 * gaps.mean() / np.linalg.norm(high - low))


def pose_errors(found: ws.Body, true: ws.Body) -> dict[str, float]:
    """MDE [%], RE, the angle between rotations [rad], and TE, the squared distance between translations."""
    turn = found.rotation_matrix().T @ true.rotation_matrix()
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    offset = np.asarray(found.translation) - np.asarray(true.translation)
    return {"pose MDE": distance_error(found, true), "RE": float(angle), "TE": float(offset @ offset)}


def displaced(
    body: ws.Body,
    rng: np.random.Generator,
    *,
    degrees: tuple[float, float] = (10, 40),
    part: tuple[float, float] = (0.05, 0.25),
) -> ws.Body:
    """A body turned by some degrees about an axis through its middle, and shifted by a part of its diagonal."""
    from scipy.spatial.transform import Rotation

    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    turn = Rotation.from_rotvec(np.radians(rng.uniform(*degrees)) * axis)
    low, high = body.world_mesh().bounds
    shift = rng.uniform(*part) * np.linalg.norm(high - low) * direction
    there = turned(body, turn)
    return dataclasses.replace(there, translation=there.translation + shift)


def turned(body: ws.Body, turn: Any) -> ws.Body:
    """A body turned about the middle of its bounds, by a rotation of SciPy."""
    from scipy.spatial.transform import Rotation

    middle = np.mean(body.world_mesh().bounds, axis=0)
    rotation = turn * Rotation.from_matrix(body.rotation_matrix())
    translation = turn.apply(body.translation - middle) + middle
    return dataclasses.replace(body, rotation=rotation.as_rotvec(degrees=True), translation=translation)


def pose_case(
    mesh: ws.Mesh, sky: ws.EnvironmentMap, seed: int, *, is_shadow_alone: bool = False, **options: int
) -> Case:
    """Six numbers: where a body is, from one image of it and its shadow, or of the ground alone."""
    truth = body_on_ground(mesh, sky, **options)
    start = changed(truth, 0, **placement(displaced(truth.bodies[0], np.random.default_rng(seed))))
    target = inverse.Target(ray_traced(truth), ground_alone(truth) if is_shadow_alone else None)
    problem = inverse.Problem(start, target, inverse.Pose(0), inverse.Loss("huber"))
    return Case(
        problem, truth, inverse.pose_stages(problem), lambda scene: pose_errors(scene.bodies[0], truth.bodies[0])
    )


def placement(body: ws.Body) -> dict[str, object]:
    """Where a body is."""
    return {"rotation": body.rotation, "translation": body.translation, "scale": body.scale}


def ground_alone(scene: ws.Scene) -> np.ndarray:
    """Mask of the pixels that see nothing but the ground, the second body."""
    ids = ws.Renderer(dataclasses.replace(unshadowed(scene), supersampling=4)).body_ids()[0]
    height, width = scene.camera.height, scene.camera.width
    return (ids.reshape(height, 4, width, 4) == 1).all(axis=(1, 3)).astype(np.float32)


# ------------------------------------------------------------------------------------------------ deformation


def bent(mesh: ws.Mesh, seed: int) -> ws.Mesh:
    """A mesh that is bent sideways, twisted and stretched along its height, by a formula that no graph follows."""
    rng = np.random.default_rng(seed)
    low, high = (np.asarray(corner, np.float64) for corner in mesh.bounds)
    size = high - low
    x, y, z = (mesh.positions - low).astype(np.float64).T
    x, z = x - size[0] / 2, z - size[2] / 2
    height = y / size[1]
    angle = np.radians(rng.choice([-1, 1]) * rng.uniform(20, 40)) * height  # twist
    x, z = np.cos(angle) * x + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * x
    towards = rng.uniform(0, 2 * np.pi)
    lean = rng.uniform(0.15, 0.3) * size[1] * height**2  # bend
    y = y * (1 + rng.uniform(-0.15, 0.15) * height)
    positions = np.stack([x + lean * np.cos(towards), y, z + lean * np.sin(towards)], axis=1)
    positions += low + np.array([size[0] / 2, 0, size[2] / 2])
    return dataclasses.replace(mesh, positions=positions)


def deformation_case(
    mesh: ws.Mesh, sky: ws.EnvironmentMap, seed: int, *, is_shadow_alone: bool = False, **options: int
) -> Case:
    """The shape of a body that was bent, from one image of it and its shadow, or of the ground alone."""
    start = body_on_ground(mesh, sky, **options)
    truth = changed(start, 0, mesh=bent(mesh, seed))
    target = inverse.Target(ray_traced(truth), ground_alone(truth) if is_shadow_alone else None)
    problem = inverse.Problem(start, target, inverse.Deformation(0), inverse.Loss("huber"))
    return Case(
        problem,
        truth,
        inverse.deformation_stages(problem),
        lambda scene: {"geometry MDE": distance_error(scene.bodies[0], truth.bodies[0])},
    )
