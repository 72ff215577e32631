"""Calls that a renderer replays as graphs: images and gradients of plain calls. Captures are of the CPU's."""

import copy
import dataclasses

import pytest
import torch
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.torch import TorchRenderer
from warpshadow.torch.replay import Capture

SPHERES = ws.Spheres([(0.2, 0, 0), (-0.2, 0.1, 0), (0, 0.2, 0.2)], [0.3, 0.25, 0.2])
# The same kernels on the same numbers; on a CPU plain calls run in slices, whose sums have another order.
SAME = {"rtol": 1e-5, "atol": 1e-6}


@pytest.fixture(autouse=True)
def any_time(monkeypatch):
    """Replay however long a graph takes."""
    monkeypatch.setattr(Capture, "_timed", lambda capture, run: (run(), 0.0))


@pytest.fixture
def make_renderer():
    """Of a ball with known spheres on a ground, 24 × 24 pixels."""

    def make(**options) -> TorchRenderer:
        on_ball, on_ground = options.pop("receivers", ("vertex", "vertex"))
        ball = ws.Body(ws.icosphere(0.5, 2), blockers=SPHERES, translation=(0, 0.5, 0), receivers=on_ball)
        ground = ws.Body(ws.plane(4, 8), receivers=on_ground)
        camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(24, 24))
        scene = ws.Scene((ball, ground), ws.synthetic_sky(height=32), camera, ws.Visibility(directions=32))
        bounces = options.pop("bounces", 0)
        options.setdefault("graphs", True)
        return TorchRenderer(dataclasses.replace(scene, bounces=bounces), **options)

    return make


RECEIVERS = [("vertex", "vertex"), ("pixel", "vertex"), ("vertex", "adaptive"), ("pixel", "adaptive")]


def moved(renderer: TorchRenderer, shift: float) -> tuple[torch.Tensor, ...]:
    """Poses in which the ball is moved, with a gradient to translations."""
    rotations, translations, scales = renderer.scene_poses()
    translations[0, 0] += shift
    return rotations, translations.requires_grad_(), scales


def image_and_gradients(renderer: TorchRenderer, shift: float, *, light: torch.Tensor | None = None):
    poses = moved(renderer, shift)
    image = renderer(light, geometry=renderer.placed(*poses))
    variables = [poses[1]] if light is None else [poses[1], light]
    return [image.detach(), *torch.autograd.grad(image.square().sum(), variables)]


@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("bounces", [0, 2])
@pytest.mark.parametrize("has_light", [False, True])
def test_replays_have_the_images_and_gradients_of_plain_calls(bounces, has_light, receivers, make_renderer):
    """They have the same receivers, adaptive ones, too."""
    options = {"bounces": bounces, "receivers": receivers}
    renderer, plain = make_renderer(**options), make_renderer(**options, graphs=False)
    for call, shift in enumerate((0.0, 0.1, -0.1, 0.05, 0.2)):
        light = None
        if has_light:
            generator = torch.Generator().manual_seed(call)
            light = torch.rand(renderer.basis.size, 3, generator=generator).requires_grad_()
        found = image_and_gradients(renderer, shift, light=light)
        assert bool(renderer.replays.reason) == (call < 2)
        for one, other in zip(found, image_and_gradients(plain, shift, light=light), strict=True):
            torch.testing.assert_close(one, other, **SAME)
            assert one.abs().max() > 0
    assert plain.replays.reason == "graphs = False"


def test_images_stay_and_gradients_are_of_their_own_call(make_renderer):
    renderer = make_renderer()
    shifts = (0.1, -0.1, 0.2)
    for shift in shifts:
        image_and_gradients(renderer, shift)
    assert not renderer.replays.reason
    alone = [image_and_gradients(renderer, shift) for shift in shifts]
    poses = [moved(renderer, shift) for shift in shifts]
    images = [renderer(geometry=renderer.placed(*each)) for each in poses]
    for order in ((0, 1, 2), (2, 0, 1)):
        for number in order:
            loss = images[number].square().sum()
            (gradient,) = torch.autograd.grad(loss, poses[number][1], retain_graph=True)
            assert torch.equal(images[number], alone[number][0])
            torch.testing.assert_close(gradient, alone[number][1], **SAME)


