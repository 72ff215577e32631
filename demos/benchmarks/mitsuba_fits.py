"""The problems of the paper's tables by differentiable ray tracing, in Mitsuba 3: a column of paper_tables.py.

    python demos/benchmarks/mitsuba_fits.py [--iterations N] [--problems texture light pose geometry]

It stands where the paper has Redner: single bounce, 64 samples a pixel, one descent by the same optimizer, loss and
parameters as our own fit, at the full size of the image. Texture and light are differentiated through the paths; poses
and shapes by projective sampling of silhouettes and of shadows' edges (Zhang et al. 2023). By itself the demo renders
the true scene both ways and prints how far apart the images are; then it fits what ``--problems`` names.

Mitsuba is an optional package (pip install mitsuba); it compiles by LLVM, of which version 1.5 of Dr.Jit needs 17 or
newer. Where it does not find that, DRJIT_LIBLLVM_PATH names the library.
"""

import argparse
import math
import statistics
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import problems
from demos.mitsuba_gloss import color_of, surface
from demos.problems import Case
from demos.scenes import image_error, shipped_mesh
from warpshadow import inverse
from warpshadow.inverse.target import stack_targets
from warpshadow.scene.material import GLOSS_ARGUMENTS

SAMPLES = 64  # a pixel, for the image and again for its gradient
MIN_LLVM = (17,)  # before, x86 has no minimum and maximum that pass NaN on
LIGHT_HEIGHT = 64  # rows of the map that stands for light in spherical harmonics

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Method:
    """How a problem is solved.

    Args:
        integrator: Of Mitsuba.
        stage: Of the descent.
    """

    integrator: dict[str, Any]
    stage: inverse.Stage


# samples that are guided to where shadows' edges are vary less, but finding the way there takes ten times as long
_PROJECTIVE = {"type": "direct_projective", "guiding": "none"}
METHODS: dict[type[inverse.Free], Method] = {
    inverse.Texture: Method({"type": "direct"}, inverse.Stage(100, learning_rate=0.05)),
    # the light's map has negative values, in proportion to which no emitter can be sampled
    inverse.Light: Method({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}, inverse.Stage(100, 0.05)),
    inverse.Pose: Method(_PROJECTIVE, inverse.Stage(60, learning_rate=0.05)),
    inverse.Deformation: Method(_PROJECTIVE, inverse.Stage(60, learning_rate=0.05)),
}


def fit_by_mitsuba(case: Case, iterations: int | None = None) -> tuple[ws.Scene, float, int, str]:
    """Solve a problem by differentiable ray tracing.

    Args:
        case: The problem, with one target and one thing that is free.
        iterations: At most so many.

    Returns:
        The scene that was found, the median time of an iteration [s], their number, and why it ended.

    Raises:
        ValueError: for a problem that Mitsuba is not set up for.
        ArithmeticError: where the loss became non-finite.
    """
    problem, free, method = case.problem, *_method(case)
    count = min(method.stage.iterations, iterations or method.stage.iterations)
    stage = inverse.Stage(count, method.stage.learning_rate)
    context = problem.context(torch.device("cpu"))
    tracer = RayTracer(context.scene, method.integrator)
    targets, weights = stack_targets(problem.targets, 1.0, context.device)
    values = {key: tensor.requires_grad_() for key, tensor in free.start(context).items()}
    optimizer = inverse.short_adam(list(values.values()), lr=stage.learning_rate)
    durations = []
    for iteration in range(count):
        start = time.perf_counter()
        optimizer.param_groups[0]["lr"] = stage.rate(iteration)
        optimizer.zero_grad()
        image = tracer.image(placed(free, values, context), seed=iteration)
        loss = problem.loss(image[None], targets[..., :3], weights, context.unit)  # projective sampling has no coverage
        energy = free.energy(values, context)
        loss = loss if energy is None else loss + energy
        loss.backward()
        if not all(torch.isfinite(tensor).all() for tensor in (loss, *(value.grad for value in values.values()))):
            raise ArithmeticError(f"Mitsuba's loss or gradient became NaN or Inf in iteration {iteration + 1}")
        optimizer.step()
        with torch.no_grad():
            free.project(values)
        durations.append(time.perf_counter() - start)
    found = {key: tensor.detach() for key, tensor in values.items()}
    return problem.fitted_scene({free.name: found}, context).scene, statistics.median(durations), count, "finished"


def _method(case: Case) -> tuple[inverse.Free, Method]:
    if len(case.problem.free) > 1 or len(case.problem.targets) > 1:
        raise ValueError("Mitsuba: got several targets or free parameters, expected one of each")
    (free,) = case.problem.free
    if type(free) not in METHODS:
        raise ValueError(
            f"Mitsuba: got a free {type(free).__name__}, expected {', '.join(k.__name__ for k in METHODS)}"
        )
    return free, METHODS[type(free)]


