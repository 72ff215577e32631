"""Stages built in float64, against central differences: what float32 would round away."""

import importlib

import double_precision
import numpy as np
import pytest
import torch
import twins
import warp as wp

from warpshadow.device.warp_internals import item_shape
from warpshadow.stages import rasterize

# Of every entry of a Jacobian. What differs is due to the differences, rounding of 1e-16/1e-6 and third derivatives:
# measured is a relative L2 of 5e-11 (shading) to 7e-9 (held squarings).
EXACT = {"eps": 1e-6, "rtol": 1e-7, "atol": 2e-8}
CUDA_SUMS = 1e-12  # atomics add up in any order
ORDER = 3  # of harmonics: another has kernels of its own


@pytest.fixture(scope="module")
def double(tmp_path_factory):
    """Import a module of the float64 build, whose kernels nobody else needs: they compile in half the time."""
    package = double_precision.build(tmp_path_factory.mktemp("float64"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp.config, "optimization_level", 0)
        yield lambda name: importlib.import_module(f"{package.__name__}.{name}")


@pytest.fixture
def check(double, device):
    """Check the Jacobian of a function of Warp arrays, called with arguments (dtype, values)."""
    apply = double("torch").apply

    def check(function, *arguments):
        dtypes = [dtype for dtype, _ in arguments]
        place = {"dtype": torch.float64, "device": wp.device_to_torch(device), "requires_grad": True}
        tensors = [torch.tensor(values, **place) for _, values in arguments]
        assert torch.autograd.gradcheck(
            lambda *tensors: apply(function, *tensors, dtypes=dtypes), tensors, nondet_tol=CUDA_SUMS, **EXACT
        )

    return check


def random(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def put(values, dtype, device):
    return wp.array(values, dtype=dtype, device=device)


# A tetrahedron.
VERTICES = 1.2 * np.array([[1, 0, -0.6], [-1, 0.1, -0.7], [0.1, -0.2, 1.1], [0.2, 0.9, 0.1]])
FACES = np.int32([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


@pytest.mark.slow
def test_the_build_has_the_digits_of_float64(double, device):
    points, _, centers, radii = (values.astype(np.float64) for values in twins.random_scene(0))
    directions = double("maths.directions").fibonacci(32)
    scene = [put(points[None], wp.vec3d, device), None]
    scene += [put(centers[None], wp.vec3d, device), put(radii[None], wp.float64, device)]
    got = double("stages.visibility.directional").transmittance(*scene, directions).numpy()[0]
    np.testing.assert_allclose(got, twins.transmittance(points, centers, radii, directions), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_build_rasterizes_what_the_package_rasterizes(double, device, monkeypatch):
    """Depths are sorted by the bits of float32, and so they are here."""
    monkeypatch.setattr(wp.config, "optimization_level", None)  # the package's, since samples lie on edges
    clip_positions = random(0, 1, 60, 4).astype(np.float32) + np.float32([0, 0, 1, 2])
    faces = put(np.arange(60).reshape(20, 3), wp.vec3i, device)
    expected = rasterize(put(clip_positions, wp.vec4, device), faces, 40, 30).face_ids.numpy()
    rasterize_doubled = double("stages.raster.rasterization").rasterize
    got = rasterize_doubled(put(clip_positions, wp.vec4d, device), faces, 40, 30).face_ids.numpy()
    assert len(np.unique(expected)) > 10
    np.testing.assert_array_equal(got, expected)


# ---------------------------------------------------------------------------------------------- geometry


def test_gradients_of_vertex_normals_are_exact(double, device, check):
    faces = put(FACES, wp.vec3i, device)
    check(lambda p: double("stages.geometry.normals").vertex_normals(p, faces), (wp.vec3d, random(0, 2, 4, 3)))


@pytest.mark.parametrize("kind", ["quaternion", "axis-angle", "columns", "matrix"])
def test_gradients_of_rotation_matrices_are_exact(kind, double, device, check):
    dtype = {
        "quaternion": wp.vec4d,
        "axis-angle": wp.vec3d,
        "columns": double("stages.geometry.rotations").Vec6,
        "matrix": wp.mat33d,
    }[kind]
    parameters = random(0, 2, 3, *item_shape(dtype))
    if kind == "axis-angle":
        parameters[0] *= [[0], [1e-3], [0.3]]  # where the series is
    check(double("stages.geometry.rotations").rotation_matrices, (dtype, parameters))


@pytest.fixture
def poses():
    """Rotations, translations and scales of two instances of three bodies, as arguments."""
    rotations = np.stack([[twins.random_rotation(3 * i + j) for j in range(3)] for i in range(2)])
    return (wp.mat33d, rotations), (wp.vec3d, random(1, 2, 3, 3)), (wp.float64, 1 + random(2, 2, 3) ** 2)


def test_gradients_of_poses_of_points_are_exact(double, device, check, poses):
    bodies = put(np.int32([0, 2, 1, 2]), wp.int32, device)
    check(
        lambda r, *p: double("stages.geometry.poses").Poses(*p).points(r, bodies),
        (wp.vec3d, random(3, 1, 4, 3)),
        *poses,
    )


@pytest.mark.parametrize("quantity", [0, 1])
def test_gradients_of_poses_of_spheres_are_exact(quantity, double, device, check, poses):
    bodies = put(np.int32([0, 2, 1, 2]), wp.int32, device)
    spheres = (wp.vec3d, random(3, 1, 4, 3)), (wp.float64, random(4, 1, 4))

    def moved(centers, radii, *poses):
        return double("stages.geometry.poses").Poses(*poses).spheres(centers, radii, bodies)[quantity]

    check(moved, *spheres, *poses)


@pytest.mark.parametrize("quantity", ["points", "centers", "rigidity", "shear"])
def test_gradients_of_deformation_graphs_are_exact(quantity, double, device, check):
    graph = double("stages.geometry.deform").DeformationGraph.bind(
        random(0, 5, 3), random(1, 4, 3), count=2, device=device
    )
    matrices, translations = (wp.mat33d, random(2, 2, 4, 3, 3)), (wp.vec3d, random(3, 2, 4, 3))
    arguments = {"centers": [translations], "shear": [matrices]}.get(quantity, [matrices, translations])
    check(getattr(graph, quantity), *arguments)


@pytest.mark.parametrize("quantity", [0, 1])
def test_gradients_of_bound_spheres_are_exact(quantity, double, device, check):
    points, centers, radii = random(0, 30, 3), 0.2 * random(1, 4, 3), np.linspace(0.2, 0.5, 4)
    binding = double("stages.geometry.bound_spheres").SphereBinding.bind(
        points, np.arange(30), centers, radii, device=device
    )
    rest = (wp.vec3d, points[None]), (wp.vec3d, centers[None]), (wp.float64, radii[None])
    moved = wp.vec3d, points + 0.3 * random(2, 2, 30, 3)
    check(lambda *given: binding.moved(*given)[quantity], moved, *rest)


# ---------------------------------------------------------------------------------------------- visibility


@pytest.fixture
def spheres():
    """Receivers, normals, centers and radii, as arguments.

    Three receivers are at the surface of a sphere, within it, and where it fades out; each sees a sphere fade out below
    its horizon. All is some ten units wide, so that a step is small against the hundredth of a radius in which a cone's
    edge tolerances at the surface.
    """
    points, turns, centers, radii = (
        10 * a.astype(float) for a in twins.random_scene(3, vertex_count=5, sphere_count=4)
    )
    for sphere, distance in enumerate([1.004, 0.7, 0.15]):
        points[sphere] = centers[sphere] + distance * radii[sphere] * np.array([0.6, 0.8, 0])
    toward = centers[[3, 3, 3, 2, 1]] - points
    depth = 0.7 * radii[[3, 3, 3, 2, 1], None] / np.sum(toward**2, axis=1, keepdims=True) * toward
    normals = unit(np.cross(toward, turns)) * np.sqrt(1 - np.sum(depth**2, axis=1, keepdims=True)) - depth
    dtypes = (wp.vec3d, wp.vec3d, wp.vec3d, wp.float64)
    return [(dtype, values[None]) for dtype, values in zip(dtypes, (points, normals, centers, radii), strict=True)]


@pytest.mark.parametrize("count, softness", [(16, 1.2), (64, 0.35)])
def test_gradients_of_transmittance_are_exact(count, softness, double, device, check, spheres):
    directions = double("maths.directions").fibonacci(count)
    transmittance = double("stages.visibility.directional").transmittance
    points, (_, normals), *rest = spheres
    up = put(normals, wp.vec3d, device)
    check(lambda p, c, r: transmittance(p, up, c, r, directions, softness=softness), points, *rest)


def test_gradients_of_transmittance_of_receivers_with_footprints_are_exact(double, device, check, spheres):
    directions = double("maths.directions").fibonacci(16)
    transmittance = double("stages.visibility.directional").transmittance
    areas = np.array([[9.0, 0.5, 4.0, 1e-4, 0.0]])[..., None] * [1.0, -2.0, 0.5]  # spheres are some ten units wide
    areas = put(areas, wp.vec3d, device)
    points, (_, normals), *rest = spheres
    up = put(normals, wp.vec3d, device)
    check(lambda p, c, r: transmittance(p, up, c, r, directions, softness=0.1, footprints=areas), points, *rest)


@pytest.mark.slow
@pytest.mark.parametrize("order, log", [(ORDER, "cap"), (ORDER, "eigen"), (8, "eigen")])
def test_gradients_of_log_visibility_are_exact(order, log, double, device, check, spheres):
    accumulate = double("stages.visibility.log_sh").accumulate
    check(lambda *scene: accumulate(*scene, order=order, log=log), *spheres)


def test_gradients_of_log_visibility_without_a_horizon_are_exact(double, device, check, spheres):
    accumulate = double("stages.visibility.log_sh").accumulate
    check(lambda p, c, r: accumulate(p, None, c, r, order=ORDER), spheres[0], *spheres[2:])


@pytest.fixture
def cluster(double, monkeypatch):
    """Receivers, normals, centers and radii, as arguments: five spheres, of which four merge while they are seen so."""
    monkeypatch.setattr(double("stages.visibility.merging"), "MERGED_FROM", 4)
    centers, radii = 4 * random(7, 5, 3), 3 + random(8, 5) ** 2
    middle, _, extents = twins.merged_clusters(centers, radii)
    away = unit(random(9, 6, 3))
    angles = np.array([0.36, 0.4, 0.43, 0.46, 0.49, 0.3])[:, None]  # of 0.5, where it begins, and 0.35, where it ends
    normals = unit(random(10, 6, 3) - 3 * away)
    dtypes = (wp.vec3d, wp.vec3d, wp.vec3d, wp.float64)
    scene = (middle + extents / angles * away, normals, centers, radii)
    return [(dtype, values[None]) for dtype, values in zip(dtypes, scene, strict=True)]


def test_gradients_of_transmittance_of_spheres_that_merge_are_exact(double, device, check, cluster):
    directions = double("maths.directions").fibonacci(16)
    transmittance = double("stages.visibility.directional").transmittance
    check(lambda p, c, r: transmittance(p, None, c, r, directions, merging=1.0), cluster[0], *cluster[2:])


def test_gradients_of_log_visibility_of_spheres_that_merge_are_exact(double, device, check, cluster):
    accumulate = double("stages.visibility.log_sh").accumulate
    check(lambda *scene: accumulate(*scene, order=ORDER, merging=1.0), *cluster)


def test_gradients_of_radiance_of_proxies_are_exact(double, device, check):
    nodes = np.int32([0, 2, 3, 3]), np.int32([0, 1, 2])
    check(
        lambda b, g, v: double("stages.bounces.proxy_radiance").find_proxy_radiance(b, g, v, np.ones(3), *nodes),
        (wp.vec3d, random(0, 2, 3, 3)),
        (wp.float64, random(1, 2, 3, 5) ** 2),
        (wp.vec3d, random(2, 2, 3, 3) ** 2),
    )


@pytest.mark.slow
def test_gradients_of_light_from_spheres_are_exact(double, device, check, spheres):
    directions = double("maths.directions").fibonacci(16)
    sphere_light = double("stages.bounces.sphere_light").sphere_light
    proxy_radiance, unblocked = 1 + random(0, 1, 4, 16, 4) ** 2, 1 + random(1, 1, 5, 16) ** 2
    rest = (wp.vec4d, proxy_radiance), (wp.float64, 0.5 * unblocked), (wp.float64, unblocked)
    addend = wp.vec3d, random(2, *spheres[0][1].shape)

    def light(*scene_and_addend):
        *scene, addend = scene_and_addend
        return sphere_light(*scene, directions, softness=1.2, addend=addend)

    check(light, *spheres, *rest, addend)


@pytest.mark.slow
def test_gradients_of_light_from_spheres_above_their_tangent_planes_are_exact(double, device, check, spheres):
    """From points and normals of patches and centers of nodes to light."""
    directions = double("maths.directions").fibonacci(16)
    sphere_light = double("stages.bounces.sphere_light").sphere_light
    find_tangent_planes = double("stages.bounces.tangent_planes").find_tangent_planes
    proxy_radiance, transmittance = (
        wp.array(value, dtype=dtype, device=device)
        for value, dtype in ((1 + random(0, 1, 4, 16, 4) ** 2, wp.vec4d), (0.5 * random(1, 1, 5, 16) ** 2, wp.float64))
    )
    starts, patches = np.array([0, 1, 3, 4, 6]), np.array([0, 1, 2, 3, 4, 5])
    tolerances = np.stack([np.linspace(0, 0.6, 4), np.linspace(0.05, 0.4, 4)], axis=1)

    def light(points, normals, centers, radii, patch_points, patch_normals):
        planes = find_tangent_planes(patch_points, patch_normals, centers, starts, patches, tolerances)
        scene = points, normals, centers, radii, proxy_radiance, transmittance, None, directions
        return sphere_light(*scene, tangent_planes=planes)

    patch_points = spheres[2][1][:, [0, 1, 1, 2, 3, 3]] + random(4, 1, 6, 3)
    check(light, *spheres, (wp.vec3d, patch_points), (wp.vec3d, unit(random(5, 1, 6, 3))))


@pytest.mark.slow
def test_gradients_of_light_from_spheres_that_merge_are_exact(double, device, check, cluster):
    directions = double("maths.directions").fibonacci(16)
    sphere_light = double("stages.bounces.sphere_light").sphere_light
    rest = (wp.vec4d, 1 + random(0, 1, 6, 16, 4) ** 2), (wp.float64, 0.5 * random(1, 1, 6, 16) ** 2)
    check(lambda *scene: sphere_light(*scene, None, directions, merging=1.0), *cluster, *rest)


@pytest.fixture
def planes(double, device):
    """A ground and a wall, each of two faces, whose frames are given as such."""
    grids = double("stages.patches").find_plane_patches
    square = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]])
    faces = np.int32([[0, 1, 2], [0, 2, 3]])
    near = np.array([[-0.5, 0, -0.5], [0.5, 1, 0.5]])
    found = [grids(square, faces, is_two_sided=is_two_sided, others=near) for is_two_sided in (False, True)]
    module = double("stages.planes.plane_blockers")
    count = found[0].count
    bodies = [
        module.PlaneBody(patches.grid, square, faces, 4 * number, number * count, True)
        for number, patches in enumerate(found)
    ]
    return module.PlaneBlockers.from_bodies(bodies, 3 * count, 8, device=device)


FRAMES = np.array([[[0, 0, 0], [1, 0, 0], [0, 0, -1], [0.1, 0.3, -1.1], [0.9, 0, 0], [0, 0.9, 0]]])


def plane_receivers():
    """Two above the ground in front of the wall, and one below the ground."""
    return np.array([[[0.3, 0.4, 0.2], [-0.7, 0.9, -0.4], [0.2, -0.3, 0.6]]]), unit(random(3, 1, 3, 3))


@pytest.mark.slow
def test_gradients_of_light_of_planes_are_exact(double, planes, check):
    directions = double("maths.directions").fibonacci(16)
    plane_light = double("stages.bounces.plane_light").plane_light
    points, normals = plane_receivers()
    radiosity = np.random.default_rng(0).uniform(size=(1, planes.texels_of_patches.shape[1], 3))
    given = (wp.vec3d, points), (wp.vec3d, normals), (wp.float64, random(1, 1, 3, 16) ** 2), (wp.vec3d, FRAMES)
    openness = np.random.default_rng(1).uniform(0.02, 1, size=radiosity.shape[:2])[..., None] * np.ones(3)
    fixed, is_open = (wp.array(value, dtype=wp.vec3d, device=planes.grids.device) for value in (radiosity, openness))
    texels = double("stages.bounces.plane_texels").find_texels(fixed, is_open, planes)
    addend = wp.vec3d, random(2, *points.shape)

    def light(points, normals, transmittance, frames, addend):
        return plane_light(points, normals, transmittance, frames, texels, planes, directions, addend=addend)

    check(light, *given, addend)


def test_gradients_of_transmittance_past_planes_are_exact(double, planes, check):
    directions = double("maths.directions").fibonacci(16)
    find, past = double("stages.planes.coverage").plane_coverage, double("stages.joint_coverage").transmittance_past
    given = (wp.vec3d, plane_receivers()[0]), (wp.float64, 0.1 + random(1, 1, 3, 16) ** 2), (wp.vec3d, FRAMES)
    check(lambda p, t, f: past(t, find(p, f, planes, directions)), *given)


@pytest.fixture
def holed_planes(double, device):
    """A triangle, which leaves half of its rectangle open, and a square."""
    square = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]])
    faces, find = np.int32([[0, 1, 2], [0, 2, 3]]), double("stages.patches").find_plane_patches
    module = double("stages.planes.plane_blockers")
    bodies = []
    for number, own in enumerate((faces[:1], faces)):
        patches = find(square, own, is_two_sided=False)
        bodies.append(module.PlaneBody(patches.grid, square, own, 4 * number, 0, True))
    return module.PlaneBlockers.from_bodies(bodies, 0, 8, device=device)


