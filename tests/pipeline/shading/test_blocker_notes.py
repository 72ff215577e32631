"""`explain` says as what each body blocks light, and why."""

import warpshadow as ws
from demos import shapes
from warpshadow.pipeline.shading import scene_blockers


def notes(bodies, **options):
    scene = ws.Scene(bodies, ws.EnvironmentMap.constant(1.0), visibility=ws.Visibility(**options))
    return [line for line in str(ws.Renderer(scene, progress=False).explain()).splitlines() if "blocks light" in line]


GROUND = ws.Body(ws.plane(6.0, 2), name="ground")
BOX = ws.Body(shapes.joined("box", shapes.box((0.4, 0.4, 0.4))), translation=(1, 0.2, 0))
BALL = ws.Body(ws.icosphere(0.4, 3), name="ball", translation=(-1, 0.4, 0))


def test_each_body_has_a_line_with_its_kind_and_reason():
    ground, box, ball, asked, free = notes(
        [
            GROUND,
            BOX,
            BALL,
            ws.Body(ws.icosphere(0.3, 2), blockers=16, name="asked", translation=(0, 0.3, 1)),
            ws.Body(ws.icosphere(0.3, 2), self_shadows="spheres", name="spheres", translation=(0, 0.3, -1)),
            ws.Body(ws.icosphere(0.1, 1), blockers=0, name="none", translation=(0, 2, 0)),
        ],
        method="directional",
    )
    assert ground == "Body 0 ('ground') blocks light as a part of a plane: it is flat."
    assert box == "Body 1 ('box') blocks light as 1 convex part, its own, too: it consists of them."
    assert "Body 2 ('ball') blocks light as 64 spheres: it is neither flat" in ball
    assert ball.endswith("and its own by rays, traced once.")
    assert "Body 3 ('asked') blocks light as 16 spheres: its blockers ask for them" in asked
    assert 'spheres: self_shadows = "spheres" asks for them, and its own by spheres: self_shadows' in free


def test_cloth_blocks_as_panels_and_many_of_them_name_the_setting_that_is_faster(monkeypatch):
    tent, _ = notes([ws.Body(shapes.tent()), GROUND], method="directional")
    assert tent.endswith("convex parts: it is made of few panels, and its own by rays, traced once.")
    edge_count = sum(len(part.edges) for part in shapes.tent().convex_parts)
    for limit in (edge_count, edge_count - 1):
        monkeypatch.setattr(scene_blockers, "_COSTLY_EDGES", limit)
        tent, box, _ = notes([ws.Body(shapes.tent()), BOX, GROUND], method="directional")
        assert ("traced once; spheres, blockers = 256, take half of the time" in tent) == (limit < edge_count)
        assert "blockers = 256" not in box


def test_a_box_that_is_to_trace_its_own_shadow_blocks_as_a_part_of_which_it_is_made():
    (box, _) = notes([BOX, GROUND], self_shadows="rays")
    assert "as 1 convex part: it is made of few of them, and its own by rays" in box


def test_methods_without_shadows_say_nothing_and_log_sh_has_spheres_alone():
    assert not notes([BALL, GROUND], method="none") and not notes([BALL, GROUND], method="ray-traced")
    ball, _ = notes([BALL, GROUND], method="log-sh")
    assert "64 spheres: log-sh has no planes and no convex parts" in ball
