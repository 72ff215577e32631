"""Textures that files of meshes have are a body's, or a warning says why not."""

import warnings

import numpy as np
import pytest
import trimesh
from PIL import Image

import warpshadow as ws

CODES = np.random.default_rng(0).integers(0, 256, (4, 8, 3), np.uint8)
TEXTURE = ws.srgb_to_linear(CODES / 255).astype(np.float32)
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"


def write_obj(folder, faces=f"usemtl a\n{FACE}", materials="newmtl a\nKd 1 1 1\nmap_Kd -clamp on a.png\n"):
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{SQUARE}{faces}")
    (folder / "a.mtl").write_text(materials)
    Image.fromarray(CODES).save(folder / "a.png")
    return folder / "a.obj"


def write_glb(folder, factor=None):
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(CODES), baseColorFactor=factor)
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
    visual = trimesh.visual.TextureVisuals(uv=[(0, 0), (1, 0), (1, 1)], material=material)
    trimesh.Trimesh(corners, [(0, 1, 2)], visual=visual, process=False).export(folder / "a.glb")
    return folder / "a.glb"


@pytest.fixture(autouse=True)
def strict():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("write", [write_obj, write_glb])
def test_a_body_has_the_texture_of_its_file(tmp_path, write):
    path = write(tmp_path)
    body = ws.Body(path)
    np.testing.assert_array_equal(body.texture, TEXTURE)
    np.testing.assert_array_equal(body.mesh.uvs[body.mesh.uv_faces[0]], [(0, 0), (1, 0), (1, 1)])
    light = f"light = {{sh = [[1, 1, 1]{3 * ', [0, 0, 0]'}]}}"
    (tmp_path / "scene.toml").write_text(f'camera = {{framing = "auto"}}\n{light}\n[[body]]\nmesh = "{path.name}"\n')
    np.testing.assert_array_equal(ws.load_scene(tmp_path / "scene.toml").bodies[0].texture, TEXTURE)


@pytest.mark.parametrize("kind", ["mesh", "scene"])
def test_a_body_of_trimesh_is_that_of_its_file(tmp_path, kind):
    of_file = ws.Body(write_glb(tmp_path))
    loaded = trimesh.load_scene(tmp_path / "a.glb", process=False)
    body = ws.Body(loaded if kind == "scene" else loaded.to_mesh())
    np.testing.assert_array_equal(body.mesh.positions, of_file.mesh.positions)
    np.testing.assert_array_equal(body.mesh.faces, of_file.mesh.faces)
    np.testing.assert_array_equal(body.mesh.uvs[body.mesh.uv_faces], of_file.mesh.uvs[of_file.mesh.uv_faces])
    np.testing.assert_array_equal(body.texture, TEXTURE)


@pytest.mark.parametrize("shape", ["box", "icosphere"])
def test_what_trimesh_was_asked_before_changes_nothing(shape):
    """A box keeps its edges, and a sphere is smooth, though each face has its own vertices."""

    def made():
        mesh = getattr(trimesh.creation, shape)()
        mesh.unmerge_vertices()
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.tile([(0, 0), (1, 0), (0, 1)], (len(mesh.faces), 1)))
        return mesh

    asked = made()
    assert len(asked.vertex_normals) and len(asked.face_normals) and asked.visual.kind and not asked.is_watertight
    faces = ws.load_mesh(asked).faces
    np.testing.assert_array_equal(faces, ws.load_mesh(made()).faces)
    assert len(np.unique(faces)) == {"box": 24, "icosphere": 642}[shape]


def test_a_scene_of_trimesh_is_one_mesh_where_its_nodes_are():
    ball = trimesh.creation.icosphere(subdivisions=1)
    scene = trimesh.Scene()
    for x in (0, 3):
        scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix((x, 0, 0)))
    mesh = ws.load_mesh(scene)
    assert mesh.face_count == 2 * len(ball.faces) and mesh.name == "mesh"
    np.testing.assert_allclose(mesh.bounds, [(-1, -1, -1), (4, 1, 1)])


def test_a_scene_of_trimesh_without_faces_is_refused():
    with pytest.raises(ws.MeshError, match="^mesh: faces: got none"):
        ws.Body(trimesh.Scene())


def test_a_texture_is_multiplied_by_its_factor(tmp_path):
    body = ws.Body(write_glb(tmp_path, factor=[255, 51, 0, 255]))
    np.testing.assert_allclose(body.texture, TEXTURE * (1, 0.2, 0), atol=1e-6)


@pytest.mark.parametrize("write", [write_obj, write_glb])
def test_what_is_given_counts_in_its_place(tmp_path, write):
    path = write(tmp_path)
    assert ws.Body(path, albedo=(1, 0, 0)).texture is None
    np.testing.assert_array_equal(ws.Body(path, texture=np.zeros((1, 1, 3), np.float32)).texture, np.zeros((1, 1, 3)))


@pytest.mark.parametrize("write", [write_obj, write_glb])
def test_a_mesh_leaves_it_and_says_so(tmp_path, write):
    with pytest.warns(UserWarning, match=r"its texture dropped, which Body\(path\) takes$"):
        ws.load_mesh(write(tmp_path))


@pytest.mark.parametrize(
    ("faces", "materials", "said"),
    [
        (
            f"usemtl a\n{FACE}usemtl b\nf 1/1 3/3 2/2\n",
            "newmtl a\nmap_Kd a.png\nnewmtl b\nmap_kd b.png\n",
            "textures dropped, since",
        ),
        (f"usemtl a\n{FACE}usemtl b\nf 1/1 3/3 2/2\n", "newmtl a\nmap_Kd a.png\nnewmtl b\n", "textures dropped, since"),
        (f"usemtl a\n{FACE}", "newmtl a\nmap_Kd b.png\n", r"its texture dropped \(.*b.png: no such image file\)"),
    ],
)
def test_what_cannot_be_taken_is_named_in_one_warning(tmp_path, faces, materials, said):
    path = write_obj(tmp_path, faces, materials)
    with pytest.warns(UserWarning, match=said) as caught:
        body = ws.Body(path)
    assert body.texture is None and len(caught) == 1


def test_one_picture_of_two_materials_is_one(tmp_path):
    faces = "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n"
    body = ws.Body(write_obj(tmp_path, faces, "newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd a.png\n"))
    np.testing.assert_array_equal(body.texture, TEXTURE)


@pytest.mark.parametrize("call", [lambda path: ws.Body(path), ws.load_mesh], ids=["Body", "load_mesh"])
def test_a_warning_points_at_the_line_of_the_user(tmp_path, call):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 2 2 2\nf 1 2 3\n")
    with pytest.warns(UserWarning, match="1 unreferenced vertices") as caught:
        call(path)
    assert caught[0].filename == __file__