@pytest.mark.parametrize("name", ["planes", "holed_planes"])
def test_gradients_of_coverage_of_light_in_cells_are_exact(name, double, request, check):
    planes, directions = request.getfixturevalue(name), double("maths.directions").fibonacci(16)
    find = double("stages.planes.partial_cells").coverage_of_light
    samples = unit(directions[:, None] + 0.2 * random(4, 16, 8, 3))
    covered = np.random.default_rng(1).uniform(-0.1, 1.1, size=(1, 3, 16, 4))
    given = (wp.vec3d, plane_receivers()[0]), (wp.vec4d, covered), (wp.vec3d, FRAMES)
    check(lambda p, c, f: find(p, c, f, planes, directions, samples), *given)


def test_gradients_of_coverage_by_convex_parts_are_exact(double, check, device):
    """A wedge and a tetrahedron, which share a body, and a second tetrahedron."""
    module, find = double("stages.convex.convex_blockers"), double("maths.convex").find_convex_parts
    cover = double("stages.convex.coverage").part_coverage
    directions = double("maths.directions").fibonacci(32)
    wedge = np.array([[0, 0, 0], [2, 0, 0.1], [0.1, 1, 0], [0, 0, 1], [2, 0, 1.1], [0.1, 1, 1]])
    sides = np.int32([[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
    shifts = np.array([[-1.2, -0.4, 0.6], [1.1, 0.9, 0.4], [0.3, -1.5, -0.2]])
    corners = [wedge, 0.6 * VERTICES, VERTICES]
    first, second, third = (
        find(points, faces)[0] for points, faces in zip(corners, (sides, FACES, FACES), strict=True)
    )
    bodies = [
        module.ConvexBody([first, second._replace(corners=second.corners + 6)], 0),
        module.ConvexBody([third], 10),
    ]
    blockers = module.ConvexBlockers.from_bodies(bodies, 14, device=device)
    positions = np.concatenate([points + shift for points, shift in zip(corners, shifts, strict=True)])[None]
    points = np.array([[[0.1, 2.2, 0.3], [-0.4, 0.7, -1.9], [2.5, 0.2, 1.5]]])
    given = (wp.vec3d, points), (wp.vec3d, positions)
    covered = cover(
        put(points, wp.vec3d, device), blockers.place(put(positions, wp.vec3d, device)), blockers, directions
    ).numpy()[..., 0]
    assert ((covered > 0) & (covered < 1)).mean() > 0.2
    check(lambda p, v: cover(p, blockers.place(v), blockers, directions), *given)


def slats_beside_each_other():
    """Vertices and faces of three."""
    slat = np.array([[x, y, z] for x in (-1.0, 1) for y in (-0.1, 0.1) for z in (-0.3, 0.3)])
    sides = np.int32([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]])
    sides = np.concatenate([sides, np.int32([[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])])
    slats = np.concatenate([slat + [0.05 * k, 0.31 * k, 0.02 * k] for k in range(3)])
    return slats, np.concatenate([sides + 8 * k for k in range(3)])


def test_gradients_of_coverage_by_compounds_are_exact(double, check, device):
    """Slats, which receivers see beside and behind each other, and a tetrahedron; the hull covers some cells."""
    module, find = double("stages.convex.convex_blockers"), double("maths.convex").find_convex_parts
    cover = double("stages.convex.coverage").part_coverage
    directions = double("maths.directions").fibonacci(32)
    slats, faces = slats_beside_each_other()
    parts = find(slats, faces)
    hull = double("maths.hull").find_hull(slats, parts)
    bodies = [module.ConvexBody(parts, 0, True, hull), module.ConvexBody(find(VERTICES, FACES), 24)]
    blockers = module.ConvexBlockers.from_bodies(bodies, 28, device=device)
    positions = np.concatenate([slats, 0.5 * VERTICES + [1.3, 0.2, 0.1]])[None]
    points = np.array([[[0.3, 1.5, 0.8], [-0.6, -0.8, -0.7], [1.9, 0.9, 0.9]]])
    arrays = put(points, wp.vec3d, device), put(positions, wp.vec3d, device)

    def cover_points(points, positions, some=blockers):
        return cover(points, some.place(positions), some, directions)

    one_piece = module.ConvexBody([part._replace(piece=0) for part in parts], 0)
    unbounded = module.ConvexBlockers.from_bodies([one_piece, bodies[1]], 28, device=device)
    shares, sums = cover_points(*arrays).numpy()[..., 0], cover_points(*arrays, unbounded).numpy()[..., 0]
    assert ((shares > 0) & (shares < 1)).mean() > 0.15
    assert ((shares > 0) & (shares < 1) & (shares < sums - 0.01)).sum() > 3
    check(cover_points, (wp.vec3d, points), (wp.vec3d, positions))


def test_gradients_of_transmittance_past_parts_to_samples_are_exact(double, check, device):
    """Two walls of a tube of four panels, past whose edges and seams receivers see a lamp, and a tetrahedron."""
    module, find = double("stages.convex.convex_blockers"), double("maths.convex").find_convex_parts
    angles = np.pi / 2 * np.arange(4)
    ring = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    tube = np.concatenate([ring, 1.2 * ring + [0, 0.8, 0]])
    faces = np.int32([face for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)) for face in ((i, j, i + 4), (j, j + 4, i + 4))])
    positions = np.concatenate([tube, 0.3 * VERTICES + [1.6, 0.4, 0.2]])[None]
    bodies = [module.ConvexBody(find(tube, faces), 0), module.ConvexBody(find(VERTICES, FACES), 8)]
    assert [len(body.parts) for body in bodies] == [4, 1]
    blockers = module.ConvexBlockers.from_bodies(bodies, 12, device=device)
    check_transmittance_to_samples(double, check, device, blockers, positions)


def test_gradients_of_transmittance_past_a_compound_to_samples_are_exact(double, check, device):
    """Slats before a lamp, whose hull hides less of some samples than they do together."""
    module, find = double("stages.convex.convex_blockers"), double("maths.convex").find_convex_parts
    slats, faces = slats_beside_each_other()
    slats = 0.6 * slats + [1.2, 0.3, 0.2]
    parts = find(slats, faces)
    hull = double("maths.hull").find_hull(slats, parts)
    found = []
    for body in (module.ConvexBody(parts, 0, True, hull), module.ConvexBody([p._replace(piece=0) for p in parts], 0)):
        blockers = module.ConvexBlockers.from_bodies([body], len(slats), device=device)
        found.append(check_transmittance_to_samples(double, check, device, blockers, slats[None]))
    assert (found[0] > found[1] + 0.01).sum() > 3


def check_transmittance_to_samples(double, check, device, blockers, positions):
    """Check the gradients of the transmittance from four receivers to the samples of a lamp; returns it."""
    emitters, past = double("stages.emitters.samples"), double("stages.emitters.convex_transmittance")
    points = np.array([[[2.6, 0.3, 0.1], [0.2, 1.7, 1.9], [-2.1, 1.1, 0.4], [2.2, 1.5, 0.9]]])
    middles = np.stack([0.25 * np.cos(np.arange(16)), 0.3 + 0.05 * np.arange(16), 0.25 * np.sin(np.arange(16))], axis=1)
    areas = 0.3 * unit(middles - [0, 0.6, 0])
    given = (wp.vec3d, points), (wp.vec3d, middles[None]), (wp.vec3d, areas[None]), (wp.vec3d, positions)
    constants = (wp.vec3d, unit(-points)), (wp.vec4d, np.zeros((1, 1, 4))), (wp.vec4d, [[[0, 0.6, 0, 1]]])
    normals, bundles, balls = (put(values, dtype, device) for dtype, values in constants)
    span = emitters.EmitterSpan(0, 0, 16, True)

    def transmittance(points, middles, areas, positions):
        samples = emitters.PlacedSamples(middles, areas, None, None, bundles, balls)
        around = blockers.place(positions), blockers, (-1, -1)
        return past.find_log_transmittance_of_parts(points, normals, samples, span, *around)

    found = np.exp(transmittance(*(put(values, dtype, device) for dtype, values in given)).numpy())
    assert ((found > 0.01) & (found < 0.99)).mean() > 0.1
    check(transmittance, *given)
    return found


def test_gradients_of_transmittance_past_two_blockers_are_exact(double, check):
    """Coverages whose moments are as long as such may be, and as short, at any angle."""
    rng, past = np.random.default_rng(2), double("stages.joint_coverage").transmittance_past
    coverages = []
    for _ in range(2):
        share, moment = rng.uniform(0.02, 0.98, (1, 2, 16, 1)), unit(rng.normal(size=(1, 2, 16, 3)))
        length = rng.uniform(0, 0.9, share.shape) * share * (1 - share)
        coverages.append((wp.vec4d, np.concatenate([share, length * moment], axis=-1)))
    check(past, (wp.float64, rng.uniform(size=(1, 2, 16))), *coverages)


def test_gradients_of_projected_areas_are_exact(double, planes, check, device):
    directions = double("maths.directions").fibonacci(16)
    areas, sparse = double("stages.bounces.projected_areas"), double("stages.sparse").SparseMatrix
    points, normals = plane_receivers()
    spheres, radii = np.int32([1, 0, 1]), np.array([[0.3, 0.5]])
    given = (wp.vec3d, points), (wp.vec3d, normals), (wp.float64, radii), (wp.float64, random(1, 1, 3, 2) ** 2)
    check(lambda p, n, r, *f: areas.tilt_normals_off_planes(p, n, r, spheres, *f, planes), *given, (wp.vec3d, FRAMES))
    mean = sparse.from_matrix(np.array([[0.7, 0.3, 0], [0, 0, 1]]), device=device)
    rest = (wp.vec3d, normals), (wp.float64, random(1, 1, 3, 16) ** 2)
    check(lambda n, t: areas.find_projected_areas(n, t, mean, directions), *rest)


def test_how_much_patch_samples_count(double, device, check):
    patch_samples, radiosity = double("stages.bounces.patch_weights"), double("stages.bounces.radiosity")
    directions, owners = double("maths.directions").fibonacci(16), np.array([0, 0, 2])
    mean = radiosity.mean_over_patch_samples(owners, np.array([0.3, 0.7, 1]), 3, device=device)
    past_self = np.random.default_rng(1).random((1, 3, 16))

    def shown(albedo, light, normals, past_self, past_all):
        means = patch_samples.find_mean_transmittance(normals, past_self, past_all, directions)
        shares, weights = patch_samples.find_patch_weights(means, mean, owners)
        return radiosity.reflect(weights, radiosity.patch_radiosity(albedo, light, mean, shares))

    colors = (wp.vec3d, random(2, 1, 3, 3)), (wp.vec3d, random(3, 2, 3, 3))
    check(shown, *colors, (wp.vec3d, unit(random(4, 1, 3, 3))), (wp.float64, past_self), (wp.float64, past_self**2))


def test_gradients_of_radiosity_and_self_light_are_exact(double, device, check):
    sparse, self_light = double("stages.sparse"), double("stages.bounces.self_light").self_light
    radiosity = double("stages.bounces.radiosity")
    mean = radiosity.mean_over_patch_samples(np.array([0, 0, 2]), np.array([0.3, 0.7, 1]), 3, device=device)
    factors = sparse.SparseMatrix.from_matrix(np.abs(random(0, 5, 3)), device=device)
    rows = put(np.array([[[0, 1, 2], [4, 4, 3]]]), wp.vec3i, device)

    def light(albedo, shading, weights, addend):
        outgoing = radiosity.patch_radiosity(albedo, shading, mean)
        return self_light(sparse.multiply(factors, outgoing), rows, weights, addend)

    sent = (wp.vec3d, random(1, 1, 3, 3)), (wp.vec3d, random(2, 2, 3, 3))
    check(light, *sent, (wp.vec3d, random(3, 1, 2, 3)), (wp.vec3d, random(4, 1, 2, 3)))


def logs(*sizes):
    """Log-visibility of one instance, of these norms."""
    rows = random(0, 1, len(sizes), ORDER**2)
    return rows * np.array(sizes)[:, None] / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.mark.parametrize("base", ["quadratic", "linear", "optimal_linear"])
def test_gradients_of_the_exponential_are_exact(base, double, check):
    exponentiate = double("stages.visibility.exponential").exponentiate
    check(lambda f: exponentiate(f, base=base, threshold=0.5), (wp.float64, logs(0.05, 0.3, 1.7, 2.4, 3)))


@pytest.mark.parametrize("base", ["quadratic", "linear", "optimal_linear"])
def test_gradients_of_the_exponential_where_squarings_are_held_are_exact(base, double, check):
    exponentiate = double("stages.visibility.exponential").exponentiate
    with pytest.warns(UserWarning, match="held back"):
        check(lambda f: exponentiate(f, base=base, threshold=0.5), (wp.float64, logs(5.3, 9, 6)))


# ---------------------------------------------------------------------------------------------- shading


def test_gradients_of_harmonic_transfer_are_exact(double, device, check):
    visibility, normals = (wp.float64, random(0, 1, 3, ORDER**2)), (wp.vec3d, unit(random(1, 1, 3, 3)))
    sh_transfer = double("stages.light.transfer").sh_transfer
    check(lambda v, n: sh_transfer(v, n, order=ORDER), visibility, normals)
    check(lambda n: sh_transfer(None, n, order=ORDER), normals)


def test_gradients_of_directional_transfer_are_exact(double, device, check):
    directions = double("maths.directions").fibonacci(16)
    transmittance, normals = random(0, 1, 3, 16) ** 2, unit(random(1, 1, 3, 3))
    check(
        lambda t, n: double("stages.light.transfer").directional_transfer(t, n, directions),
        (wp.float64, transmittance),
        (wp.vec3d, normals),
    )


@pytest.mark.parametrize("count", [4, 36])
def test_gradients_of_shading_are_exact(count, double, device, check):
    check(
        double("stages.light.shading").shade, (wp.float64, random(0, 2, 3, count)), (wp.vec3d, random(1, 2, count, 3))
    )


def test_gradients_of_shading_under_the_same_light_are_exact(double, device, check):
    check(double("stages.light.shading").shade, (wp.float64, random(0, 2, 3, 4)), (wp.vec3d, random(1, 1, 4, 3)))


# ---------------------------------------------------------------------------------------------- images

SIZE = (8, 6)  # of a picture [pixels]


@pytest.fixture
def view(double):
    """A tetrahedron before a camera, as arguments: its vertices and the matrix to clip space."""
    camera = double("assets.camera").Camera.look_at((0.4, 0.9, 3), (0.1, 0, 0), size=SIZE)
    return (wp.vec3d, VERTICES[None]), (wp.mat44d, camera.clip_matrix()[None])


@pytest.fixture
def clip(view):
    """The same vertices in clip space."""
    (_, vertices), (_, matrices) = view
    return wp.vec4d, np.concatenate([vertices, np.ones((1, 4, 1))], axis=-1) @ matrices[0].T


def test_gradients_of_projection_are_exact(double, check, view):
    check(double("stages.raster.project").to_clip, *view)


def test_gradients_of_cameras_are_exact(double, check):
    rotations = np.stack([twins.random_rotation(0), twins.random_rotation(1)])
    check(
        lambda *camera: double("stages.raster.project").compose_clip_matrices(*camera, size=SIZE),
        (wp.mat33d, random(0, 1, 3, 3)),
        (wp.mat33d, rotations),
        (wp.vec3d, random(1, 2, 3)),
    )


def test_gradients_of_interpolation_are_exact(double, device, check, clip):
    faces = put(FACES, wp.vec3i, device)
    face_ids = double("stages.raster.rasterization").rasterize(put(clip[1], wp.vec4d, device), faces, *SIZE).face_ids
    assert len(np.unique(face_ids.numpy())) == 3  # two sides and the background

    def draw(clip_positions, attributes):
        weights = double("stages.raster.barycentrics").find_barycentrics(face_ids, faces, clip_positions)
        return double("stages.raster.interpolation").interpolate(
            double("stages.raster.rasterization").Fragments(face_ids, weights), faces, attributes
        )

    check(draw, clip, (wp.vec2d, random(0, 1, 4, 2)))


@pytest.mark.slow
def test_gradients_of_textures_are_exact(double, device, check, clip):
    """Two faces have a texture that repeats and is finer than the picture; two have colors at their vertices."""
    faces = put(FACES, wp.vec3i, device)
    texture_of_face = put([0, -1, -1, 0], wp.int32, device)

    def reflect(clip_positions, uvs, vertex_albedo, image):
        fragments = double("stages.raster.rasterization").rasterize(clip_positions, faces, *SIZE)
        textures = double("stages.textures.pyramid").mip_pyramids([image])
        footprints = double("stages.textures.footprint").find_footprints(
            fragments, faces, clip_positions, uvs, faces, texture_of_face, textures
        )
        return double("stages.textures.sample").sample_albedo(fragments, faces, vertex_albedo, textures, footprints)

    uvs, vertex_albedo, image = 2 * random(0, 1, 4, 2), random(1, 1, 4, 3), random(2, 1, 7, 5, 3)
    check(reflect, clip, (wp.vec2d, uvs), (wp.vec3d, vertex_albedo), (wp.vec3d, image))


@pytest.mark.slow
@pytest.mark.parametrize("across", [0, 1], ids=["upright", "level"])
def test_gradients_of_a_band_are_exact(double, device, check, across):
    """Of edges that lean, how the lean changes is left out of the gradient, and at corners how areas overlap."""
    low, high = (2.3, 5.6) if across == 0 else (1.2, 3.4)  # [pixels]; along the other axis the band leaves the image
    corners = np.array([[low, -3.0], [high, -3.0], [high, 12.0], [low, 12.0]])[:, :: 1 if across == 0 else -1]
    depths = np.array([[1.0], [1.5], [2.0], [1.2]])
    clip_positions = np.hstack([depths * (2 * corners / SIZE - 1), np.full((4, 1), 0.1), depths])[None]
    sides = np.int32([[0, 1, 2], [0, 2, 3]])
    faces = put(sides, wp.vec3i, device)
    neighbors = put(double("maths.adjacency").edge_neighbors(sides), wp.vec3i, device)

    def smooth(image, clip_positions):
        fragments = double("stages.raster.rasterization").rasterize(clip_positions, faces, *SIZE)
        silhouettes = double("stages.silhouettes.silhouettes").find_silhouettes(
            fragments, faces, neighbors, clip_positions
        )
        return double("stages.silhouettes.smooth").smooth_silhouettes(image, silhouettes, clip_positions)

    check(smooth, (wp.vec3d, random(0, 1, SIZE[1], SIZE[0], 3)), (wp.vec4d, clip_positions))


def test_gradients_of_film_are_exact(double, device, check, clip):
    faces = put(FACES, wp.vec3i, device)
    face_ids = double("stages.raster.rasterization").rasterize(put(clip[1], wp.vec4d, device), faces, *SIZE).face_ids

    def sample_radiance(clip_positions, shading, albedo):
        weights = double("stages.raster.barycentrics").find_barycentrics(face_ids, faces, clip_positions)
        return double("stages.image.film").average(
            double("stages.image.film").sample_radiance(
                double("stages.raster.rasterization").Fragments(face_ids, weights), faces, shading, albedo
            ),
            2,
        )

    albedo = random(1, 1, SIZE[1], SIZE[0], 3)
    check(sample_radiance, clip, (wp.vec3d, random(0, 2, 4, 3)), (wp.vec3d, albedo))


# ---------------------------------------------------------------------------------------------- all stages


PLACES, SCALES = [(0, 0, 0), (1.8, 0.7, 0.3)], [1, 0.4]  # of a ground and a body
LIGHT = random(0, 4, 3) + 5 * np.eye(4, 1)


@pytest.mark.parametrize("sharp", [False, True])
def test_gradients_of_self_visibility_under_a_rotation_are_exact(sharp, double, device):
    """From rotations and places in faces to transmittance, of rows of which nothing is known."""
    rng = np.random.default_rng(5)
    lookup, gather = double("stages.self_visibility.lookup"), double("stages.self_visibility.gather")
    directions = double("maths.directions").fibonacci(16)
    spreads = np.full(16, 0.1) if sharp else None
    kernels = lookup.find_body_kernels((0,), (4096,), directions, spreads, wp.get_device(device))
    bits = wp.array(rng.integers(0, 2**32, (6, 128), dtype=np.uint32), device=device)
    cells = wp.array(rng.integers(0, 256, (6, 512), dtype=np.uint8), device=device)
    tables = gather.BodyTables.of_rows([double("stages.self_visibility.trace").VisibilityRows(bits, cells)])
    normals = wp.array(rng.normal(size=(1, 5, 3)), dtype=wp.vec3d, device=device)
    corners = wp.array(rng.integers(0, 6, (1, 5, 3)), dtype=wp.vec3i, device=device)

    def see(rotations, weights):
        places = double("stages.self_visibility.probes").ProbeWeights(corners, weights)
        weights_of_cells = lookup.find_resampling_weights(rotations, kernels)
        return gather.gather_self_transmittance(normals, places, weights_of_cells, kernels, tables)

    matrices = torch.linalg.qr(torch.tensor(rng.normal(size=(2, 1, 3, 3))))[0]
    given = [values.to(device).requires_grad_() for values in (matrices, torch.tensor(rng.uniform(size=(1, 5, 3))))]
    apply = double("torch").apply
    assert torch.autograd.gradcheck(
        lambda *tensors: apply(see, *tensors, dtypes=(wp.mat33d, wp.vec3d)), given, nondet_tol=CUDA_SUMS, **EXACT
    )


@pytest.fixture
def make_renderer(double, device):
    """Make what torch sees of a scene: a ground that fills the picture, and beside that a body that shadows it."""
    ground = double("assets.primitives").plane(size=5, segments=2)
    body = double("assets.mesh").Mesh(VERTICES, FACES)
    spheres = double("spheres").Spheres([[0, 0.2, 0], [0.2, 0.5, 0.1]], [0.6, 0.5])
    camera = double("assets.camera").Camera.look_at((0.3, 3, 0.5), (0.1, 0, 0), fov_y=30, size=SIZE)

    def make(method, receivers):
        bodies = [
            double("scene.scene").Body(ground, blockers=0, receivers=receivers),
            double("scene.scene").Body(body, blockers=spheres, translation=PLACES[1], scale=SCALES[1]),
        ]
        settings = {"method": method, "directions": 16, "order": ORDER, "self_shadows": "spheres"}  # rays are float32
        visibility = double("scene.scene").Visibility.of(settings)
        whole = double("scene.scene").Scene(
            bodies=bodies, light=LIGHT, camera=camera, visibility=visibility, supersampling=1
        )
        place, basis = wp.device_to_torch(device), double("assets.basis").HarmonicBasis(2)
        return double("torch").TorchRenderer(whole, device=place, basis=basis)

    return make


def variables(renderer, *arguments):
    """Tensors that require a gradient."""
    options = {"dtype": torch.float64, "device": renderer.device, "requires_grad": True}
    return [torch.tensor(values, **options) for values in arguments]


@pytest.mark.slow
@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_gradients_of_a_ground_in_moving_shadows_are_exact(method, receivers, double, make_renderer, monkeypatch):
    """From poses, cameras, light and reflectance to the pixels; no silhouette is in view.

    Surfaces pull by the faces at the points of samples, of which images are made: mean slopes are no derivatives.
    """
    sample_radiance = double("stages.image.film").sample_radiance
    monkeypatch.setattr(
        double("pipeline.views.view"), "moving_radiance", lambda *inputs: (sample_radiance(*inputs[:4]), None)
    )
    renderer, rotation_matrices = make_renderer(method, receivers), double("torch").rotation_matrices
    camera = renderer.scene.camera
    towards, offset, intrinsics = variables(renderer, camera.rotation, camera.translation, camera.intrinsics)

    def draw(turns, translations, scales, camera_turn, light, color):
        geometry = renderer.placed(rotation_matrices(turns), translations, scales)
        view = renderer.clip_matrices(rotation_matrices(camera_turn) @ towards, offset, intrinsics)
        return renderer(light, albedo=[color, None], geometry=geometry, clip_matrices=view)

    turns, camera_turn, color = 0.1 * random(1, 2, 3), 0.02 * random(2, 3), random(3, 3) ** 2
    tensors = variables(renderer, turns, PLACES, SCALES, camera_turn, LIGHT, color)
    assert (draw(*tensors)[..., 3] == 1).all()
    assert torch.autograd.gradcheck(draw, tensors, nondet_tol=CUDA_SUMS, **EXACT)


# ---------------------------------------------------------------------------------------------- gloss

EYE = np.array([[1.2, 0.1, 0.2, 0.3], [0, 1.4, 0.1, -0.2], [0.1, 0.2, 1.0, 0.5], [0.1, -0.2, 0.9, 3.0]])


@pytest.fixture
def glossy():
    """Points, normals that see the camera, and roughness, as arguments."""
    points = random(0, 1, 2, 3)
    normals = unit(unit(twins.eye_of(EYE) - points) + 0.5 * np.tanh(random(1, 1, 2, 3)))
    return (wp.vec3d, points), (wp.vec3d, normals), (wp.float64, 0.5 + 0.2 * np.tanh(random(2, 1, 2)))


@pytest.mark.parametrize("quantity", ["directions", "weights", "blurs", "cosines"])
def test_gradients_of_samples_of_lobes_are_exact(quantity, double, device, check, glossy):
    sample = double("stages.gloss.lobes").sample_lobes
    check(lambda *arguments: getattr(sample(*arguments, 4), quantity), *glossy, (wp.mat44d, EYE[None]))


def test_gradients_of_prefiltered_light_are_exact(double, device, check):
    module = double("stages.gloss.prefilter")
    texels = put(module.prefilter(random(0, 8, 16, 3) ** 2)[None], wp.vec3d, device)
    towards, blurs = unit(random(1, 1, 2, 3, 3)), np.abs(random(2, 1, 2, 3)) + 0.1
    check(lambda d, b: module.look_up_light(texels, d, b), (wp.vec3d, towards), (wp.float64, blurs))


def test_gradients_of_transmittance_of_lobes_are_exact(double, device, check, glossy):
    module, cells = double("stages.gloss.transmittance"), double("maths.directions").fibonacci(16)
    towards = unit(glossy[1][1][:, :, None] + 0.3 * random(4, 1, 2, 2, 3))
    arguments = (wp.float64, random(3, 1, 2, 16)), glossy[1], (wp.vec3d, towards)
    check(lambda *arguments: module.interpolate_transmittance(*arguments, cells), *arguments)


def test_gradients_of_sharp_transmittance_are_exact(double, check):
    check(double("stages.gloss.transmittance").sharpen, (wp.float64, np.abs(random(3, 2, 3, 4))))


def test_gradients_of_weights_above_faces_are_exact(double, device, check):
    """Of samples above their face, on its edge of light, and below it; on either side."""
    module = double("stages.gloss.face_horizon")
    fragments = double("stages.raster.rasterization").Fragments(put(np.int32([[0, 0]]), wp.int32, device), None)
    faces, normals = put(np.int32([[0, 1, 2]]), wp.vec3i, device), put([[[0, 0, 1], [0, 0, -1]]], wp.vec3d, device)
    corners = np.array([[[-1, -1, 0], [1, -1, 0.01], [0, 1, -0.01]]])
    heights = np.array([[[0.5, -0.02, -0.06, -0.5], [-0.5, 0.03, 0.07, 0.5]]])
    directions = unit(np.concatenate([random(0, 1, 2, 4, 2), 1.5 * heights[..., None]], axis=3))

    def weigh(positions, directions, weights):
        return module.weigh_by_faces(fragments, faces, positions, normals, directions, weights)

    check(weigh, (wp.vec3d, corners), (wp.vec3d, directions), (wp.vec2d, random(1, 1, 2, 4, 2)))


@pytest.mark.parametrize("quantity", [0, 1])
def test_gradients_of_suns_in_lobes_are_exact(quantity, double, device, check, glossy):
    """One in the middle of a lobe, one that is wide beside it, one at a slant."""
    module, lobes = double("stages.gloss.suns"), double("stages.gloss.lobes")
    views, (_, normals) = unit(twins.eye_of(EYE) - glossy[0][1])[0], glossy[1]
    middle = 2 * (views[0] @ normals[0, 0]) * normals[0, 0] - views[0]
    directions = unit(np.stack([middle, middle + 0.3 * random(5, 3), normals[0, 0] + 0.9 * views[1]]))
    suns = module.Suns(directions, random(6, 3, 3) ** 2, np.array([0.01, 0.6, 0.001]))
    spread = [(wp.vec3d, 0.2 * random(seed, 1, 2, 3)) for seed in (7, 8)]

    def add(points, normals, roughness, cameras, along_x, along_y, transmittance, *lobe_light):
        varied = lobes.NormalSpread(along_x, along_y)
        shapes = lobes.sample_lobes(points, normals, roughness, cameras, 4, varied).lobes
        return module.add_suns(module.LobeLight(*lobe_light), shapes, suns, transmittance)[quantity]

    lights = [(wp.vec3d, random(seed, 1, 2, 3)) for seed in (9, 10)]
    check(add, *glossy, (wp.mat44d, EYE[None]), *spread, (wp.float64, random(11, 1, 2, 6)), *lights)


def test_gradients_of_transmittance_towards_suns_are_exact(double, device, check, glossy):
    module, cells = double("stages.gloss.suns"), double("maths.directions").fibonacci(16)
    suns = module.Suns(cells[[3, 9]], np.ones((2, 3)), np.ones(2))
    values = (wp.float64, 0.1 + 0.5 * random(3, 1, 2, 16) ** 2)
    check(lambda *arguments: module.find_sun_transmittance(*arguments, suns, cells, cells), values, glossy[1])


@pytest.mark.parametrize("quantity", [0, 1])
def test_gradients_of_sums_of_lobes_are_exact(quantity, double, device, check):
    sums = double("stages.gloss.reflection").sum_lobes
    weights, light = (wp.vec2d, random(0, 1, 2, 3, 2)), (wp.vec3d, random(1, 2, 2, 3, 3))
    share = wp.float64, random(2, 1, 2, 3)
    blocked, mirrored = (wp.vec3d, random(3, 1, 2, 3)), (wp.vec3d, random(4, 1, 2, 3, 3))
    check(lambda *arguments: sums(*arguments)[quantity], weights, light, share, blocked, mirrored)


@pytest.mark.parametrize("quantity", ["radiance", "fresnel_weights", "blurs"])
def test_gradients_of_the_light_of_mirrored_bodies_are_exact(quantity, double, device, check):
    """Of samples that meet no face, one or two, whose last ray meets the sky, a body, or leaves below the face."""
    module = double("stages.gloss.mirrored")
    face_ids = np.int32([[[[0, 0, -1], [1, -1, 1]], [[1, -1, -1], [0, -1, -1]]]])
    hits = face_ids, np.abs(random(0, 1, 2, 2, 3, 3)), unit(random(1, 1, 2, 2, 3, 3))
    dtypes = wp.int32, wp.vec3d, wp.vec3d, wp.int32, wp.vec3d
    last_rays, points = np.int32([[[0, 1, 1], [2, 2, 0]]]), np.zeros((1, 2, 3, 3))
    hits = double("stages.gloss.lobe_hits").LobeHits(
        *(put(values, dtype, device) for values, dtype in zip((*hits, last_rays, points), dtypes, strict=True))
    )
    faces = put(np.int32([[0, 1, 2], [1, 3, 2]]), wp.vec3i, device)

    def mix(roughness, directions, blurs, albedo, metallic, mean, share, radiosity):
        mirrored = module.mirror(hits, faces, roughness, directions, blurs)
        light = mirrored.directions, mean, share, radiosity
        mixed = module.mix_mirrored(hits, faces, albedo, metallic, mirrored.fresnel_weights, *light)
        return mixed if quantity == "radiance" else getattr(mirrored, quantity)

    scalars = [(wp.float64, 0.5 + 0.2 * np.tanh(random(seed, 1, 4))) for seed in (2, 3)]
    samples = (wp.vec3d, unit(random(4, 1, 2, 3, 3))), (wp.float64, 0.2 + np.abs(random(5, 1, 2, 3)))
    blockers = (wp.vec3d, random(7, 1, 2, 3)), (wp.float64, random(8, 1, 2, 3)), (wp.vec3d, random(9, 1, 4, 3))
    check(mix, scalars[0], *samples, (wp.vec3d, random(6, 1, 4, 3)), scalars[1], *blockers)


def test_gradients_of_the_radiosity_of_mirrored_planes_are_exact(double, planes, device, check):
    """Of the front of a ground, and of both sides of a wall."""
    module, texels = double("stages.gloss.mirrored"), double("stages.planes.face_texels")
    square, faces = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]]), np.int32([[0, 1, 2], [0, 2, 3]])
    bodies = [texels.PlaneBody(None, square, faces, 4 * number, 0, True) for number in range(2)]
    grid = double("stages.planes.grid").find_grid(square, faces, is_two_sided=False)[0]
    of_faces = texels.find_face_texels(planes, [body._replace(grid=grid) for body in bodies], [0, 2], 4, 8)
    sides = np.int32([[[0, 3, 7]]])
    dtypes = wp.int32, wp.vec3d, wp.vec3d, wp.int32, wp.vec3d
    hits = sides[None], np.array([[[[[0.3, 0.5, 0.2], [0.1, 0.3, 0.6], [0.4, 0.35, 0.25]]]]]), np.zeros((1, 1, 1, 3, 3))
    hits = double("stages.gloss.lobe_hits").LobeHits(
        *(put(v, t, device) for v, t in zip((*hits, 1 + 0 * sides, hits[2][0]), dtypes, strict=True))
    )
    all_faces = put(np.concatenate([faces, faces + 4] * 2), wp.vec3i, device)
    constants = put(random(0, 1, 8, 3), wp.vec3d, device), put(np.zeros((1, 8)), wp.float64, device)
    light, mean = (put(random(seed, 1, 1, 3, 3), wp.vec3d, device) for seed in (1, 2))
    fresnel_weights = put(random(3, 1, 1, 1, 3), wp.float64, device)
    share = put(np.array([[[0.1, 0.3, 0.6]]]), wp.float64, device)

    def mix(radiosity):
        rest = fresnel_weights, light, mean.reshape((1, 3))[:, :1].contiguous(), share, radiosity, of_faces
        return module.mix_mirrored(hits, all_faces, *constants, *rest)

    texel_count = planes.texels_of_patches.shape[0]
    check(mix, (wp.vec3d, random(4, 1, texel_count + 8, 3)))


