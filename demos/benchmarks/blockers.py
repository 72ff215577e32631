"""What default blockers buy: error against time, beside that of 64 spheres, for bodies of many shapes.

    python demos/benchmarks/blockers.py [--data FOLDER] [--bodies NAME ...] [--counts 64] [--size 256]
        [--samples 1024] [--runs 5]

Each body is 2 units large on a ground of 6 units under a sky with a sun. Times are the processor's on
one thread, of a warm image whose body has moved a hair's breadth; settings take turns. The error is the relative L2
error over wholly covered pixels against rays. "explain" says as what the default blocks light.
"""

import argparse
import dataclasses
import re
import sys
import time
import warnings
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import shapes
from demos.benchmarks.accuracy import load_meshes
from demos.scenes import image_error, on_ground
from warpshadow.tuning.timing import median_times, whole_image

SHAPES = (shapes.chair, shapes.wheel, shapes.fence, shapes.cage, shapes.bowl, shapes.bottle, shapes.tent, shapes.knot)


def main(data: Path | None, names: list[str], counts: list[int], size: int, samples: int, runs: int) -> None:
    ws.quiet(progress=False)
    ws.set_thread_count(1)
    warnings.simplefilter("ignore")  # meshes with unreferenced vertices, ragged shadows
    print("| body | the default blocks as | default |" + "".join(f" {count} spheres |" for count in counts))
    print("| --- " * (3 + len(counts)) + "|")
    for mesh in [*load_meshes(data), *(make() for make in SHAPES)]:
        if names and mesh.name not in names:
            continue
        scenes = [on_ground(mesh, ws.synthetic_sky(), blockers=blockers) for blockers in ("auto", *counts)]
        scenes = [dataclasses.replace(scene, camera=scene.camera.resized(size / 256)) for scene in scenes]
        reference = dataclasses.replace(scenes[0], visibility=ws.Visibility("ray-traced", samples=samples))
        truth, renderers = ws.render(reference), [ws.Renderer(scene) for scene in scenes]
        errors = [image_error(renderer.render(), truth) for renderer in renderers]
        times = median_times([whole_image(each) for each in renderers], runs, clock=time.process_time)
        kind = re.search(r"Body 0 .* blocks light as ([\w ]+)", str(renderers[0].explain()))
        cells = [f"{error:.1%}, {milliseconds:.0f} ms" for error, milliseconds in zip(errors, times, strict=True)]
        print(f"| {' | '.join([mesh.name, kind[1] if kind else '', *cells])} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--bodies", nargs="*", default=[], help="names of the bodies; all without")
    parser.add_argument("--counts", type=int, nargs="*", default=[64], help="numbers of spheres to compare with")
    parser.add_argument("--size", type=int, default=256, help="width and height of the image [pixels]")
    parser.add_argument("--samples", type=int, default=1024, help="directions of the reference")
    parser.add_argument("--runs", type=int, default=5, help="timed images of each")
    arguments = parser.parse_args()
    main(arguments.data, arguments.bodies, arguments.counts, arguments.size, arguments.samples, arguments.runs)
