"""How wrong each method is: images of several meshes under several skies, against the ray-traced reference.

    python demos/benchmarks/accuracy.py [--data FOLDER] [--spheres 64]

Without ``--data`` the meshes are those that ship with Warp and a few shapes, under synthetic skies. ``--data`` adds the
meshes (FOLDER/meshes) and environment maps (FOLDER/envmaps) of a folder. Each scene is a body of 2 units on a ground of
6 units, 256 × 256; the figure is the relative L2 error over wholly covered pixels, in percent. Images
are those of a ``ws.Renderer``; stills of ``ws.render`` are nearer.
"""

import argparse
import dataclasses
import sys
import warnings
from pathlib import Path

import numpy as np
import trimesh

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import image_error, on_ground, shipped_mesh

METHODS = {
    "none": ws.Visibility(method="none"),
    "log-SH cap": ws.Visibility(method="log-sh", log="cap"),
    "log-SH eigen": ws.Visibility(method="log-sh"),
    "directional 64": ws.Visibility(directions=64),
    "directional 128": ws.Visibility("directional"),
    "directional 256": ws.Visibility(directions=256),
}


def main(data: Path | None, sphere_count: int, samples: int) -> None:
    ws.quiet()
    warnings.simplefilter("ignore")  # meshes with unreferenced vertices
    meshes, skies = load_meshes(data), load_skies(data)
    pairs = [(meshes[i % len(meshes)], skies[i % len(skies)]) for i in range(max(len(meshes), len(skies)))]
    print(f"{'mesh':18}{'sky':16}" + "".join(f"{label:>17}" for label in METHODS))
    rows = []
    for mesh, (sky_name, sky) in pairs:
        scene = on_ground(mesh, sky, blockers=sphere_count)
        truth = render(scene, ws.Visibility(method="ray-traced", samples=samples))
        rows.append([100 * image_error(render(scene, visibility), truth) for visibility in METHODS.values()])
        print(f"{mesh.name:18}{sky_name:16}" + "".join(f"{value:16.1f}%" for value in rows[-1]), flush=True)
    for label, values in (("mean", np.mean(rows, axis=0)), ("worst", np.max(rows, axis=0))):
        print(f"{label:34}" + "".join(f"{value:16.1f}%" for value in values))


def load_meshes(data: Path | None) -> list[ws.Mesh]:
    """Meshes that ship with Warp, shapes with flat and curved sides, and those of the folder.

    Shapes with sharp edges have vertices of their own for each face, as CAD files do, and so flat shading.
    """
    create = trimesh.creation
    shapes = {
        "box": sharp(create.box((1, 1, 1))),
        "torus": create.torus(1, 0.35),
        "cylinder": create.cylinder(0.4, 2).subdivide().subdivide(),
        "table": sharp(table()),
    }
    meshes = [shipped_mesh(name) for name in ("bunny", "bear", "rocks")]
    if data is not None:
        meshes += [ws.load_mesh(file) for file in sorted((data / "meshes").iterdir())]
    return meshes + [ws.Mesh(shape.vertices, shape.faces, name=name) for name, shape in shapes.items()]


def table() -> trimesh.Trimesh:
    """A thin top on four thin legs: what spheres are worst at."""
    box = trimesh.creation.box
    legs = [box((0.12, 1, 0.12)).apply_translation((x, 0.5, z)) for x in (-0.9, 0.9) for z in (-0.5, 0.5)]
    parts = [box((2, 0.1, 1.2)).apply_translation((0, 1, 0)), *legs]
    return trimesh.util.concatenate(parts)


def sharp(shape: trimesh.Trimesh) -> trimesh.Trimesh:
    """Subdivide, and give every face its own vertices."""
    shape = shape.subdivide().subdivide().subdivide()
    shape.unmerge_vertices()
    return shape


def load_skies(data: Path | None) -> list[tuple[str, ws.EnvironmentMap]]:
    """Synthetic skies with a high and a low sun and overcast, or the maps of the folder."""
    if data is not None:
        return [(file.stem, ws.EnvironmentMap.read(file)) for file in sorted((data / "envmaps").iterdir())]
    return [
        ("high sun", ws.synthetic_sky((0.5, 0.9, 0.3))),
        ("low sun", ws.synthetic_sky((0.8, 0.35, 0.3))),
        ("overcast", ws.synthetic_sky((0.3, 0.8, -0.4), sun_strength=0.0)),
    ]


def render(scene: ws.Scene, visibility: ws.Visibility) -> np.ndarray:
    return ws.Renderer(dataclasses.replace(scene, visibility=visibility)).render()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--spheres", type=int, default=64, help="spheres of the body")
    parser.add_argument("--samples", type=int, default=2048, help="directions of the reference")
    arguments = parser.parse_args()
    main(arguments.data, arguments.spheres, arguments.samples)
