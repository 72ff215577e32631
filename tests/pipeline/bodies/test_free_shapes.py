"""Bodies whose shape is free: their spheres block their own light, which bulge out of thin ones."""

import warnings

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.scene.blockers import free_shape_remark
from warpshadow.torch import TorchRenderer

# Relative L2 of a gradient to a sheet's size and place against differences over 6% of it, in 32² pixels: measured 0.14
# at vertices, 0.93 by pixel.
OF_SHEET = 0.3


def grid(height=lambda x: 0.3 * np.cos(1.2 * x)) -> ws.Mesh:
    """An arched sheet of 8² quads; or another, given its height."""
    corners = np.linspace(-1, 1, 9)
    positions = [[x, height(x), z] for z in corners for x in corners]
    quads = np.array([[9 * row + column for column in range(8)] for row in range(8)]).reshape(-1, 1)
    faces = np.concatenate([quads + [0, 9, 1], quads + [1, 9, 10]])
    return ws.Mesh(np.array(positions), faces)


def sheet(**options) -> ws.Body:
    """The arched sheet, a sphere beneath each vertex, which bulges out of it."""
    mesh = grid()
    spheres = ws.Spheres(mesh.positions - [0, 0.05, 0], np.full(81, 0.1))
    return ws.Body(mesh, blockers=spheres, translation=(0, 0.7, 0), rotation=(10, 20, 5), name="sheet", **options)


def scene_of(body: ws.Body, method: str = "directional") -> ws.Scene:
    """The body over a ground in 32² pixels."""
    camera = ws.Camera.look_at((2, 3, 4.0), (0, 0.6, 0), size=(32, 32))
    ground = ws.Body(ws.plane(6.0, 8), receivers="pixel", name="ground")
    return ws.Scene([body, ground], ws.synthetic_sky(), camera, visibility=ws.Visibility(method))


def renderer_of(body: ws.Body, method: str = "directional") -> TorchRenderer:
    """A renderer of that."""
    return TorchRenderer(scene_of(body, method))


def image_of(renderer: TorchRenderer, shift: torch.Tensor, stretch: torch.Tensor) -> torch.Tensor:
    """The image of a shifted body of free shape."""
    rotations, translations, scales = renderer.scene_poses()
    rest = renderer.deformed(0, torch.tensor(renderer.scene.bodies[0].mesh.positions) * (1 + stretch))
    shifts = torch.stack([shift, torch.zeros(3)])
    return renderer(geometry=renderer.placed(rotations, translations + shifts, scales, rest=rest))


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_sheet_of_free_shape_receives_at_vertices_unless_it_says_otherwise(method):
    images = {}
    for receivers in ("auto", "vertex", "pixel"):
        with torch.no_grad():
            images[receivers] = image_of(
                renderer_of(sheet(receivers=receivers), method), torch.zeros(3), torch.zeros(3)
            )
    chosen = renderer_of(sheet(), method).scene.bodies[0].receivers
    assert chosen == "pixel"  # as long as it is rigid
    torch.testing.assert_close(images["auto"], images["vertex"], rtol=1e-5, atol=1e-5)
    assert (images["auto"] - images["pixel"]).abs().max() > 0.1


def test_the_gradient_to_a_sheets_vertices_is_that_of_differences():
    renderer = renderer_of(sheet())
    weights = torch.randn((32, 1, 4), generator=torch.Generator().manual_seed(1))
    change = torch.zeros(6, requires_grad=True)

    def loss(change: torch.Tensor) -> torch.Tensor:
        return (image_of(renderer, change[:3], change[3:]) * weights).mean()

    loss(change).backward()
    with torch.no_grad():
        differences = torch.stack([(loss(0.03 * one) - loss(-0.03 * one)) / 0.06 for one in torch.eye(6)])
    assert (change.grad - differences).norm() < OF_SHEET * differences.norm()


def test_a_sheet_whose_own_spheres_shadow_it_receives_at_vertices_when_it_is_rigid_too():
    with torch.no_grad():
        renderers = [renderer_of(sheet(receivers=where, self_shadows="spheres")) for where in ("auto", "vertex")]
        auto, vertex = (renderer() for renderer in renderers)
    torch.testing.assert_close(auto, vertex, rtol=1e-5, atol=1e-5)
    picture = ws.render(scene_of(sheet(self_shadows="spheres")), progress=False)
    torch.testing.assert_close(torch.tensor(picture), vertex, rtol=1e-5, atol=1e-5)


def test_explain_says_that_a_sheet_of_free_shape_receives_at_vertices():
    renderer = renderer_of(sheet())
    poses, rest = renderer.scene_poses(), renderer.deformed(0, torch.tensor(sheet().mesh.positions))
    assert "Body 0 ('sheet') has receivers at pixels" in str(renderer.explain())
    text = str(renderer.explain(geometry=renderer.placed(*poses, rest=rest)))
    assert "Body 0 ('sheet') has receivers at vertices: spheres block its light, and bulge out" in text


def test_a_box_of_free_shape_receives_by_pixel():
    positions = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    mesh = ws.Mesh(0.5 * positions, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])).creased(30)
    images = {}
    for receivers in ("auto", "pixel"):
        spheres = ws.Spheres(0.25 * positions, np.full(8, 0.25))
        body = ws.Body(mesh, blockers=spheres, translation=(0, 0.9, 0), receivers=receivers, name="box")
        with torch.no_grad():
            images[receivers] = image_of(renderer_of(body), torch.zeros(3), torch.zeros(3))
    torch.testing.assert_close(images["auto"], images["pixel"], rtol=1e-5, atol=1e-5)


def test_a_flat_body_that_one_sphere_stands_for_warns_once_of_another_shape():
    renderer = renderer_of(ws.Body(ws.plane(2.0, 8), translation=(0, 0.9, 0), name="card"))
    points = torch.tensor(renderer.scene.bodies[0].mesh.positions)
    with pytest.warns(UserWarning, match=r"body 0 \('card'\) is flat, and one sphere.*fit_spheres\(mesh, 64\)"):
        renderer.deformed(0, points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        renderer.deformed(0, points)


def test_a_sheet_whose_spheres_are_few_for_a_free_shape_is_told_how_to_have_more():
    ground, light = ws.Body(ws.plane(6.0, 8)), ws.synthetic_sky()
    of = [
        free_shape_remark(ws.Scene([ws.Body(grid(), name="sheet", **options), ground], light), 0)
        for options in ({}, {"self_shadows": "spheres"}, {"blockers": 96}, {"blockers": 0})
    ]
    assert "body 0 ('sheet') is a sheet or a thin wall" in of[0]
    assert 'self_shadows = "spheres"' in of[0]
    assert of[1:] == ["", "", ""]
