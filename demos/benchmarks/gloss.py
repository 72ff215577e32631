"""Images of bodies that shine against Mitsuba's, by roughness, of metal and plastic.

    python demos/benchmarks/gloss.py [--data FOLDER] [--size 96] [--bounces 0|1|…] [--picture gloss.png]
    python demos/benchmarks/gloss.py --textured [--surface gltf|principled] [--data FOLDER] [--bounces 0|1|…]
    python demos/benchmarks/gloss.py --loops [--data FOLDER] [--size 96] [--bounces 0|1|…]
    python demos/benchmarks/gloss.py --brdfs
    python demos/benchmarks/gloss.py --fits [--data FOLDER] [--size 96] [--bounces 0|1|…]

FOLDER has meshes/ and envmaps/, as for demos/benchmarks/accuracy.py. Mitsuba renders the same surface
(demos/mitsuba_gloss.py), so that nothing is due to another one. Errors are of the whole image, and of the body that
shines alone, relative L2, noise of the reference taken off. With --textured bodies have textures of roughness and
metallic; a second line has the means of these in the library's images, and --surface principled Mitsuba's own surface,
which differs a little. With --loops it prints the CPU time of an iteration of
a torch loop in which the body moves, image and gradient, of the diffuse body and of those that shine, without Mitsuba.
With --brdfs it prints how far Mitsuba's own surfaces are from this one, by the angle of the viewer, relative L2 over
the hemisphere; with --fits the roughness and the metallic that a fit finds from Mitsuba's image, where all else is
known.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import mitsuba_gloss
from demos.references import Reference, Request
from demos.scenes import shipped_mesh
from demos.shapes import bottle, knot
from warpshadow import inverse
from warpshadow.torch import TorchRenderer

ROUGHNESS = (0.2, 0.35, 0.6)
KINDS = {"metal": {"albedo": (0.9, 0.65, 0.35), "metallic": 1.0}, "plastic": {"albedo": (0.15, 0.35, 0.6)}}
METHODS = ("still", "renderer")
VIEWERS = (0, 30, 60, 75)  # from the normal [degrees]
START = {"roughness": 0.5, "metallic": 0.5}  # of fits


def scenes(data: Path | None, size: int, count: int) -> dict[str, ws.Scene]:
    """Bodies on a ground, without gloss."""
    if data is None:
        meshes = {name: shipped_mesh(name) for name in ("bunny", "bear")}
        lights = [ws.synthetic_sky((0.5, 0.6, 0.3), sun_radius=8, sun_strength=2)]
    else:
        names = ["spot.obj", "stanford-bunny.obj"]
        meshes = {
            "ball": ws.icosphere(1.0, 4),
            **{Path(name).stem: ws.load_mesh(data / "meshes" / name) for name in names},
            "bear": shipped_mesh("bear"),
            "knot": knot(),
            "bottle": bottle(),
        }
        lights = [
            ws.EnvironmentMap.read(data / "envmaps" / name) for name in ("apartment.exr", "city.exr", "forest.exr")
        ]
    result = {}
    for number, (name, mesh) in enumerate(list(meshes.items())[:count]):
        turn = (0, 150, 0) if name == "spot" else (0, 0, 0)
        body = ws.Body(mesh, albedo=(0.5, 0.5, 0.5), rotation=turn, name=name).on_ground(size=2)
        ground = ws.Body(ws.plane(8.0, 64), albedo=(0.4, 0.4, 0.4), name="ground")
        camera = ws.Camera.framing(body, direction=(-0.4, 0.5, 1), fov_y=30, size=(size, size))
        result[name] = ws.Scene([body, ground], lights[number % len(lights)], camera)
    return result


def glossy(scene: ws.Scene, roughness: float, kind: str) -> ws.Scene:
    """The scene with its first body of a roughness and kind."""
    body = dataclasses.replace(scene.bodies[0], roughness=roughness, **KINDS[kind])
    return dataclasses.replace(scene, bodies=(body, *scene.bodies[1:]))


def textured(scene: ws.Scene) -> tuple[ws.Scene, ws.Scene]:
    """The scene with stripes of roughness and patches of metal on its first body; and with their means instead."""
    body = scene.bodies[0]
    mesh = body.mesh if body.mesh.uvs is not None else ws.unwrap(body.mesh)
    v, u = (np.mgrid[:256, :256] + 0.5) / 256
    roughness = 0.4 + 0.25 * np.sin(2 * np.pi * 6 * u)
    metallic = np.clip(0.5 + 4 * np.sin(2 * np.pi * 5 * u) * np.sin(2 * np.pi * 5 * v), 0, 1)
    result = []
    for values in ((roughness, metallic), (roughness.mean(), metallic.mean())):
        gloss = dict(zip(("roughness", "metallic"), values, strict=True))
        shiny = dataclasses.replace(body, mesh=mesh, albedo=KINDS["metal"]["albedo"], **gloss)
        result.append(dataclasses.replace(scene, bodies=(shiny, *scene.bodies[1:])))
    return result[0], result[1]


def cases(scene: ws.Scene, *, has_textures: bool) -> list[tuple[str, ws.Scene, ws.Scene]]:
    """Names of rows, scenes of references, and scenes of images that are compared with them."""
    if has_textures:
        truth, means = textured(scene)
        return [(f"{'textures':19}", truth, truth), (f"{'their means':19}", truth, means)]
    shiny = {
        f"{roughness:<10}{kind:9}": glossy(scene, roughness, kind)
        for roughness, kind in itertools.product(ROUGHNESS, KINDS)
    }
    return [(label, each, each) for label, each in shiny.items()]


def image(scene: ws.Scene, method: str) -> tuple[np.ndarray, float]:
    """An image, and the CPU time that it takes when everything is compiled and cached."""
    if method == "still":
        ws.render(scene, progress=False)
        start = time.process_time()
        return ws.render(scene, progress=False), time.process_time() - start
    result = ws.Renderer(scene, progress=False).render()
    renderer = ws.Renderer(scene, progress=False)
    renderer.view()
    start = time.process_time()
    renderer.render()
    return result, time.process_time() - start


def body_error(reference: Reference, shown: np.ndarray) -> float:
    """Relative L2 error of the first body's pixels."""
    pixels = reference.pixels(0)
    truth = reference.mean[pixels, :3]
    noise = np.linalg.norm(reference.images[0][pixels, :3] - reference.images[1][pixels, :3]) / 2
    error = np.linalg.norm(shown[pixels, :3] - truth)
    return float(np.sqrt(max(error**2 - noise**2, 0)) / np.linalg.norm(truth))


