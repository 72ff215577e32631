"""How far the path tracer, method "ray-traced" with bounces, is from Mitsuba 3, by samples.

    python demos/benchmarks/path_tracer.py [--bounces 0 1 3] [--samples 64 256 1024] [--golden FILE.npz]

Both trace the same number of bounces. Mitsuba's map is enlarged, since its rows lie elsewhere, and has our normals. The
scene is a corner of two walls, a ground and a ball, under a sky with a sun. ``--golden`` writes what
tests/data/golden_paths.npz holds: the scene's image in Mitsuba for each number of bounces.

Mitsuba is an optional package: see mitsuba_fits.py.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws

_ENLARGED = 8  # times the height of a map
_SEEDS = 8
_PASS = 4096  # samples a pixel of a seed


def corner_scene(size: int = 32) -> ws.Scene:
    """A ball in a corner of two walls: a quarter of what is seen has bounced."""
    bodies = [
        ws.Body(ws.icosphere(0.5, 4), albedo=(0.8, 0.6, 0.5), translation=(0.0, 0.5, 0.0), blockers=1),
        ws.Body(ws.plane(4.0, 1), albedo=(0.7, 0.7, 0.7), blockers=1),
        ws.Body(ws.plane(4.0, 1), albedo=(0.8, 0.2, 0.1), rotation=(0, 0, -90), translation=(-1, 1, 0), blockers=1),
        ws.Body(ws.plane(4.0, 1), albedo=(0.2, 0.7, 0.3), rotation=(90, 0, 0), translation=(0, 1, -1), blockers=1),
    ]
    camera = ws.Camera.look_at((2.0, 1.8, 2.4), (-0.1, 0.5, -0.1), size=(size, size))
    rays = ws.Visibility(method="ray-traced")
    return ws.Scene(bodies, ws.synthetic_sky((0.5, 0.9, 0.3)), camera, rays, supersampling=4)


def by_mitsuba(scene: ws.Scene, bounces: int) -> tuple[np.ndarray, float]:
    """Its image, linear RGB of shape [height, width, 3], and the image's noise as a relative L2 error."""
    from demos.benchmarks.mitsuba_fits import RayTracer

    radiance = scene.light.radiance
    enlarged = ws.EnvironmentMap(radiance.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1))
    integrator = {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000}
    tracer = RayTracer(replace(scene, light=enlarged), integrator)
    images = np.stack([tracer.image({}, seed=seed, samples=_PASS).numpy() for seed in range(_SEEDS)])
    mean = images.mean(axis=0)
    noise = np.linalg.norm(images.std(axis=0, ddof=1)) / np.sqrt(_SEEDS)
    return mean, float(noise / np.linalg.norm(mean))


def main(bounce_counts: list[int], sample_counts: list[int], golden: Path | None) -> None:
    ws.quiet()
    scene = corner_scene()
    images = {}
    for bounces in bounce_counts:
        truth, noise = by_mitsuba(scene, bounces)
        images[f"bounces_{bounces}"] = truth.astype(np.float32)
        print(f"{bounces} bounces: noise of Mitsuba's image {100 * noise:.2f}%")
        for samples in sample_counts:
            rays = ws.Visibility(method="ray-traced", samples=samples)
            image = ws.render(replace(scene, visibility=rays, bounces=bounces))
            covered = image[..., 3] == 1
            difference = (image[..., :3] - truth)[covered]
            error = np.linalg.norm(difference) / np.linalg.norm(truth[covered])
            bias = difference.mean() / truth[covered].mean()
            print(f"  {samples:6} samples: error {100 * error:5.2f}%, mean {100 * bias:+.2f}%", flush=True)
    if golden is not None:
        np.savez_compressed(golden, **images)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bounces", type=int, nargs="*", default=[0, 1, 3])
    parser.add_argument("--samples", type=int, nargs="*", default=[64, 256, 1024, 4096])
    parser.add_argument("--golden", type=Path, help="write Mitsuba's images")
    arguments = parser.parse_args()
    main(arguments.bounces, arguments.samples, arguments.golden)