def test_gradients_of_total_reflectance_are_exact(double, check):
    """Of a batch of colors and one of gloss."""
    total = double("stages.gloss.total_reflectance").total_reflectance
    values = [0.5 + 0.3 * np.tanh(random(seed, 1 + (seed == 0), 4, 3)) for seed in range(4)]
    check(total, *((wp.vec3d, array) for array in values))


def test_gradients_of_radiance_of_blockers_are_exact(double, device, check):
    blocked = double("stages.gloss.reflection").find_blocked_radiance
    direct, openness = random(0, 1, 3, 3), np.repeat(np.linspace(0, 0.9, 3)[None, :, None], 3, axis=2)
    check(blocked, (wp.vec3d, direct + 0.5 + random(1, 1, 3, 3) ** 2), (wp.vec3d, direct), (wp.vec3d, openness))


@pytest.mark.parametrize("quantity", [0, 1])
def test_gradients_of_reflection_are_exact(quantity, double, device, check):
    mix, numbers = double("stages.gloss.reflection").mix_reflection, put(np.int32([-1, 1, 0]), wp.int32, device)
    lights = [(wp.vec3d, random(0, 2, 3, 3)), *((wp.vec3d, random(seed, 2, 2, 3)) for seed in (1, 2))]
    scalars = [(wp.float64, np.abs(np.tanh(random(seed, 1, 2)))) for seed in (3, 4, 5)]
    check(lambda *arguments: mix(numbers, *arguments)[quantity], *lights, *scalars)


