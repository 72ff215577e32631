"""How far the stages can be trusted: hard cases against float64 twins, and where the methods themselves break down.

    python demos/benchmarks/stability.py [--output out]

It prints tables and draws OUTPUT/stability.png. A row is a case and a method: the largest error of a value against the
float64 twin, the relative error of gradients along random displacements against central differences of the twin, and
whether all of them are finite. ``tests/test_stability.py`` asserts the same.
"""

import argparse
import dataclasses
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from warp.optim import Adam

sys.path.append(str(Path(__file__).parents[2] / "tests"))
import twins

import warpshadow as ws
from warpshadow.stages import (
    Poses,
    accumulate,
    directional_transfer,
    interpolate,
    rasterize,
    rotation_matrices,
    sh_transfer,
    shade,
    transmittance,
    vertex_normals,
)
from warpshadow.stages.visibility import exponential

STEP = 1e-7
"""Of central differences, in sizes of the case: small, since curvature jumps where a receiver meets a sphere."""

Arrays = Sequence[np.ndarray]  # float64
Displacements = Callable[[np.random.Generator], Arrays]


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Stage:
    """A function of arrays [item, …]: the library's, its float64 twin, and how large a row of results may be."""

    run: Callable[..., wp.array]
    twin: Callable[..., np.ndarray]
    dtypes: tuple[type, ...]
    unit: float = 1.0


@dataclass(frozen=True)
class Errors:
    """Against the twin: the largest of a row of values, over the stage's unit, and of gradients, relative."""

    value: float
    gradient: float
    is_finite: bool


def measure(stage: Stage, arguments: Arrays, displacements: Displacements, device: str = "cpu") -> Errors:
    """Run a stage forward and backward, and compare with its twin of the arguments before they are rounded to float32.

    Args:
        stage: What is measured.
        arguments: Its arguments, of one instance.
        displacements: For each argument a random displacement, by which the twin is differenced.
        device: Where the library runs.
    """
    rng = np.random.default_rng(0)
    arrays = [to_device(values, dtype, device) for values, dtype in zip(arguments, stage.dtypes, strict=True)]
    expected = stage.twin(*arguments)
    weights = rng.normal(size=expected.shape) / np.sqrt(expected.size)
    with wp.Tape() as tape:
        result = stage.run(*arrays)
    result.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    got = result.numpy()[0]
    gradients = [
        np.zeros_like(v) if a.grad is None else a.grad.numpy()[0] for a, v in zip(arrays, arguments, strict=True)
    ]

    slopes = []
    for _ in range(2):
        moves = displacements(rng)
        ends = [
            np.sum(weights * stage.twin(*(v + step * move for v, move in zip(arguments, moves, strict=True))))
            for step in (STEP, -STEP)
        ]
        along = sum(np.sum(gradient * move) for gradient, move in zip(gradients, moves, strict=True))
        slopes.append((along, (ends[0] - ends[1]) / (2 * STEP)))
    along, differences = np.transpose(slopes)
    return Errors(
        float(np.linalg.norm((got - expected).reshape(len(got), -1), axis=1).max() / stage.unit),
        # less than 1e-6 means that values do not depend on the arguments
        float(np.linalg.norm(along - differences) / max(np.linalg.norm(differences), 1e-6)),
        all(np.isfinite(values).all() for values in (got, *gradients)),
    )


def to_device(values: np.ndarray, dtype: type, device: str) -> wp.array:
    """Make an array of one instance that requires a gradient."""
    return wp.array(values[None].astype(np.float32), dtype=dtype, device=device, requires_grad=True)


def print_row(case: str, method: str, errors: Errors) -> None:
    finite = "yes" if errors.is_finite else "NO"
    print(f"{case:26}{method:20}{errors.value:12.1e}{errors.gradient:16.1e}{finite:>9}", flush=True)


def print_header(case: str, method: str) -> None:
    print(f"\n{case:26}{method:20}{'value error':>12}{'gradient error':>16}{'finite':>9}")


# ---------------------------------------------------------------------------------------------- visibility


SCENE = (wp.vec3, wp.vec3, wp.vec3, wp.float32)  # points, normals, centers, radii