def test_other_shapes_and_other_variables_have_graphs_of_their_own(make_renderer):
    renderer = make_renderer()
    light = torch.rand(renderer.basis.size, 3)
    for _ in range(3):
        renderer(light)
    assert not renderer.replays.reason
    renderer(light.expand(2, -1, -1))
    assert renderer.replays.reason
    renderer(light.clone().requires_grad_())
    assert renderer.replays.reason
    renderer(light)
    assert not renderer.replays.reason
    known = ws.synthetic_sky(height=16)
    renderer(known)
    assert renderer.replays.reason
    with torch.no_grad():  # which is as if no gradient were asked for
        torch.testing.assert_close(renderer(light.clone().requires_grad_()), renderer(light))
        assert not renderer.replays.reason


def test_light_that_is_linear_can_be_differentiated_again(make_renderer):
    renderer = make_renderer()
    light = torch.rand(renderer.basis.size, 3).requires_grad_()

    def product():
        (gradient,) = torch.autograd.grad(renderer(light).square().sum(), light, create_graph=True)
        return torch.autograd.grad(gradient.square().sum(), light)[0]

    plain = product()
    for _ in range(4):
        torch.testing.assert_close(product(), plain, rtol=1e-4, atol=1e-4)


def test_geometry_without_a_gradient_that_stays_is_not_computed_again(make_renderer):
    renderer = make_renderer()
    geometry = renderer.placed(*(pose.detach() for pose in moved(renderer, 0.1)))
    for _ in range(5):
        renderer(torch.rand(renderer.basis.size, 3).requires_grad_(), geometry=geometry)
    assert "same as before" in renderer.replays.reason


def test_calls_that_cannot_be_captured_stay_plain_and_say_why(make_renderer, monkeypatch):
    renderer, plain = make_renderer(), make_renderer(graphs=False)
    draw, tries = renderer.array_renderer.draw_inputs, []

    def reading(*arguments, **options):
        tries.append(renderer.array_renderer.device.is_capturing)
        if tries[-1]:
            raise RuntimeError("nothing is read while a graph is captured")
        return draw(*arguments, **options)

    monkeypatch.setattr(renderer.array_renderer, "draw_inputs", reading)
    for shift in (0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.1, 0.2):
        found, expected = image_and_gradients(renderer, shift), image_and_gradients(plain, shift)
        torch.testing.assert_close(found, expected, **SAME)
    assert not renderer.array_renderer.device.is_capturing
    assert sum(tries) == 2
    assert "it cannot be captured: nothing is read" in renderer.replays.reason


def test_calls_whose_graph_has_other_results_stay_plain(make_renderer, monkeypatch):
    renderer, plain = make_renderer(), make_renderer(graphs=False)
    draw, device = renderer.array_renderer.draw_inputs, renderer.array_renderer.device

    def forgetful(*arguments, **options):
        image = draw(*arguments, **options)
        return wp.zeros_like(image) if device.is_capturing else image

    monkeypatch.setattr(renderer.array_renderer, "draw_inputs", forgetful)
    for shift in (0.1, 0.2, 0.3):
        poses = moved(renderer, shift)
        with torch.no_grad():
            found, expected = (item(geometry=item.placed(*poses)) for item in (renderer, plain))
        torch.testing.assert_close(found, expected, **SAME)
    assert renderer.replays.reason.endswith("its graph has other results than the plain call")


def test_calls_whose_graph_takes_longer_stay_plain(make_renderer, monkeypatch):
    renderer, seconds, runs = make_renderer(), [1e-3, 3e-3, 2e-3], []
    timed = lambda capture, run: (runs.append(run()), (runs[-1], seconds[len(runs) - 1]))[1]  # noqa: E731
    monkeypatch.setattr(Capture, "_timed", timed)
    for shift in (0.1, 0.2, 0.3, 0.1, 0.2):
        image_and_gradients(renderer, shift)
    assert len(runs) == 3
    assert renderer.replays.reason == "its graph takes 2.0 ms, a plain call 1.0 ms"


def test_copies_capture_anew(make_renderer):
    renderer = make_renderer()
    for shift in (0.1, 0.2, 0.3):
        image_and_gradients(renderer, shift)
    other = copy.deepcopy(renderer)
    torch.testing.assert_close(image_and_gradients(other, 0.1), image_and_gradients(renderer, 0.1), **SAME)
    assert other.replays.reason and not renderer.replays.reason


@pytest.mark.parametrize("receivers", RECEIVERS)
def test_an_image_that_shows_more_than_its_graph_has_room_for_is_computed_plainly(receivers, make_renderer):
    """A ball comes in from the edge of the image; then there is room."""
    renderer, plain = make_renderer(receivers=receivers), make_renderer(receivers=receivers, graphs=False)
    reasons = []
    for shift in (1.5, 1.51, 1.52, 0.0, 0.1):
        found, expected = image_and_gradients(renderer, shift), image_and_gradients(plain, shift)
        reasons.append(renderer.replays.reason)
        torch.testing.assert_close(found, expected, **SAME)
    assert not reasons[2] and "has room for" in reasons[3] and not reasons[4]