@pytest.mark.parametrize("is_blocked", [False, True])
def test_gradients_of_transfer_from_a_shell_are_exact(is_blocked, double, check):
    find, fibonacci = double("stages.shell.shell_transfer").shell_transfer, double("maths.directions").fibonacci
    cells, patches = fibonacci(16), fibonacci(32)
    rng = np.random.default_rng(4)
    given = [(wp.vec3d, 0.4 * random(5, 1, 3, 3)), (wp.vec3d, unit(random(6, 1, 3, 3)))]
    shell = wp.vec4d, np.array([[0.1, -0.2, 0.1, 2.2]])
    if is_blocked:
        past = wp.float64, rng.uniform(0.05, 0.95, size=(1, 3, 16))
        check(lambda p, n, t, s: find(p, n, t, cells, s, patches), *given, past, shell)
    else:
        check(lambda p, n, s: find(p, n, None, cells, s, patches), *given, shell)


def test_gradients_of_where_rays_leave_a_shell_are_exact(double, check):
    leave = double("stages.shell.shell_rays").exits_from_shell
    given = (wp.vec3d, 0.3 * random(7, 1, 3, 3)), (wp.vec3d, unit(random(8, 1, 3, 2, 3)))
    check(leave, *given, (wp.vec4d, np.array([[0.1, -0.2, 0.1, 2.2]])))