# ------------------------------------------------------------------------------------------------ what is free


def placed(free: inverse.Free, values: Tensors, context: Any) -> Tensors:
    """What a free parameter sets in Mitsuba's scene, by the names there. Differentiable: values."""
    if isinstance(free, inverse.Texture):
        return {f"body{free.body}.bsdf.brdf_0.reflectance.data": values["texels"]}
    if isinstance(free, inverse.Light):
        functions = free.basis.functions(map_directions(LIGHT_HEIGHT).reshape(-1, 3))
        radiance = context.tensor(functions) @ free.coefficients(values, context)
        return {"light.data": radiance.reshape(LIGHT_HEIGHT, -1, 3)}
    points = _moved(free, values, context)
    normals = vertex_normals(points, context.scene.bodies[free.body].mesh.faces)
    return {f"body{free.body}.vertex_positions": points, f"body{free.body}.vertex_normals": normals}


def _moved(free: inverse.Pose | inverse.Deformation, values: Tensors, context: Any) -> torch.Tensor:
    """Vertices in world space, [vertex, 3]. Differentiable: values."""
    body = context.scene.bodies[free.body]
    if isinstance(free, inverse.Pose):
        points = context.tensor(body.mesh.positions)
        rotation, translation, scale = free._posed(values, context)
    else:
        points = free._deformed(values, context)[0][0]
        rotation, translation = context.tensor(body.rotation_matrix()), context.tensor(body.translation)
        scale = body.scale
    return scale * points @ rotation.T + translation


def vertex_normals(points: torch.Tensor, faces: np.ndarray) -> torch.Tensor:
    """Unit normals, weighted by areas as ours are, [vertex, 3]; Mitsuba's weigh angles. Differentiable: points."""
    corners = torch.from_numpy(faces.astype(np.int64))
    a, b, c = points[corners].unbind(dim=1)
    of_faces = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(points).index_add(0, corners.ravel(), of_faces.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(sums, dim=1)


# ------------------------------------------------------------------------------------------------ Mitsuba


class RayTracer:
    """A scene in Mitsuba, whose images are functions of torch tensors.

    Args:
        scene: The scene; bodies have one color or a texture.
        integrator: Of Mitsuba.
        gloss: Surface of bodies that shine, as for :func:`demos.mitsuba_gloss.surface`.
    """

    def __init__(self, scene: ws.Scene, integrator: Mapping[str, Any], gloss: str = "gltf"):
        import mitsuba as mi

        _check_compiler()
        mi.set_variant("llvm_ad_rgb")
        mi.set_log_level(mi.LogLevel.Error)  # bodies that leave the image have wrong gradients: none does
        bodies = {f"body{number}": _mesh(body, number, gloss) for number, body in enumerate(scene.bodies)}
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {**integrator, "hide_emitters": not any(body.is_emitter for body in scene.bodies)},
                "sensor": _sensor(scene.camera),
                "light": {"type": "envmap", "bitmap": mi.Bitmap(map_nodes(scene.light))},
                **bodies,
            }
        )
        self.parameters = mi.traverse(self.scene)

    def image(self, tensors: Tensors, *, seed: int, samples: int = SAMPLES) -> torch.Tensor:
        """The image in linear RGB, [height, width, 3]. Differentiable: tensors.

        Args:
            tensors: Parameters of Mitsuba's scene, by name.
            seed: Of the samples; those of the gradient are others, so that it has no bias.
            samples: A pixel.
        """
        import drjit as dr
        import mitsuba as mi

        @dr.wrap(source="torch", target="drjit")
        def render(arrays: list) -> Any:
            for name, array in zip(tensors, arrays, strict=True):
                is_tensor = isinstance(self.parameters[name], mi.TensorXf)
                self.parameters[name] = mi.TensorXf(array) if is_tensor else array.array
            self.parameters.update()
            return mi.render(self.scene, self.parameters, spp=samples, seed=2 * seed, seed_grad=2 * seed + 1)

        return render(list(tensors.values()))


def _check_compiler() -> None:
    """Raise ValueError where Dr.Jit would find no LLVM, or end the process in the midst of compiling."""
    import drjit as dr

    version = dr.detail.llvm_version() if dr.has_backend(dr.JitBackend.LLVM) else ()
    if version < MIN_LLVM:
        got = ".".join(map(str, version)) or "none"
        raise ValueError(f"Mitsuba: got LLVM {got}, expected {MIN_LLVM[0]} or newer, named by DRJIT_LIBLLVM_PATH")


