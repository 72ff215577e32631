"""Colors that meshes have are a body's, unless an albedo is given; what cannot be taken is named in one warning."""

import json
import warnings

import numpy as np
import pytest
import trimesh
from PIL import Image

import warpshadow as ws

CODES = np.random.default_rng(1).integers(0, 256, (12, 4), np.uint8)
LINEAR = CODES[:, :3] / np.float32(255)
DECODED = ws.srgb_to_linear(CODES[:, :3] / 255).astype(np.float32)
TRIANGLE = "v 0 0 0{0}\nv 1 0 0{1}\nv 0 1 0{1}\nf 1 2 3\n"


def box(**colors):
    mesh = trimesh.creation.box()
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **colors)


def read(path, text):
    path.write_text(text)
    return ws.load_mesh(path)


@pytest.fixture(autouse=True)
def strict():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(("name", "colors"), [("a.ply", DECODED), ("a.glb", LINEAR)])
def test_colors_of_vertices_are_the_albedo_as_the_format_encodes_them(tmp_path, name, colors):
    box(vertex_colors=CODES[:8]).export(tmp_path / name)
    loaded = trimesh.load_scene(tmp_path / name, process=False)
    for source in (tmp_path / name, loaded, ws.load_mesh(tmp_path / name)):
        np.testing.assert_array_equal(ws.Body(source).albedo, colors[:8])
    assert ws.Body(tmp_path / name, albedo=(0.1, 0.2, 0.3)).albedo.shape == (3,)
    assert ws.Mesh(loaded.to_mesh().vertices, loaded.to_mesh().faces).colors is None


def test_a_render_shows_the_colors_of_a_file(tmp_path):
    square = "v -1 -1 0{0}\nv 1 -1 0{1}\nv 1 1 0{1}\nv -1 1 0{0}\nf 1 2 3 4\n"
    (tmp_path / "a.obj").write_text(square.format(" 1 0 0", " 0 0 1"))
    light = np.zeros((4, 3))
    light[0] = 1
    camera = ws.Camera.look_at((0, 0, 3), (0, 0, 0), size=(16, 16))
    visibility = ws.Visibility(method="none")
    scene = ws.Scene([ws.Body(tmp_path / "a.obj", blockers=0)], light, camera, visibility=visibility)
    image = ws.render(scene)
    red, _, blue = np.moveaxis(image[8, 4:12, :3], -1, 0)
    assert (np.diff(red) < 0).all() and (np.diff(blue) > 0).all()


def test_colors_survive_writing_creases_and_moves(tmp_path):
    mesh = ws.load_mesh(box(vertex_colors=CODES[:8]))
    mesh.write(tmp_path / "a.obj")
    again = ws.load_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(again.colors, mesh.colors)
    np.testing.assert_array_equal(again.positions, mesh.positions)
    creased = mesh.transformed(scale=2).creased()
    np.testing.assert_array_equal(creased.colors, mesh.colors[creased.origins])
    assert mesh.content_hash == ws.Mesh(mesh.positions, mesh.faces).content_hash  # spheres are those of the shape


@pytest.mark.parametrize("name", ["a.ply", None])
def test_colors_of_faces_are_taken_where_no_vertex_has_two(tmp_path, name):
    def source(mesh):
        return mesh if name is None else (mesh.export(tmp_path / name), tmp_path / name)[1]

    np.testing.assert_array_equal(ws.Body(source(box(face_colors=[CODES[0]] * 12))).albedo, DECODED[0])
    mesh = box(face_colors=CODES)
    with pytest.warns(UserWarning, match=r"colors of faces dropped \(faces of different .*unmerge_vertices"):
        assert ws.Body(source(mesh)).albedo.shape == (3,)
    assert ws.Body(source(mesh), albedo=(1, 0, 0)).albedo.shape == (3,)  # without a warning
    mesh.unmerge_vertices()
    np.testing.assert_array_equal(ws.Body(source(mesh)).albedo[mesh.faces[:, 0]], DECODED)


def test_the_color_of_a_gltf_material_is_that_of_its_part(tmp_path):
    scene = trimesh.Scene()
    for x, factor in enumerate(([255, 51, 0, 255], [255, 255, 255, 255])):  # white is what glTF says of nothing
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=factor)
        part = box(visual=trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material))
        scene.add_geometry(part.apply_translation([2 * x, 0, 0]))
    scene.export(tmp_path / "a.glb")
    for source in (scene, tmp_path / "a.glb"):
        found = {tuple(map(tuple, np.unique(part, axis=0))) for part in ws.Body(source).albedo.reshape(2, 8, 3)}
        assert found == {(tuple(np.float32((1, 0.2, 0))),), (tuple(np.float32((0.8, 0.8, 0.8))),)}


def test_the_color_of_a_gltf_material_is_not_rounded(tmp_path):
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[128, 1, 64, 255])
    part = box(visual=trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material))
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(part)).items():
        (tmp_path / name).write_bytes(content)
    tree = json.loads((tmp_path / "model.gltf").read_text())
    tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.003, 0.25, 1.0]
    (tmp_path / "model.gltf").write_text(json.dumps(tree))
    np.testing.assert_allclose(ws.Body(tmp_path / "model.gltf").albedo, [0.5, 0.003, 0.25], rtol=1e-6)