@pytest.mark.parametrize("is_two_sided", [False, True])
def test_gradients_of_light_of_emitters_are_exact(double, check, device, is_two_sided):
    """Far from samples, beside their pieces, with pieces cut by the horizon, and at the rim of bent samples."""
    emitters, light = double("stages.emitters.samples"), double("stages.emitters.light")
    sparse = double("stages.sparse").SparseMatrix
    corners = np.zeros((12, 3, 4))
    for piece, face in enumerate(FACES[[0, 1, 2, 3] * 3]):
        corners[piece, [0, 1, 2], face] = 1  # a sample of each face, and three more of others
    areas = np.zeros((8, 4))
    areas[np.arange(8), [0, 1, 2, 3, 0, 1, 2, 3]] = 0.7
    middles = (areas / 0.7) @ np.stack([corners[face].mean(axis=0) for face in range(4)])
    vertices, faces, of_corners = (
        sparse.from_matrix(row, device=device) for row in (middles, areas, corners.reshape(36, 4))
    )
    constants = np.arange(0, 13)[[0, 1, 2, 3, 4, 5, 6, 7, 12]], np.full(8, 0.9), np.tile([0.0, 0.25], 4)
    pieces = emitters.SamplePieces(
        of_corners,
        *(put(item, kind, device) for item, kind in zip(constants, (wp.int32, *[wp.float64] * 2), strict=True)),
    )
    face_corners = put(FACES, wp.vec3i, device)
    first = np.array([0, 8])
    samples = emitters.EmitterSamples(vertices, faces, pieces, None, face_corners, (0,), (is_two_sided,), first)
    (span,) = samples.spans()
    points = unit(random(3, 1, 16, 3)) * np.linspace(1.1, 7, 16)[:, None]
    normals = unit(-points + 1.2 * random(4, 1, 16, 3))

    def light_of(points, normals, positions, radiance):
        return light.sum_light(points, normals, emitters.place_samples(positions, samples), radiance, span)

    given = (wp.vec3d, points), (wp.vec3d, normals), (wp.vec3d, VERTICES[None]), (wp.vec3d, random(5, 1, 8, 3) ** 2)
    check(light_of, *given)