def _mesh(body: ws.Body, number: int, gloss: str) -> Any:
    """A body in world space; one with a texture has vertices of its own for each face, as its uvs may."""
    import mitsuba as mi

    mesh = body.world_mesh()
    positions, faces = mesh.positions, mesh.faces
    normals = vertex_normals(torch.tensor(positions), mesh.surface.faces).numpy()
    properties = mi.Properties()
    has_texture = any(np.ndim(getattr(body, name)) > 1 for name in GLOSS_ARGUMENTS) or body.texture is not None
    side = surface(body, gloss) if body.is_glossy else {"type": "diffuse", "reflectance": _reflectance(body)}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "side": side})
    if body.emission is not None:
        radiance = {"type": "rgb", "value": body.emission.tolist()}
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    if has_texture:
        positions, normals = positions[faces.ravel()], normals[faces.ravel()]
        faces = np.arange(len(positions)).reshape(-1, 3)
    shape = mi.Mesh(
        f"body{number}",
        len(positions),
        len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=has_texture,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters["vertex_positions"] = positions.ravel()
    parameters["vertex_normals"] = normals.ravel()
    if has_texture:
        uvs = mesh.uvs[mesh.uv_faces.ravel()]
        parameters["vertex_texcoords"] = np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1).ravel()  # v runs down there
    parameters.update()
    return shape


def _reflectance(body: ws.Body) -> dict[str, Any]:
    """A color, or a texture."""
    is_color = body.texture is None and body.albedo.ndim == 1
    return {"type": "rgb", "value": body.albedo.tolist()} if is_color else color_of(body)


def _sensor(camera: ws.Camera) -> dict[str, Any]:
    """A camera with square pixels that looks through the middle of its image."""
    import mitsuba as mi

    axes = np.eye(4)
    axes[:3, :3] = camera.rotation.T @ np.diag([-1, -1, 1])  # x left, y up, z forward
    axes[:3, 3] = camera.eye
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(axes),
        "fov_axis": "y",
        "fov": math.degrees(2 * math.atan(0.5 * camera.height / camera.intrinsics[1, 1])),
        "near_clip": camera.near,
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    }


def map_nodes(light: ws.EnvironmentMap | np.ndarray) -> np.ndarray:
    """Light as Mitsuba's map, whose first and last rows are the poles, [height, 2 height, 3]."""
    if not isinstance(light, ws.EnvironmentMap):
        raise ValueError("Mitsuba: got light in spherical harmonics, expected an environment map")
    height = len(light.radiance)
    rows = np.clip(np.linspace(0, height, height) - 0.5, 0, height - 1)
    above = np.minimum(rows.astype(int), height - 2)
    share = (rows - above)[:, None, None].astype(np.float32)
    return (1 - share) * light.radiance[above] + share * light.radiance[above + 1]


def map_directions(height: int) -> np.ndarray:
    """Directions of the nodes of Mitsuba's map, with a column more at either side, [height, 2 height + 2, 3]."""
    theta = np.linspace(0, np.pi, height)[:, None]
    phi = 2 * np.pi * (np.arange(-1, 2 * height + 1) + 0.5) / (2 * height)
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(theta) + 0 * phi, -np.cos(phi) * np.sin(theta)], axis=-1)


# ------------------------------------------------------------------------------------------------ by itself


def cases() -> dict[str, Any]:
    """How each problem is made."""
    mesh, sky = shipped_mesh("bunny"), ws.synthetic_sky((0.5, 0.9, 0.3))
    return {
        "texture": lambda: problems.texture_case(mesh, sky, 0),
        "light": lambda: problems.light_case(mesh, sky, [shipped_mesh("bear"), shipped_mesh("rocks")]),
        "pose": lambda: problems.pose_case(mesh, sky, 0),
        "geometry": lambda: problems.deformation_case(mesh, sky, 0),
    }


def main(names: list[str], iterations: int | None) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # meshes with unreferenced vertices
    for name, make in cases().items():
        if name not in names:
            continue
        case = make()
        agreement(name, case)
        print(f"{name}, start: {case.measure(case.problem.scene)}")
        scene, seconds, count, _ = fit_by_mitsuba(case, iterations)
        print(f"{name}, {count} iterations of {seconds:.2f} s: {case.measure(scene)}", flush=True)


def agreement(name: str, case: Case) -> None:
    """Print how far Mitsuba's image of the true scene is from ours, and how much of that is its noise."""
    truth = case.problem.targets[0].image
    tracer = RayTracer(case.truth, {"type": "direct"})
    images = (tracer.image({}, seed=seed, samples=1024).numpy() for seed in (0, 1))
    first, second = (np.dstack([image, truth[..., 3]]) for image in images)
    difference, noise = image_error(first, truth), image_error(first, second) / math.sqrt(2)
    print(f"{name}: relative L2 of Mitsuba's image to ours {100 * difference:.2f}%, its noise {100 * noise:.2f}%")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="*", default=["texture", "light", "pose", "geometry"])
    parser.add_argument("--iterations", type=int, help="at most so many")
    arguments = parser.parse_args()
    main(arguments.problems, arguments.iterations)
