"""What is shown of objects in a shell: short, with counts."""

import warpshadow as ws
from warpshadow import inverse
from warpshadow.torch import TorchRenderer


def test_objects_say_in_a_line_what_they_are():
    mesh = ws.icosphere(1.0, 1)
    body = ws.Body(mesh, name="ball", blockers=ws.Spheres([[0, 0, 0]], [1.0]))
    ground = ws.Body(ws.plane(2.0, 1), texture=[[[0.5, 0.5, 0.5]] * 3] * 2)
    light = ws.EnvironmentMap.constant(1.0, 4)
    camera = ws.Camera.look_at((0, 1, 4), (0, 1, 0), fov_y=30, size=(8, 6))
    scene = ws.Scene([body, ground], light, camera, ws.Visibility("none"))
    tensors = TorchRenderer(scene)
    shown = {
        "Mesh('icosphere', 42 vertices, 80 faces)": mesh,
        "Body('ball', 42 vertices, 80 faces, 1 spheres)": body,
        "Body('plane', 4 vertices, 2 faces, auto spheres, texture 3 × 2)": ground,
        "EnvironmentMap(8 × 4)": light,
        "Camera(8 × 6, eye (0, 1, 4), fov_y 30)": camera,
        f"Scene([{body}, {ground}], {light}, {camera}, 'none')": scene,
        f"Renderer({scene}, cpu)": ws.Renderer(scene),
        "Layers(8 × 6, 2 bodies)": ws.Renderer(scene).layers(),
        "LayerTensors(8 × 6, 2 bodies)": tensors.layers(),
        "CellBasis(16 cells)": ws.CellBasis(ws.fibonacci(16)),
        "Target(8 × 6, a mask)": inverse.Target(ws.render(scene), mask=[[1.0] * 8] * 6),
    }
    for text, value in shown.items():
        assert repr(value) == text
    assert repr(ws.Scene([body], light.sh(2), bounces=2)).endswith("fov_y 40), 2 bounces)")
    assert "4 SH coefficients" in repr(ws.Scene([body], light.sh(2)))
    assert "Scene([Body('ball', 42 vertices" in repr(TorchRenderer(scene))


def test_a_fit_says_what_was_free_and_how_it_ended():
    body = ws.Body(ws.icosphere(1.0, 1), blockers=0)
    scene = ws.Scene([body], ws.EnvironmentMap.constant(1.0, 4), ws.Camera.look_at((0, 0, 4), (0, 0, 0), size=(8, 6)))
    problem = inverse.Problem(scene, inverse.Target(0.5 * ws.render(scene)), [inverse.Albedo(0)])
    assert repr(problem) == f"Problem({scene.with_method()}, 1 targets of 8 × 6, free: albedo[0])"
    result = inverse.fit(problem, [inverse.Stage(3)], progress=False)
    count, loss = len(result.losses[0]), min(result.losses[0])
    assert repr(result) == f"Result(albedo[0]: {result.reason} after {count} iterations, loss {loss:.3g})"
    assert result.reason in ("converged", "finished")