def beam_of_emitter(double, device):
    """Samples of a tetrahedron that emits within a cone, by its vertices."""
    emitters, beams = double("stages.emitters.samples"), double("stages.emitters.spot_cones")
    sparse = double("stages.sparse").SparseMatrix
    middles = np.random.default_rng(5).dirichlet((1, 1, 1, 1), size=8)
    axis, normals = beams.find_axis_weights(VERTICES, FACES)
    assert axis.any() and not normals.any()
    rows = middles, np.ones((8, 4)) / 8, axis[None], np.array([[0.3, 0, 0.1, 0]])  # and of faces, for their adjoint
    vertices, faces, of_vertices, of_faces = (sparse.from_matrix(row, device=device) for row in rows)
    cone = np.array([beams.beam_of((20, 75))])
    made = emitters.EmitterBeams(cone, of_vertices, of_faces)
    corners = put(FACES, wp.vec3i, device)
    pieces = emitters.SamplePieces(vertices, None, None, None)
    samples = emitters.EmitterSamples(vertices, faces, pieces, None, corners, (0,), (False,), np.array([0, 8]), made)
    return emitters, beams, samples


def test_gradients_of_beams_are_exact(double, check, device):
    """To receivers, transmittance and the vertices of the emitter, which turn its axis."""
    emitters, beams, samples = beam_of_emitter(double, device)
    (span,) = samples.spans()
    aside = 2 * random(6, 1, 12, 3) + [0, 0, -4]
    through = np.random.default_rng(7).uniform(0.2, 1, size=(1, 12, 8))

    def shares(points, positions, through):
        return beams.weigh_by_beam(points, emitters.place_samples(positions, samples), span, through)

    given = (wp.vec3d, aside), (wp.vec3d, VERTICES[None]), (wp.float64, through)
    found = shares(*(put(values, dtype, device) for dtype, values in given)).numpy() / through
    assert ((found > 0.05) & (found < 0.95)).mean() > 0.2
    check(shares, *given)


