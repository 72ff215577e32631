"""Blockers: the planes, convex parts and spheres that stand in for the bodies of a scene, by the table of README.md."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.mesh import Mesh
from warpshadow.device.progress import ANNOUNCED_SECONDS, announce
from warpshadow.maths.adjacency import solid_angles
from warpshadow.maths.convex import ConvexPart, is_panel
from warpshadow.maths.plane import plane_normal
from warpshadow.scene.body import Body, into_own_space
from warpshadow.scene.height_fields import Land, solid_behind
from warpshadow.scene.scene import Scene
from warpshadow.spheres import Spheres, fit_spheres
from warpshadow.spheres.fit import STEPS, fit_seconds, is_fitted

SPHERES_BESIDE_PARTS = 64
"""Spheres of a body that blocks as convex parts: they send the light that it reflects, and block while it is deformed.
With 32 to 1024 images of a table and a shelf are equally good."""

STEPS_BESIDE_PARTS = 40
"""Steps of the fit of these spheres: with all bounces images of stairs, a table and nested boxes are within 0.06% of
those with 320 steps, and the fits take a fourth of the time."""

MANY_EDGES = 1536
"""Edges of convex parts above which these spheres block in their place, if they cast the mesh's shadow: a torus of
48 × 24 quads and a box have 2316, and an iteration of their pose in 128² pixels takes 0.33 s, past spheres 0.06 s; the
image is 0.9% off, past spheres 1.0%. A brick in a ring of half as many is 2.8% off past its parts, past spheres 6.2%.
"""

GOOD_SHADOW = 0.06
"""Error of the shadow on a ground up to which spheres cast it: of that torus and box 0.055, of a spoked wheel 0.22."""

GOOD_AIR = 0.1  # and of the light around the mesh and on it: 0.098; of spiral stairs 0.2


class FitRequest(NamedTuple):
    """A fit of spheres that a body asks for."""

    mesh: Mesh
    sphere_count: int | str
    steps: int = STEPS
    seen_from: tuple[float, float, float] | None = None


def fit_scene_spheres(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False) -> list[Spheres]:
    """Find the spheres of each body, in its own space, fitting the wanted ones.

    A flat body with the middles of all others on one side is a ground (or a wall): one sphere that touches it from
    behind stands in for it, since small spheres in a sheet would bulge out of it. A method without spheres gets none.
    """
    if not scene.visibility.traits.has_spheres:
        return [Spheres.concatenate([])] * len(scene.bodies)
    fits, parts = fitted_meshes(scene), _convex_parts(scene)
    _announce(fits.values(), device, progress)
    return [
        fit_spheres(
            fits[number].mesh,
            fits[number].sphere_count,
            steps=fits[number].steps,
            device=device,
            progress=progress,
            warns=number not in parts and fits[number].seen_from is None,
            seen_from=fits[number].seen_from,
        ).spheres
        if number in fits
        else _given_spheres(body, ground)
        for number, (body, ground) in enumerate(zip(scene.bodies, _ground_spheres(scene), strict=True))
    ]


def blocking_planes(scene: Scene) -> tuple[int, ...]:
    """Find the bodies that block light as the planes in which they lie, in place of their spheres.

    By a method with cells these are flat bodies that cast shadows, except bodies with spheres of the user's own,
    unless light bounces.
    """
    if not scene.visibility.traits.has_cells:
        return ()
    has_given = [isinstance(body.blockers, Spheres) and not scene.bounces for body in scene.bodies]
    return tuple(
        number
        for number, body in enumerate(scene.bodies)
        if body.mesh.is_flat and body.casts_shadow and not has_given[number]
    )


def blocking_parts(scene: Scene) -> dict[int, list[ConvexPart]]:
    """Find the convex parts as which bodies block the light of others, in place of their spheres, by their numbers.

    By a method with cells these are those of all bodies that consist of some, unless how many spheres they have, or
    that these block their own light, was asked for, or :data:`SPHERES_BESIDE_PARTS` spheres are as good as parts of
    :data:`MANY_EDGES`.
    """
    parts = _convex_parts(scene)
    return {number: parts[number] for number in parts if not _are_spheres_as_good(scene.bodies[number], parts[number])}


def _are_spheres_as_good(body: Body, parts: Sequence[ConvexPart]) -> bool:
    """Whether spheres beside the parts of a body cast its shadow, and in less time."""
    if sum(len(part.edges) for part in parts) <= MANY_EDGES or any(map(is_panel, parts)):
        return False
    fit = fit_spheres(body.mesh, SPHERES_BESIDE_PARTS, steps=STEPS_BESIDE_PARTS, progress=False, warns=False)
    return fit.report.shadow_error <= GOOD_SHADOW and fit.report.visibility_error <= GOOD_AIR


def _convex_parts(scene: Scene) -> dict[int, list[ConvexPart]]:
    """Find the convex parts of bodies, by their numbers, whether or not these block light.

    Panels are chords of bent sheets: over land they would shade the air behind them. So a body with a solid behind it
    (:mod:`.scene.height_fields`) has flat panels alone, such as the walls of a room, unless it is a bowl in which no
    body stands behind panels.
    """
    if not scene.visibility.traits.has_cells:
        return {}
    result = {}
    for number, body in enumerate(scene.bodies):
        if isinstance(body.blockers, str) and body.self_shadows_in(scene.visibility) != "spheres":
            land = _solid_behind(scene, number)
            has_all = land is None or land.is_bowl
            result[number] = body.mesh.convex_parts if has_all else body.mesh.flat_parts
    return {number: parts for number, parts in result.items() if parts}


def find_solids(scene: Scene, parts: Mapping[int, Sequence[ConvexPart]]) -> frozenset[int]:
    """Find the bodies whose convex parts block their own light, too: bodies of solids alone.

    Panels are chords of bent sheets, in which receivers do not lie; and rays to a sun may be asked for.
    """
    return frozenset(
        number
        for number, parts_of_body in parts.items()
        if scene.bodies[number].self_shadows_in(scene.visibility) == "traced" and not any(map(is_panel, parts_of_body))
    )


def fitted_counts(scene: Scene) -> dict[int, int | str]:
    """How many spheres are fitted to bodies, or "auto", by their numbers: see :func:`fitted_meshes`."""
    return {number: fit.sphere_count for number, fit in fitted_meshes(scene).items()}


def fitted_meshes(scene: Scene) -> dict[int, FitRequest]:
    """Find the meshes to which spheres are fitted, and how many, by the number of the body.

    Neither grounds nor bodies with spheres of their own have any. A mesh is the body's own, or the solid behind it
    where it is land and no convex parts.
    """
    parts, result = _convex_parts(scene), {}
    for number, (body, ground) in enumerate(zip(scene.bodies, _ground_spheres(scene), strict=True)):
        count = SPHERES_BESIDE_PARTS if number in parts else _requested_count(body)
        if not count or ground is not None:
            continue
        land = None if number in parts else _solid_behind(scene, number)
        steps = STEPS_BESIDE_PARTS if number in parts else STEPS
        mesh, seen_from = (body.mesh, None) if land is None else (land.solid, land.seen_from)
        result[number] = FitRequest(mesh, count, steps, seen_from)
    return result


def _solid_behind(scene: Scene, number: int) -> Land | None:
    """The solid behind a body that is land; None if it is none."""
    body = scene.bodies[number]
    return solid_behind(body, tuple(other for other in scene.bodies if other is not body))


def free_shape_remark(scene: Scene, number: int) -> str:
    """Say of a body that its spheres are few for a free shape, and how it gets others; empty if they are not."""
    body = scene.bodies[number]
    if not scene.visibility.traits.has_spheres or not body.casts_shadow:
        return ""
    called = f"body {number} ({body.name!r})"
    if _ground_spheres(scene)[number] is not None:
        return (
            f"{called} is flat, and one sphere behind it blocks light in its place, whatever its shape becomes; "
            "blockers = fit_spheres(mesh, 64).spheres follow its vertices"
        )
    if not any(map(is_panel, _convex_parts(scene).get(number, []))):
        return ""
    return (
        f"{called} is a sheet or a thin wall: while its shape is free {SPHERES_BESIDE_PARTS} spheres block its light "
        'in place of its convex parts, and darken it; self_shadows = "spheres" fits as many as blockers = "auto" finds'
    )


def why_spheres_block(scene: Scene, number: int) -> str:
    """Why a body that casts shadows blocks light by spheres, in words after a colon."""
    visibility, body = scene.visibility.with_method(), scene.bodies[number]
    if not visibility.traits.has_cells:
        return f": {visibility.method} has no planes and no convex parts"
    if not isinstance(body.blockers, str):
        return ": its blockers ask for them"
    if body.self_shadows_in(visibility) == "spheres":
        return ': self_shadows = "spheres" asks for them'
    if _solid_behind(scene, number) is not None:
        return ", of the solid behind it: it is land"
    if body.mesh.convex_parts:
        return ": they cast the shadow of its convex parts, in less time"
    return ": it is neither flat, nor made of few convex parts or panels"


def _announce(fits: Iterable[FitRequest], device: wp.DeviceLike, progress: bool) -> None:
    """Say how long fits that are to be made take, if that is long."""
    requested = set(fits)
    if sum(fit_seconds(request.sphere_count) for request in requested) <= ANNOUNCED_SECONDS:
        return
    missing = [request.sphere_count for request in requested if not is_fitted(*request, device=device)]
    announce(
        f"fitting spheres to {len(missing)} mesh{'es' * (len(missing) != 1)}",
        sum(map(fit_seconds, missing)),
        'once; method = "ray-traced" needs none, for still images, and blockers = 64 fewer',
        shows=progress,
    )


def _requested_count(body: Body) -> int | str:
    """How many spheres a body asks for."""
    return 0 if isinstance(body.blockers, Spheres) else body.blockers


def _ground_spheres(scene: Scene) -> list[Spheres | None]:
    """The sphere of each body that asks for some and is a ground."""
    meshes = [body.world_mesh() for body in scene.bodies]
    points = [mesh.world_points() for mesh in meshes]
    return [
        _ground_sphere(meshes[k], [*points[:k], *points[k + 1 :]])
        if _requested_count(body) and body.mesh.is_flat
        else None
        for k, body in enumerate(scene.bodies)
    ]


def _given_spheres(body: Body, ground: Spheres | None) -> Spheres:
    """The spheres of a body to which none are fitted."""
    if isinstance(body.blockers, Spheres):
        return body.blockers
    if ground is None:
        return Spheres.concatenate([])
    return ground.transformed(**into_own_space(body))


def _ground_sphere(mesh: Mesh, others: list[np.ndarray]) -> Spheres | None:
    """The sphere that stands in for a flat mesh that has all others on one side, None if it has not.

    It touches the plane from the other side, and its radius is such that from their mean position it blocks the
    solid angle that the mesh does.
    """
    corners = mesh.positions[mesh.faces].astype(np.float64)
    normal = plane_normal(corners) if others else None
    if normal is None:
        return None
    middle = corners.reshape(-1, 3).mean(axis=0)
    # a body may stand in the ground, and a fit may start with one deep in it
    heights = [np.mean((other - middle) @ normal) for other in others]
    if max(heights) < 0:
        normal = -normal
    elif min(heights) <= 0:
        return None
    other_points = np.concatenate(others)
    height = np.mean((other_points - middle) @ normal)
    solid_angle = np.abs(solid_angles(corners - other_points.mean(axis=0))).sum()
    cosine = 1 - solid_angle / (2 * np.pi)
    sine = min(np.sqrt(1 - cosine**2), 0.999)  # beyond, float32 would not place a sphere so large on the plane
    radius = height * sine / (1 - sine)
    foot = other_points.mean(axis=0) - height * normal
    return Spheres((foot - radius * normal)[None].astype(np.float32), np.array([radius], np.float32))