def log_sh_stage(order: int, log: str, base: str = "quadratic") -> Stage:
    """SH visibility of points, normals, centers and radii."""
    threshold = exponential.THRESHOLDS[base].default

    def run(points: wp.array, normals: wp.array | None, centers: wp.array, radii: wp.array) -> wp.array:
        logs = accumulate(points, normals, centers, radii, order=order, log=log)
        return exponential.exponentiate(logs, base=base)

    def twin(*scene: np.ndarray) -> np.ndarray:
        return twins.exponential(twins.log_sh(*scene, order, log), base, threshold)

    return Stage(run, twin, SCENE, twins.UNIT)


def directional_stage(count: int) -> Stage:
    """Transmittance of points, normals, centers and radii."""
    directions = ws.fibonacci(count)

    def run(points: wp.array, normals: wp.array | None, centers: wp.array, radii: wp.array) -> wp.array:
        return transmittance(points, None, centers, radii, directions)

    def twin(points: np.ndarray, normals: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        return twins.transmittance(points, centers, radii, directions)

    return Stage(run, twin, SCENE, np.sqrt(count))


VISIBILITY = {
    "directional 128": directional_stage(128),
    **{f"log-SH {log} {order}": log_sh_stage(order, log) for log in ("eigen", "cap") for order in (2, 4, 8)},
}


def scene_displacements(scene: Arrays) -> Displacements:
    """Displace positions by about a radius, radii by themselves, and normals along their tangents."""
    points, normals, centers, radii = scene
    length = np.median(radii[radii > 0])

    def displace(rng: np.random.Generator) -> Arrays:
        turns = np.cross(normals, rng.normal(size=normals.shape))
        shifts = [length * rng.normal(size=values.shape) for values in (points, centers)]
        return shifts[0], turns, shifts[1], radii * rng.normal(size=radii.shape)

    return displace


# ---------------------------------------------------------------------------------------------- shading


def lit_stage(order: int, light: ws.EnvironmentMap) -> Stage:
    """Shading of points, normals, centers and radii by light in spherical harmonics, or in cells where order is 0."""
    directions = ws.fibonacci(128)
    coefficients = (light.sh(order) if order else light.cells(directions).radiance).astype(float)
    visibility = VISIBILITY[f"log-SH eigen {order}" if order else "directional 128"]

    def run(points: wp.array, normals: wp.array, centers: wp.array, radii: wp.array) -> wp.array:
        seen = visibility.run(points, normals, centers, radii)
        transfer = sh_transfer(seen, normals, order=order) if order else directional_transfer(seen, normals, directions)
        return shade(transfer, wp.array(coefficients[None], dtype=wp.vec3, device=points.device))

    def twin(*scene: np.ndarray) -> np.ndarray:
        seen = visibility.twin(*scene)
        transfer = (
            twins.sh_transfer(seen, scene[1]) if order else twins.directional_transfer(seen, scene[1], directions)
        )
        return transfer @ coefficients

    return Stage(run, twin, SCENE, max(np.abs(coefficients).max(), 1.0))


def hard_lights() -> dict[str, ws.EnvironmentMap]:
    """Lights at the limits: the sun is one pixel of a million times the sky."""
    sun = np.full((64, 128, 3), 0.1)
    sun[20, 40] = 1e5
    return {"a sun of one pixel": ws.EnvironmentMap(sun), "no light": ws.EnvironmentMap.constant(0.0)}


# ---------------------------------------------------------------------------------------------- triangles


def weights_stage(clip: np.ndarray, device: str = "cpu") -> Stage:
    """Barycentrics of a triangle's clip positions, at the pixels that it covers."""
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    identity = wp.array(np.eye(3)[None], dtype=wp.vec3, device=device)
    is_seen = rasterize(to_device(clip, wp.vec4, device), faces, 32, 32).face_ids.numpy()[0] == 0
    rows, columns = np.nonzero(is_seen)

    def run(positions: wp.array) -> wp.array:
        image = interpolate(rasterize(positions, faces, 32, 32), faces, identity)
        return image.reshape((1, 32 * 32))

    def twin(positions: np.ndarray) -> np.ndarray:
        image = np.zeros((32, 32, 3))
        image[is_seen] = twins.barycentrics(positions, (2 * columns + 1) / 32 - 1, (2 * rows + 1) / 32 - 1)
        return image.reshape(-1, 3)

    return Stage(run, twin, (wp.vec4,))


def triangle_displacements(clip: np.ndarray) -> Displacements:
    """Displace clip positions, but for their depths, by about the triangle's shortest side."""
    length = np.linalg.norm(clip - np.roll(clip, 1, axis=0), axis=1).min()
    return lambda rng: (length * np.array([1, 1, 0, 1]) * rng.normal(size=clip.shape),)


# ---------------------------------------------------------------------------------------------- optimization


@wp.kernel
def _sum_squares(
    # in
    shading: wp.array2d(dtype=wp.vec3),
    target: float,
    # out
    loss: wp.array(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, vertex = wp.tid()
    difference = shading[batch, vertex] - wp.vec3(target)
    wp.atomic_add(loss, 0, wp.dot(difference, difference))


def descend(method: str, learning_rate: float, steps: int, device: str = "cpu") -> list[float]:
    """Turn a ball among spheres gray, by moving, turning and scaling them with Adam; returns the losses.

    Raises:
        ValueError: naming the first array that is out of range or not finite.
    """
    directions, light = ws.fibonacci(64), ws.synthetic_sky(height=32)
    ball = ws.icosphere(0.5, 2)
    _, _, centers, radii = twins.hard_scenes()["ordinary"]

    turns, shifts = (to_device(np.zeros((7, 3)), wp.vec3, device) for _ in range(2))
    scales = to_device(np.ones(7), wp.float32, device)
    rest = [to_device(values, wp.vec3, device) for values in (ball.positions, centers)]
    rest.append(to_device(radii, wp.float32, device))
    faces = wp.array(ball.faces, dtype=wp.vec3i, device=device)
    whole = wp.zeros(ball.vertex_count, dtype=wp.int32, device=device)  # the ball is body 0, the spheres the others
    own = wp.array(np.arange(1, 7, dtype=np.int32), device=device)
    basis = light.cells(directions).radiance if method == "directional" else light.sh(4)
    coefficients = wp.array(basis[None], dtype=wp.vec3, device=device)

    variables = [turns, shifts, scales, rest[2]]
    flat = [variable.flatten() for variable in variables]
    optimizer = Adam(flat, lr=learning_rate)
    losses = []
    for _ in range(steps):
        loss = wp.zeros(1, dtype=wp.float32, device=device, requires_grad=True)
        with wp.Tape() as tape:
            poses = Poses(rotation_matrices(turns), shifts, scales)
            points, moved, sizes = poses.placed(rest[0], whole, rest[1], rest[2], own)
            normals = vertex_normals(points, faces)
            if method == "directional":
                seen = transmittance(points, normals, moved, sizes, directions)
                transfer = directional_transfer(seen, normals, directions)
            else:
                logs = accumulate(points, normals, moved, sizes, order=4, log=method)
                transfer = sh_transfer(exponential.exponentiate(logs), normals, order=4)
            shading = shade(transfer, coefficients)
            wp.launch(_sum_squares, dim=shading.shape, inputs=[shading, 0.5], outputs=[loss], device=device)
        tape.backward(loss)
        optimizer.step([variable.grad for variable in flat])
        tape.zero()
        for positive in (scales, rest[2]):
            positive.assign(np.maximum(positive.numpy(), 0))
        losses.append(float(loss.numpy()[0]))
    return losses


# ---------------------------------------------------------------------------------------------- breakdown


DEPTHS = [1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 50, 100, 200, 500, 1000, 2000, 5000, 10000]
"""Numbers of equal spheres in one direction."""

THRESHOLD_GRID = 2.0 ** np.arange(-6.5, 4.01, 0.125)


def ambient(visibility: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Shading under a uniform sky, of SH visibility [vertex, order²] or transmittance [vertex, direction]."""
    order = int(np.sqrt(visibility.shape[1]))
    if order**2 == visibility.shape[1]:
        return np.sum(visibility * twins.cosine_lobes(order, normals), axis=1)
    return twins.directional_transfer(visibility, normals, ws.fibonacci(visibility.shape[1])).sum(axis=1)


def exact_ambient(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The same where a unit sphere at the origin blocks."""
    directions, weights = twins.sphere_quadrature(100)
    toward, cosine, _ = twins.cones(points, np.zeros(3), 1.0)
    is_open = toward @ directions.T <= cosine[:, None]
    return (is_open * np.maximum(normals @ directions.T, 0)) @ weights / np.pi


def overlap_errors() -> dict[str, list[float]]:
    """Root mean square error of shading under a uniform sky, over DEPTHS: of each method, and of plain squaring."""
    errors: dict[str, list[float]] = {}
    for depth in DEPTHS:
        points, normals, centers, radii = twins.stacked_spheres(depth)
        exact = exact_ambient(points, normals)
        arrays = [to_device(v, t, "cpu") for v, t in zip((points, normals, centers, radii), SCENE, strict=True)]
        arrays[1] = None
        results = {}
        for label in ("directional 128", "log-SH eigen 8", "log-SH cap 8"):
            results[label] = VISIBILITY[label].run(*arrays).numpy()[0].astype(float)
        for log in ("eigen", "cap"):
            one = twins.log_sh(points, None, centers[:1], radii[:1], 8, log)
            with np.errstate(all="ignore"):
                results[f"{log} 8, plain squaring"] = twins.exponential(
                    depth * one, "quadratic", exponential.THRESHOLDS["quadratic"].default, quiet=None
                )
        for label, visibility in results.items():
            with np.errstate(all="ignore"):
                error = np.sqrt(np.mean((ambient(visibility, normals) - exact) ** 2))
            errors.setdefault(label, []).append(float(np.nan_to_num(error, nan=np.inf)))
    return errors


def threshold_errors() -> dict[str, list[float]]:
    """Relative error of plain squaring, over THRESHOLD_GRID, of each base, where ten spheres are in one direction."""
    points, _, centers, radii = twins.stacked_spheres(10)
    rows = twins.log_sh(points, None, centers, radii, 8, "eigen")
    converged = twins.exponential(rows, "quadratic", 1e-3, quiet=None)
    errors: dict[str, list[float]] = {}
    for base in exponential.THRESHOLDS:
        for threshold in THRESHOLD_GRID:
            got = twins.exponential(rows, base, threshold, quiet=None)
            errors.setdefault(base, []).append(float(np.linalg.norm(got - converged) / np.linalg.norm(converged)))
    return errors


def offset_errors(offsets: Sequence[float], label: str) -> list[float]:
    """Errors of visibility where the whole scene is far from the origin, by offset [radii]."""
    points, normals, centers, radii = twins.hard_scenes()["ordinary"]
    shifts = [offset * np.median(radii) for offset in offsets]
    scenes = [(points + shift, normals, centers + shift, radii) for shift in shifts]
    return [measure(VISIBILITY[label], scene, scene_displacements(scene)).value for scene in scenes]


def first_above(grid: Sequence[float], errors: Sequence[float], limit: float) -> float:
    """The first of a grid at which an error exceeds a limit."""
    return next((value for value, error in zip(grid, errors, strict=True) if error > limit), np.inf)


def light_in_a_closed_room(visibility: ws.Visibility) -> float:
    """Mean light of a uniform sky of 1 inside a room of six white planes, which should be dark."""
    turns = ((0, 0, 0), (180, 0, 0), (90, 0, 0), (-90, 0, 0), (0, 0, 90), (0, 0, -90))
    walls = []
    for turn in turns:
        wall = ws.Body(ws.plane(2.0, 8), rotation=turn, albedo=(1, 1, 1))
        walls.append(dataclasses.replace(wall, translation=-wall.rotation_matrix()[:, 1]))
    camera = ws.Camera.look_at((0.2, 0.1, 0.6), (0, -0.3, -1), fov_y=70, size=(24, 24))
    image = ws.render(ws.Scene(walls, ws.EnvironmentMap.constant(1.0), camera, visibility, supersampling=1))
    return float(image[..., :3].mean())


def print_breakdown(overlap: dict[str, list[float]], thresholds: dict[str, list[float]]) -> None:
    print("\nwhere it breaks down")
    for log in ("eigen", "cap"):
        plain, held = overlap[f"{log} 8, plain squaring"], overlap[f"log-SH {log} 8"]
        print(
            f"  overlap, {log}: one sphere shades with an error of {held[0]:.3f}; plain squaring loses a digit at "
            f"{first_above(DEPTHS, plain, 10 * held[0])} spheres in one direction and float32 at "
            f"{first_above(DEPTHS, plain, 1e38)}; held squaring has {max(held):.3f} at worst, at "
            f"{DEPTHS[int(np.argmax(held))]}, and {held[-1]:.3f} at {DEPTHS[-1]}"
        )
    one, *_, most = overlap["directional 128"]
    print(f"  overlap, directional: {one:.3f} for one sphere, {most:.3f} for {DEPTHS[-1]}")
    for base, errors in thresholds.items():
        explodes = first_above(THRESHOLD_GRID, errors, 1.0)
        default, limit = exponential.THRESHOLDS[base]
        at_default = np.interp(default, THRESHOLD_GRID, errors)
        print(
            f"  squaring, {base}: explodes at |h| = {explodes:.2g}; accepted up to {limit:g}; {at_default:.1%} off at "
            f"the default of {default:g}"
        )
    offsets = 10.0 ** np.arange(3, 6)
    for label in ("directional 128", "log-SH eigen 8"):
        rate = np.median(np.array(offset_errors(offsets, label)) / (offsets * np.finfo(np.float32).eps))
        print(f"  offset, {label}: an error of {rate:.2g} · 1.2e-7 · offset / radius")
    sun = hard_lights()["a sun of one pixel"]
    radiance = twins.harmonics(8, ws.fibonacci(4096)) @ sun.sh(8)[:, 0]
    print(f"  a sun in SH of order 8: as low as {radiance.min() / radiance.max():.0%} of its peak elsewhere")
    for visibility in (ws.Visibility(directions=128), ws.Visibility(directions=1024), ws.Visibility(method="log-sh")):
        label = f"directional, {visibility.directions}" if visibility.method == "directional" else visibility.method
        print(f"  a closed room, {label}: {light_in_a_closed_room(visibility):.1%} of the sky's light")


def plot(overlap: dict[str, list[float]], thresholds: dict[str, list[float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for label, errors in overlap.items():
        shown = np.minimum(errors, 1e30)  # matplotlib overflows beyond
        left.loglog(DEPTHS, shown, ":" if "plain" in label else "-", label=label)
    left.set(xlabel="spheres in one direction", ylabel="error of shading under a uniform sky", ylim=(5e-3, 1e2))
    for base, errors in thresholds.items():
        (line,) = right.loglog(THRESHOLD_GRID, errors, label=base)
        default, limit = exponential.THRESHOLDS[base]
        right.plot(default, np.interp(default, THRESHOLD_GRID, errors), "o", color=line.get_color())
        right.axvline(limit, color=line.get_color(), alpha=0.3)
    right.set(xlabel="threshold of |h| (dot: default; line: limit)", ylabel="relative error of the exponential")
    right.set(ylim=(1e-6, 1e4))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(output: Path) -> None:
    ws.quiet()
    # of squarings that are held: some cases are for them
    warnings.filterwarnings("ignore", message="log-SH visibility")
    # of turns by a learning rate of 1e6
    warnings.filterwarnings("ignore", message="parameters: got an axis-angle vector")

    print_header("scene", "visibility")
    scenes = twins.hard_scenes()
    for case, scene in scenes.items():
        for method, stage in VISIBILITY.items():
            print_row(case, method, measure(stage, scene, scene_displacements(scene)))
    print_header("light", "shading")
    for case, light in hard_lights().items():
        for method, order in (("directional 128", 0), ("log-SH eigen 2", 2), ("log-SH eigen 8", 8)):
            scene = scenes["ordinary"]
            print_row(case, method, measure(lit_stage(order, light), scene, scene_displacements(scene)))
    print_header("triangle", "drawing")
    for case, clip in twins.hard_triangles().items():
        print_row(case, "barycentrics", measure(weights_stage(clip), (clip,), triangle_displacements(clip)))

    print(f"\n{'Adam':46}losses of 20 steps")
    for rate in (1e-2, 1.0, 1e3, 1e6, 1e30):
        for method in ("directional", "eigen", "cap"):
            try:
                losses = descend(method, rate, 20)
                text = f"{losses[0]:.3g} … {losses[-1]:.3g}, {'all' if np.isfinite(losses).all() else 'NOT ALL'} finite"
            except ValueError as error:
                text = f"stops: {error}"
            print(f"{f'learning rate {rate:g}':26}{method:20}{text}")

    overlap, thresholds = overlap_errors(), threshold_errors()
    print_breakdown(overlap, thresholds)
    path = output / "stability.png"
    plot(overlap, thresholds, path)
    print(f"\nwrote {path}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the picture")
    main(parser.parse_args().output)
