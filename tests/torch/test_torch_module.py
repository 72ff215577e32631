"""A renderer as a part of a torch.nn.Module: moved, converted, saved and loaded with it."""

import json

import pytest
import torch
from tensors import small_scene

import warpshadow as ws
from warpshadow.torch import TorchRenderer


@pytest.fixture(scope="module")
def renderer() -> TorchRenderer:
    """On the CPU, shared, which no test may change."""
    return TorchRenderer(small_scene(size=8))


def network(renderer: TorchRenderer) -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(2, 2), renderer)


def test_it_has_what_its_scene_is_made_of_and_no_parameters(renderer):
    assert renderer.scene.bodies[0].mesh.name == "icosphere" and renderer.cameras == (renderer.scene.camera,)
    assert isinstance(renderer.basis, ws.CellBasis) and renderer.basis.size == 32
    assert renderer.device == torch.device("cpu") and not list(renderer.parameters())


def test_moved_to_a_device_it_draws_there(device):
    moved = network(TorchRenderer(small_scene(size=8))).to(device)[1]
    light = torch.ones(32, 3, device=moved.device)
    assert moved.device == light.device == moved(light).device
    assert torch.equal(moved(light), TorchRenderer(small_scene(size=8), device=moved.device)(light))


def test_on_the_device_where_it_is_nothing_is_made_anew(renderer):
    before = renderer.array_renderer
    for module in (renderer, network(renderer)):
        module.to("cpu").cpu().float().to(torch.float32)
    assert renderer.array_renderer is before


def test_elsewhere_it_is_made_anew(renderer, monkeypatch):
    made = []
    monkeypatch.setattr(ws.Renderer, "moved", lambda self, device: made.append(device) or self)
    network(renderer)[1].to("meta")  # a device that all machines have, and Warp has not
    assert made == ["meta"]


def test_a_device_that_warp_has_not_is_refused(renderer):
    with pytest.raises(ValueError, match="^device: got 'meta', expected one of 'cpu'"):
        network(renderer).to("meta")
    assert renderer.device == torch.device("cpu")


@pytest.mark.parametrize(
    "convert",
    [
        torch.nn.Module.half,
        torch.nn.Module.double,
        torch.nn.Module.bfloat16,
        lambda module: module.to(torch.float64),
        lambda module: module.type(torch.float16),
    ],
)
def test_another_dtype_is_refused(renderer, convert):
    for module in (renderer, network(renderer)):
        with pytest.raises(ValueError, match="^dtype: got torch.*for a TorchRenderer, expected torch.float32"):
            convert(module)


def test_its_state_says_what_tensors_refer_to(renderer, tmp_path):
    state = network(renderer).state_dict()
    meaning = {"basis": "CellBasis", "coefficients": 32, "bodies": [["icosphere", 162], ["plane", 169]]}
    assert all(isinstance(value, torch.Tensor) for value in state.values())
    assert json.loads(bytes(state["1._extra_state"].tolist())) == meaning
    torch.save(state, tmp_path / "network.pt")
    network(TorchRenderer(small_scene(size=12))).load_state_dict(torch.load(tmp_path / "network.pt"))


@pytest.mark.parametrize("options", [{"basis": ws.HarmonicBasis(2)}, {"basis": ws.HarmonicBasis(6)}, {}])
def test_the_state_of_a_renderer_of_other_tensors_is_refused(renderer, options):
    scene = small_scene(size=8)
    other = TorchRenderer(scene if options else ws.Scene(scene.bodies[:1], scene.light, scene.camera), **options)
    with pytest.raises(ValueError, match="^state_dict: got that of a TorchRenderer with .*, expected"):
        network(other).load_state_dict(network(renderer).state_dict())


def test_a_state_without_a_renderer_is_refused(renderer):
    state = network(renderer).state_dict()
    del state["1._extra_state"]
    with pytest.raises(RuntimeError, match="1._extra_state"):
        network(renderer).load_state_dict(state)


def test_it_explains_what_a_call_with_the_same_tensors_computes(renderer):
    light = torch.ones(32, 3, requires_grad=True)
    own = TorchRenderer(small_scene(size=8))
    assert own.explain(light)["visibility"] and own.explain(light)["shading"].backward
    assert not own.explain(light.detach())["shading"].backward
    with torch.no_grad():
        assert not own.explain(light)["shading"].backward
    own(light)
    assert not own.explain(light)["visibility"]
    rotations, translations, scales = own.scene_poses()
    moved = own.placed(rotations, translations.requires_grad_(), scales, moving=["icosphere"])
    assert own.explain(geometry=moved)["clip positions"].backward
    with pytest.raises(ValueError, match=r"^light: got shape \(3, 3\)"):
        own.explain(light[:3])


def test_scales_of_the_scene_make_no_batch(renderer):
    rotations, translations, _ = renderer.scene_poses()
    assert renderer(geometry=renderer.placed(rotations, translations)).shape == (8, 8, 4)