def iteration_seconds(scene: ws.Scene, count: int = 9, preparing: int = 4) -> float:
    """CPU time of an image of a moved body and its gradient, the median of some after others that prepare."""
    renderer = TorchRenderer(scene, progress=False)
    rotations, translations, scales = renderer.scene_poses()
    seconds = []
    for number in range(count + preparing):
        shift = torch.tensor([0.01 * number, 0.0, 0.0]) * torch.tensor([[1.0], [0.0]])
        moved = (translations + shift).requires_grad_()
        start = time.process_time()
        renderer(geometry=renderer.placed(rotations, moved, scales, moving=[0])).square().sum().backward()
        seconds.append(time.process_time() - start)
        assert moved.grad is not None and moved.grad[0].any()
    return float(np.median(seconds[preparing:]))


def print_loops(of_bodies: dict[str, ws.Scene], bounces: int) -> None:
    """Print times of iterations, of bodies that are diffuse, with pixels as receivers, and of the same that shine."""
    print(f"{'body':16}{'diffuse':>10}" + "".join(f"{kind:>18}" for kind in KINDS))
    for name, plain in of_bodies.items():
        by_pixel = dataclasses.replace(plain.bodies[0], receivers="pixel")
        plain = dataclasses.replace(plain, bounces=bounces, bodies=(by_pixel, *plain.bodies[1:]))
        diffuse = iteration_seconds(plain)
        line = f"{name:16}{diffuse:8.3f} s"
        for kind in KINDS:
            seconds = iteration_seconds(glossy(plain, ROUGHNESS[1], kind))
            line += f"{seconds:8.3f} s ({seconds / diffuse:.1f} x)"
        print(line, flush=True)


