"""Form factors of a body for itself are traced once, and kept on disk."""

import dataclasses
import warnings

import numpy as np
import pytest
from scipy.sparse import csr_matrix

import warpshadow as ws
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.self_visibility import SelfVisibility
from warpshadow.pipeline.bounces import self_form_factors
from warpshadow.pipeline.bounces.patches import ScenePatches


def scene_of(mesh: ws.Mesh) -> ws.Scene:
    camera = ws.Camera.look_at((0.5, 3, 4), (0, 0, 0), size=(16, 16))
    bodies = [
        ws.Body(mesh, blockers=ws.Spheres([[0, -0.3, 0]], [0.7])),
        ws.Body(ws.plane(4.0, 4), translation=(0, -1.2, 0)),
    ]
    return ws.Scene(bodies, ws.EnvironmentMap.constant(1.0, height=16), camera, ws.Visibility(directions=32), bounces=2)


def dented(depth: float) -> ws.Mesh:
    """A ball that sees itself in a dent."""
    ball = ws.icosphere(1.0, 2)
    positions = ball.positions.copy()
    positions[:, 1] -= depth * np.clip(positions[:, 1], 0, 1) ** 2
    return ws.Mesh(positions, ball.faces)


@pytest.fixture
def traced(monkeypatch, tmp_path) -> list[int]:
    """How many probes were traced, by call; nothing is known from before."""
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    counts, trace = [], self_form_factors.trace_form_factors

    def counted(*args, **kwargs):
        counts.append(len(args[3]))
        return trace(*args, **kwargs)

    monkeypatch.setattr(self_form_factors, "trace_form_factors", counted)
    return counts


def test_they_are_traced_once_for_a_shape_wherever_it_stands(traced):
    scene = scene_of(dented(1.5))
    image = ws.render(scene)
    assert traced == [162]
    np.testing.assert_array_equal(ws.render(scene), image)
    turned = dataclasses.replace(scene.bodies[0], rotation=(0, 40, 0), albedo=(0.9, 0.2, 0.1))
    ws.render(dataclasses.replace(scene, bodies=[turned, scene.bodies[1]]))
    assert traced == [162]
    ws.render(scene_of(dented(1.6)))
    assert traced == [162, 162]


def factors_of(scene: ws.Scene) -> csr_matrix:
    """Form factors of its first body."""
    merged_scene = MergedScene(scene)
    self_visibility = SelfVisibility(merged_scene, np.zeros(len(scene.bodies), bool))
    return self_form_factors.SelfFormFactors(self_visibility, ScenePatches(merged_scene)).of(0)


def test_a_damaged_file_is_traced_again_with_one_warning(traced, tmp_path):
    scene = scene_of(dented(1.5))
    factors = factors_of(scene)
    (path,) = (tmp_path / "form_factors").iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.warns(UserWarning, match="cached form factors .* cannot be read") as caught:
        again = factors_of(scene)
    assert len(caught) == 1 and traced == [162, 162] and path.read_bytes() == whole
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = factors_of(scene)
    assert traced == [162, 162]
    assert factors.nnz and not (factors != again).nnz and not (factors != read).nnz
