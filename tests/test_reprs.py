"""What is shown of objects in a shell: short, with counts."""

import warpshadow as ws
from warpshadow.torch import TorchRenderer


def test_objects_say_in_a_line_what_they_are():
    mesh = ws.icosphere(1.0, 1)
    body = ws.Body(mesh, name="ball", blockers=ws.Spheres([[0, 0, 0]], [1.0]))
    ground = ws.Body(ws.plane(2.0, 1), texture=[[[0.5, 0.5, 0.5]] * 3] * 2)
    light = ws.EnvironmentMap.constant(1.0, 4)
    camera = ws.Camera.look_at((0, 1, 4), (0, 1, 0), fov_y=30, size=(8, 6))
    scene = ws.Scene([body, ground], light, camera, ws.Visibility("none"))
    shown = {
        "Mesh('icosphere', 42 vertices, 80 faces)": mesh,
        "Body('ball', 42 vertices, 80 faces, 1 spheres)": body,
        "Body('plane', 4 vertices, 2 faces, 64 spheres, texture 3 × 2)": ground,
        "EnvironmentMap(8 × 4)": light,
        "Camera(8 × 6, eye (0, 1, 4), fov_y 30)": camera,
        f"Scene([{body}, {ground}], {light}, {camera}, 'none')": scene,
        f"Renderer({scene}, cpu)": ws.Renderer(scene),
    }
    for text, value in shown.items():
        assert repr(value) == text
    assert repr(ws.Scene([body], light.sh(2), bounces=2)).endswith("'directional', 2 bounces)")
    assert "4 SH coefficients" in repr(ws.Scene([body], light.sh(2)))
    assert "Scene([Body('ball', 42 vertices" in repr(TorchRenderer(scene))