@pytest.mark.parametrize("material", [False, True])
def test_colors_of_16_bits_are_read_or_said_to_be_dropped(tmp_path, material):
    codes = np.uint16([(65535, 32768, 0), (0, 257, 1), (1, 2, 3)])
    columns = {"POSITION": (np.eye(3, dtype=np.float32), 5126), "COLOR_0": (np.pad(codes, ((0, 0), (0, 1))), 5123)}
    data, views, accessors = b"", [], []
    for number, (column, kind) in enumerate(columns.values()):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": column.nbytes})
        shape = {"count": 3, "type": f"VEC{column.shape[1]}"}
        accessors.append({"bufferView": number, "componentType": kind, "normalized": kind == 5123, **shape})
        data += column.tobytes()
    primitive = {"attributes": {name: number for number, name in enumerate(columns)}} | (
        {"material": 0} if material else {}
    )
    (tmp_path / "a.bin").write_bytes(data)
    tree = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "scene": 0, "nodes": [{"mesh": 0}]}
    tree |= {"meshes": [{"primitives": [primitive]}], "materials": [{}], "accessors": accessors, "bufferViews": views}
    (tmp_path / "a.gltf").write_text(json.dumps(tree | {"buffers": [{"byteLength": len(data), "uri": "a.bin"}]}))
    if material:
        np.testing.assert_array_equal(ws.Body(tmp_path / "a.gltf").albedo, np.float32(codes / 65535))
    else:
        with pytest.warns(UserWarning, match="colors of 16 bits without a material dropped"):
            assert ws.load_mesh(tmp_path / "a.gltf").colors is None


@pytest.mark.parametrize(
    ("colors", "said"),
    [
        ((" 255 0 0", " 0 0 0"), r"colors dropped \(got values from 0 to 255, expected 0 to 1\)"),
        ((" 1 0 0", ""), "colors dropped, which 2 vertices lack"),
    ],
)
def test_colors_of_an_obj_that_cannot_be_taken_are_named(tmp_path, colors, said):
    with pytest.warns(UserWarning, match=said):
        assert read(tmp_path / "a.obj", TRIANGLE.format(*colors)).colors is None


def test_weights_of_an_obj_are_not_colors(tmp_path):
    assert read(tmp_path / "a.obj", TRIANGLE.format(" 1", " 0.5")).colors is None


def test_a_number_before_the_color_of_an_obj_is_a_weight(tmp_path):
    colors = read(tmp_path / "a.obj", TRIANGLE.format(" 0.5 1 0 0", " 1 0 0 1")).colors
    np.testing.assert_array_equal(colors, [(1, 0, 0), (0, 0, 1), (0, 0, 1)])


@pytest.mark.parametrize(("kind", "most"), [("ushort", 65535), ("uchar", 255), ("int", 255), ("uint", 255)])
@pytest.mark.parametrize("has_uvs", [False, True])
def test_whole_numbers_of_a_ply_are_codes_of_8_bits_or_of_16(tmp_path, kind, most, has_uvs):
    codes = [(0, most, 77), (most // 3, 1, 200), (most, 5, 0)]
    text = "ply\nformat ascii 1.0\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in ("xyzst" if has_uvs else "xyz"))
    text += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    for point, color in zip(np.eye(3, 5 if has_uvs else 3), codes, strict=True):
        text += " ".join(map(str, (*point, *color))) + "\n"
    found = read(tmp_path / "a.ply", text + "3 0 1 2\n").colors
    np.testing.assert_allclose(found, ws.srgb_to_linear(np.array(codes) / most), atol=1e-6)


def test_of_a_texture_and_colors_the_texture_counts(tmp_path):
    text = "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in "xyzst")
    text += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(text + "0 0 0 0 0 255 0 0\n1 0 0 1 0 0 255 0\n0 1 0 0 1 0 0 255\n3 0 1 2\n")
    np.testing.assert_array_equal(ws.Body(tmp_path / "a.ply").albedo, np.eye(3))  # the picture is not there
    Image.new("RGB", (2, 2), "red").save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match="colors of vertices do not count beside its texture"):
        assert ws.Body(tmp_path / "a.ply").texture.shape == (2, 2, 3)


def test_a_picture_without_uvs_is_remarked_on():
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (2, 2)))
    with pytest.warns(UserWarning, match="textures dropped, which need uvs"):
        ws.Body(box(visual=trimesh.visual.TextureVisuals(material=material)))


@pytest.mark.parametrize(
    ("interpolation", "colors", "expected"),
    [
        ("constant", "[(0.5, 0.25, 0)]", [(0.5, 0.25, 0)] * 3),
        ("uniform", "[(1, 0, 0)]", [(1, 0, 0)] * 3),
        ("vertex", "[(1, 0, 0), (0, 1, 0), (0, 0, 1)]", np.eye(3)),
        ("faceVarying", "[(0, 0, 1), (0, 1, 0), (1, 0, 0)]", np.eye(3)),
    ],
)
def test_the_display_color_of_usd_is_linear(tmp_path, interpolation, colors, expected):
    pytest.importorskip("pxr")
    mesh = read(
        tmp_path / "a.usda",
        f"""#usda 1.0
def Mesh "triangle" {{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [2, 1, 0]
    color3f[] primvars:displayColor = {colors} (interpolation = "{interpolation}")
}}""",
    )
    np.testing.assert_array_equal(mesh.colors, np.float32(expected))


@pytest.mark.parametrize(
    ("colors", "said"),
    [
        (CODES[:3, :3], "colors: got values of uint8, expected linear ones as floats"),
        (np.full((3, 3), 2.0), "colors: got values from 2.0 to 2.0, expected reflectances"),
        (np.full((3, 3), np.nan), "colors: got 9 NaN"),
        (np.zeros((2, 3)), r"colors: got shape \(2, 3\)"),
    ],
)
def test_colors_of_a_mesh_are_linear_and_one_for_each_vertex(colors, said):
    with pytest.raises(ValueError, match=said):
        ws.Mesh(np.eye(3), [(0, 1, 2)], colors=colors)