def test_gradients_of_beams_that_cameras_see_are_exact(double, check, device):
    """To emission, to the point that a sample shows, to vertices and cameras."""
    emitters, _, samples = beam_of_emitter(double, device)
    show, fragments = double("stages.emitters.shown_beams").show_beams, double("stages.raster.rasterization").Fragments
    clip_matrix = np.array([[1.0, 0, 0, 0.5], [0, 1, 0, -0.4], [0, 0, 1, 0], [0, 0.3, 1, 4]])
    ids, corners = put(np.array([[[0, 1], [3, -1]]]), wp.int32, device), put(FACES, wp.vec3i, device)
    owners = put(np.int32([0, 0, 0, -1]), wp.int32, device)

    def shown(emission, weights, positions, cameras):
        placed = emitters.place_samples(positions, samples)
        seen = fragments(ids, weights), corners, positions, cameras
        return show(emission, *seen, placed, owners, samples.beams.beams)

    weights = np.random.default_rng(8).dirichlet((1, 1, 1), size=(1, 2, 2))
    given = (wp.vec3d, random(9, 1, 2, 2, 3) ** 2), (wp.vec3d, weights), (wp.vec3d, VERTICES[None])
    given = *given, (wp.mat44d, clip_matrix[None])
    emission, *others = (put(values, dtype, device) for dtype, values in given)
    share = shown(emission, *others).numpy()[0, 0] / emission.numpy()[0, 0]
    assert ((share > 0.02) & (share < 0.98)).all()
    check(shown, *given)