def print_brdfs() -> None:
    """Print how far surfaces of Mitsuba are from glTF's, the same but for their formulas."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    print(f"{'kind':9}{'roughness':11}{'surface':15}" + "".join(f"{degrees:6}°" for degrees in VIEWERS))
    for kind, roughness in itertools.product(KINDS, ROUGHNESS):
        body = ws.Body(ws.icosphere(1.0, 1), roughness=roughness, **KINDS[kind])
        for name, other in mitsuba_gloss.alike(body).items():
            line = f"{kind:9}{roughness:<11}{name:15}"
            for degrees in VIEWERS:
                ours, theirs = (
                    mitsuba_gloss.reflected_light(each, degrees) for each in (mitsuba_gloss.surface(body), other)
                )
                line += f"{np.linalg.norm(theirs - ours) / np.linalg.norm(ours):7.1%}"
            print(line, flush=True)


def find_gloss(scene: ws.Scene, image: np.ndarray) -> tuple[float, float]:
    """Roughness and metallic of the first body, from an image of it whose other values the scene has."""
    start = dataclasses.replace(scene, bodies=(dataclasses.replace(scene.bodies[0], **START), *scene.bodies[1:]))
    problem = inverse.Problem(start, inverse.Target(image), [inverse.Roughness(0), inverse.Metallic(0)])
    found = inverse.fit(problem, inverse.Stage(40), progress=False).scene.bodies[0]
    return float(found.roughness[0]), float(found.metallic[0])


def print_fits(of_bodies: dict[str, ws.Scene], bounces: int, samples: int, references: Path) -> None:
    """Print the gloss that fits find from Mitsuba's images."""
    print(f"{'body':16}{'roughness':10}{'kind':9}{'found':>8}{'metallic':>10}")
    for name, plain in of_bodies.items():
        for label, truth, _ in cases(dataclasses.replace(plain, bounces=bounces), has_textures=False):
            reference = Request(truth, "mitsuba", bounces, samples, references).reference()
            roughness, metallic = find_gloss(truth, reference.mean.astype(np.float32))
            print(f"{name:16}{label}{roughness:8.3f}{metallic:10.2f}", flush=True)


def main() -> None:
    """Print the tables, and write a contact sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--size", type=int, default=96, help="pixels")
    parser.add_argument("--bodies", type=int, default=6, help="at most so many")
    parser.add_argument("--bounces", type=int, default=0)
    parser.add_argument("--samples", type=int, default=512, help="paths of a pixel of the reference")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--references", type=Path, default=Path("out/references"), help="where references stay")
    parser.add_argument("--picture", type=Path, help="contact sheet: reference, then each method")
    parser.add_argument("--textured", action="store_true", help="bodies with textures of roughness and metallic")
    parser.add_argument("--surface", choices=("gltf", "principled"), default="gltf", help="of Mitsuba")
    parser.add_argument("--loops", action="store_true", help="times of iterations of a torch loop, and no images")
    parser.add_argument("--brdfs", action="store_true", help="differences of surfaces, and no images")
    parser.add_argument("--fits", action="store_true", help="gloss that fits find, and no images")
    arguments = parser.parse_args()
    ws.quiet()
    if arguments.loops:
        print_loops(scenes(arguments.data, arguments.size, arguments.bodies), arguments.bounces)
        return
    if arguments.brdfs:
        print_brdfs()
        return
    if arguments.fits:
        of_bodies = scenes(arguments.data, arguments.size, arguments.bodies)
        print_fits(of_bodies, arguments.bounces, arguments.samples, arguments.references)
        return
    errors: dict[str, list[float]] = {method: [] for method in arguments.methods}
    sheet, by = [], "mitsuba" if arguments.surface == "gltf" else arguments.surface
    print(f"{'body':16}{'roughness':10}{'kind':9}" + "".join(f"{name:>8} body    time" for name in arguments.methods))
    for name, plain in scenes(arguments.data, arguments.size, arguments.bodies).items():
        plain = dataclasses.replace(plain, bounces=arguments.bounces)
        for label, truth, shown_scene in cases(plain, has_textures=arguments.textured):
            reference = Request(truth, by, arguments.bounces, arguments.samples, arguments.references).reference()
            row, line = [reference.mean], f"{name:16}{label}"
            for method in arguments.methods:
                shown, seconds = image(shown_scene, method)
                if shown_scene is truth:
                    errors[method].append(reference.error(shown))
                line += f"{reference.error(shown):8.1%}{body_error(reference, shown):6.1%}{seconds:6.2f} s"
                row.append(shown)
            sheet.append(np.concatenate(row, axis=0))
            print(line + f"   noise {reference.noise():.1%}", flush=True)
    for method, values in errors.items():
        print(f"{method}: {np.mean(values):.1%} on average, {np.max(values):.1%} at worst")
    if arguments.picture:
        ws.Picture(np.concatenate(sheet, axis=1)).write(arguments.picture)


if __name__ == "__main__":
    main()