def test_calls_that_make_meshes_for_rays_stay_plain_on_a_cpu(make_renderer):
    """Its graphs do not record that."""
    scene = make_renderer().scene
    renderer = TorchRenderer(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=8)), graphs=True)
    for shift in (0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.4):
        poses = [pose.detach() for pose in moved(renderer, shift)]
        assert renderer(geometry=renderer.placed(*poses)).isfinite().all()
    assert "and no mesh" in renderer.replays.reason
    assert wp.Mesh.__init__.__name__ == "__init__" and not wp.get_device("cpu").is_capturing


def test_replays_refuse_what_plain_calls_refuse_and_go_on_after_it(make_renderer):
    renderer, plain = (make_renderer(graphs=graphs) for graphs in (True, False))

    def image(item, shift, **given):
        return item(geometry=item.placed(*moved(item, shift)), **given)

    albedo, light = torch.full((3,), 0.5), torch.ones(renderer.basis.size, 3)
    for shift in (0.1, 0.2, 0.3):
        image(renderer, shift, albedo={"icosphere": albedo}, light=light)
    assert not renderer.replays.reason
    earlier = image(renderer, 0.1, albedo={"icosphere": albedo}, light=light.requires_grad_())
    for given, message in (
        ({"albedo": {"icosphere": 400 * albedo}, "light": light.detach()}, r"albedo\[0\]"),
        ({"albedo": {"icosphere": albedo}, "light": 1e30 * light.detach()}, "light"),
    ):
        for item in (renderer, plain):
            with pytest.raises(ValueError, match=message):
                image(item, 0.2, **given)
    expected = image(plain, 0.1, albedo={"icosphere": albedo}, light=light)
    gradients = [torch.autograd.grad(found.square().sum(), light)[0] for found in (earlier, expected)]
    torch.testing.assert_close(*gradients, **SAME)


def test_tensors_of_inference_mode_are_replayed(make_renderer):
    renderer, plain = (make_renderer(graphs=graphs) for graphs in (True, False))
    with torch.inference_mode():
        for shift in (0.1, 0.2, 0.3, 0.4):
            images = [item(geometry=item.placed(*inference_poses(item, shift))) for item in (renderer, plain)]
            torch.testing.assert_close(*images, **SAME)
    assert not renderer.replays.reason


def inference_poses(renderer: TorchRenderer, shift: float) -> tuple[torch.Tensor, ...]:
    rotations, translations, scales = renderer.scene_poses()
    return rotations, translations + shift, scales


def test_calls_with_a_lamp_that_may_be_inside_another_body_stay_plain(make_renderer):
    """Rays to a lamp inside a body are traced, so a graph would keep to where the lamp was when it was captured."""
    torus = trimesh.creation.torus(0.4, 0.15, 12, 8)
    ring = ws.Body(torus, blockers=SPHERES, translation=(0, 0.5, 0))
    lamp = ws.Body(ws.icosphere(0.1, 1), (0, 0, 0), emission=(9, 8, 7), translation=(2, 1, 0))
    camera = ws.Camera.look_at((0, 2, 5), (0, 0.3, 0), size=(12, 12))
    renderer = TorchRenderer(ws.Scene((lamp, ring, ws.Body(ws.plane(4, 4))), ws.synthetic_sky(), camera), graphs=True)
    for shift in (0.0, -0.1, -0.2):
        with torch.no_grad():
            renderer(geometry=renderer.placed(*moved(renderer, shift)))
    assert "takes no data from the host" in renderer.replays.reason


def test_no_other_tensor_can_lie_where_the_last_ones_do(make_renderer):
    """They are known by their addresses."""
    renderer = make_renderer()
    for call in range(4):
        geometry = renderer.placed(*(pose.detach() for pose in moved(renderer, 0.1 * call)))
        renderer(torch.rand(renderer.basis.size, 3).requires_grad_(), geometry=geometry)
    assert not renderer.replays.reason
    shapes = {tensor.data_ptr(): tensor.shape for tensor in vars(geometry).values() if isinstance(tensor, torch.Tensor)}
    assert shapes
    del geometry
    others = [torch.empty(shape) for shape in shapes.values() for _ in range(20)]
    assert shapes.keys().isdisjoint(other.data_ptr() for other in others)
