"""How many kernels and memory sets an image and an iteration of a pose fit take: on a GPU these are what one costs."""

import collections
import dataclasses
import functools

import pytest
import warp as wp
from meshes import box

import warpshadow as ws
from warpshadow.device import warp_internals
from warpshadow.torch import TorchRenderer
from warpshadow.tuning.timing import whole_image

# Kernels and memory sets, by the receivers of the ground; they may fall. On a GPU no body is adaptive. Parts are put
# together by NumPy on a CPU, on a GPU by a kernel for each.
MOST = {
    "image": {"pixel": (36, 8), "adaptive": (56, 14)},
    "pose iteration": {"pixel": (54, 5), "adaptive": (74, 8)},
    "image with two bounces": {"pixel": (73, 9), "adaptive": (93, 15)},
    "pose iteration with two bounces": {"pixel": (124, 11), "adaptive": (144, 14)},
}


@functools.cache
def calls(receivers):
    """A ball on a ground, so small that no launch is cut; each of its calls is warm."""
    ball = ws.Body(ws.icosphere(1.0, 1), blockers=8, translation=(0, 1, 0))
    ground = ws.Body(ws.plane(6.0, 4), blockers=0, receivers=receivers)
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.75, 0), fov_y=36, size=(16, 16))
    visibility = ws.Visibility(directions=16)
    scene = ws.Scene((ball, ground), ws.synthetic_sky(), camera, visibility=visibility, supersampling=1)
    result = {}
    for bounces, with_bounces in ((0, ""), (2, " with two bounces")):
        renderer = TorchRenderer(dataclasses.replace(scene, bounces=bounces), device="cpu")
        rotations, translations, scales = renderer.scene_poses()
        arguments = renderer, rotations, translations.requires_grad_(), scales
        result[f"image{with_bounces}"] = whole_image(renderer.array_renderer)
        result[f"pose iteration{with_bounces}"] = functools.partial(_fit_pose, *arguments)
    for call in result.values():
        for _ in range(3):
            call()
    return result


def _fit_pose(renderer, rotations, translations, scales):
    renderer(geometry=renderer.placed(rotations, translations, scales)).square().sum().backward()


@pytest.mark.parametrize("receivers", ["pixel", "adaptive"])
@pytest.mark.parametrize("name", list(MOST))
def test_launches_and_memory_sets_do_not_grow(name, receivers, monkeypatch):
    call, most = calls(receivers)[name], MOST[name][receivers]
    call()  # gradients are zeroed in blocks as large as those of the last iteration
    kernels, sets = count(call, monkeypatch)
    found = len(kernels), len(sets)
    print(f"{name}: {found[0]} kernels and {found[1]} memory sets, at most {most}")
    assert all(number <= limit for number, limit in zip(found, most, strict=True)), sorted(kernels)


@pytest.mark.parametrize("kind", ["balls", "boxes"])
@pytest.mark.parametrize("bounces", [0, 2])
def test_bodies_that_are_lit_alike_take_the_kernels_of_one(kind, bounces, monkeypatch):
    """Balls look their self-visibility up, boxes are convex parts; each block light of the others."""
    mesh, options = (ws.icosphere(0.5, 1), {"blockers": 8}) if kind == "balls" else (box(), {})
    options["receivers"] = "vertex"  # not a part of them at samples, as faces become smaller
    counts = []
    for body_count in (3, 7):
        bodies = [ws.Body(mesh, translation=(1.6 * k - 4.8, 0.5, 0), **options) for k in range(body_count)]
        camera = ws.Camera.look_at((1.6, 2.6, 9.6), (0, 0.5, 0), fov_y=50, size=(24, 24))
        scene = ws.Scene((*bodies, ws.Body(ws.plane(12.0, 4))), ws.synthetic_sky(), camera, bounces=bounces)
        call = whole_image(ws.Renderer(scene))
        for _ in range(2):
            call()
        counts.append(collections.Counter(count(call, monkeypatch)[0]))
    print(f"{[found.total() for found in counts]} kernels")
    assert not counts[1] - counts[0]


def count(call, monkeypatch):
    """The kernels of a call, and shapes of the arrays that it sets."""
    kernels, sets = [], []
    bound_kernel, zero, fill = warp_internals.bound_kernel, wp.array.zero_, wp.array.fill_

    def counted(kernel, *arguments, **options):
        kernels.append(kernel.key)
        return bound_kernel(kernel, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(warp_internals, "bound_kernel", counted)
        patch.setattr(wp.array, "zero_", lambda array: (sets.append(array.shape), zero(array))[1])
        patch.setattr(wp.array, "fill_", lambda array, value: (sets.append(array.shape), fill(array, value))[1])
        call()
    return kernels, sets
