"""Meshes: what files and primitives give, what is refused and how, and the gradient of vertex normals."""

import json
import sys
import warnings

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warpshadow as ws
from warpshadow.assets.mesh import Mesh, MeshError
from warpshadow.assets.mesh_files import load_mesh
from warpshadow.assets.primitives import icosphere, infinite_ground, plane
from warpshadow.assets.unwrap import unwrap
from warpshadow.stages.geometry.normals import vertex_normals

TRIANGLE = np.eye(3, dtype=np.float32)
ROUNDING = 2e-6  # float32 sums of a few faces, then a normalization
QUARTER_TURN_Y = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # takes z to x


def face_normals(mesh):
    a, b, c = np.moveaxis(mesh.positions.astype(np.float64)[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)


def normals_twin(positions, faces):
    """Area-weighted vertex normals of one mesh in float64."""
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    sums = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(sums, faces[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)


def normals_of(mesh, device="cpu"):
    positions = wp.array(mesh.positions[None], dtype=wp.vec3, device=device)
    return vertex_normals(positions, wp.array(mesh.faces, dtype=wp.vec3i, device=device)).numpy()[0]


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


# ------------------------------------------------------------------------------------------------- validation


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 0, 0], [0, np.nan, 0], [0, 0, np.inf]], [[0, 1, 2]]), r"positions: .* at 2 of 3 \(first at vertex 1: "),
        (([[1e39, 0, 0]] * 3, [[0, 1, 2]]), r"first at vertex 0: \[inf.*expected finite numbers"),
        (([[0, 0, 0], [0, 2e18, 0]], [[0, 1, 1]]), r"numbers beyond 1e\+18 at 1 of 2 \(first at vertex 1: "),
        ((TRIANGLE, [[0, 1, 2], [0, 1, 3]]), r"faces: got 1 .*face 1: vertex 3\), expected 0 to 2"),
        ((TRIANGLE, [[0, -1, 2]]), r"faces: got 1 .*face 0: vertex -1\)"),
        ((np.zeros((0, 3)), [[0, 1, 2]]), r"positions: got shape \(0, 3\).*at least one vertex"),
        ((TRIANGLE, np.zeros((0, 3), int)), r"faces: got shape \(0, 3\).*at least one face"),
        ((TRIANGLE, [[0, 1, 2, 0]]), r"faces: got shape \(1, 4\), .*triangulate other polygons"),
        ((TRIANGLE, [[0.0, 1.0, 2.0]]), "faces: got float64, expected integers"),
        ((TRIANGLE, [[1, 2, 3]]), "faces: got 1 .*those that count from 1 are faces - 1 here"),
        ((TRIANGLE, None), "faces: got None, expected integers"),
        (("cow.obj", None), r"positions: got 'cow.obj', expected an array .*load_mesh\(path\)"),
        (([[0, 0, 0], [1]], [[0, 1, 2]]), r"positions: got \[\[0, 0, 0\], \[1\]\], expected an array"),
        ((TRIANGLE, [[0, 1, 2]], TRIANGLE[:2, :2]), "uvs: got 2 for 3 vertices, expected one for each, or uv_faces"),
        ((TRIANGLE, [[0, 1, 2]], None, [[0, 1, 2]]), "uvs: got None"),
        ((TRIANGLE, [[0, 1, 2]], TRIANGLE[:, :2], [[0, 1, 3]]), r"uv_faces: got 1 .*face 0: uv 3\)"),
        ((TRIANGLE, [[0, 1, 2]], TRIANGLE[:, :2], [[0, 1, 2]] * 2), "uv_faces: got 2 faces, expected 1"),
    ],
)
def test_a_bad_mesh_is_refused_with_what_and_where(arguments, message):
    with pytest.raises(MeshError, match=message):
        Mesh(*arguments)


def test_a_mesh_keeps_read_only_copies():
    positions = TRIANGLE.copy()
    mesh = Mesh(positions, [[0, 1, 2]])
    positions[:] = 7
    np.testing.assert_array_equal(mesh.positions, TRIANGLE)
    with pytest.raises(ValueError, match="read-only"):
        mesh.positions[0] = 0
    assert (mesh.positions.dtype, mesh.faces.dtype) == (np.float32, np.int32)


def test_the_hash_follows_the_content_and_not_the_name():
    mesh = Mesh(TRIANGLE, [[0, 1, 2]])
    assert mesh.content_hash == Mesh(TRIANGLE, [[0, 1, 2]], name="other").content_hash
    others = [
        Mesh(2 * TRIANGLE, [[0, 1, 2]]),
        Mesh(TRIANGLE, [[1, 2, 0]]),
        Mesh(TRIANGLE, [[0, 1, 2]], TRIANGLE[:, :2], [[0, 1, 2]]),
    ]
    assert len({mesh.content_hash, *(other.content_hash for other in others)}) == 4


def test_the_bounds_ignore_vertices_without_faces():
    lower, upper = Mesh(np.concatenate([TRIANGLE, [[9, 9, 9]]]), [[0, 1, 2]]).bounds
    assert (lower.tolist(), upper.tolist()) == ([0, 0, 0], [1, 1, 1])


# ------------------------------------------------------------------------------------------------- transforms


def test_a_transform_scales_then_rotates_then_translates():
    mesh = Mesh(TRIANGLE, [[0, 1, 2]]).transformed(rotation=QUARTER_TURN_Y, translation=[0, 0, 5], scale=[1, 2, 3])
    np.testing.assert_allclose(mesh.positions, [[0, 0, 4], [0, 2, 5], [3, 0, 5]], atol=1e-6)


def test_a_mirroring_turns_faces_over_so_that_normals_stay_outside():
    sphere = icosphere(subdivisions=1).transformed(scale=[-1, 1, 1])
    assert (np.sum(face_normals(sphere) * sphere.positions[sphere.faces[:, 0]], axis=1) > 0).all()
    sheet = plane(segments=1).transformed(scale=[-1, 1, 1])
    np.testing.assert_array_equal(sheet.uv_faces, plane(segments=1).uv_faces[:, ::-1])


def test_a_transform_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"rotation: got ndarray of float64 and shape \(2, 2\), expected 3 rows of 3"):
        plane(segments=1).transformed(rotation=np.eye(2))


# ------------------------------------------------------------------------------------------------- primitives


def test_a_plane_faces_up_and_fills_its_size():
    mesh = plane((4, 2), (3, 5))
    assert (mesh.vertex_count, mesh.face_count) == (4 * 6, 2 * 3 * 5)
    normals = face_normals(mesh)
    np.testing.assert_allclose(normals[:, 1].sum() / 2, 8, rtol=1e-6)
    assert (normals[:, 1] > 0).all() and (normals[:, [0, 2]] == 0).all()
    np.testing.assert_array_equal(mesh.bounds, [[-2, 0, -1], [2, 0, 1]])
    np.testing.assert_allclose(mesh.uvs, np.stack([mesh.positions[:, 0] / 4, -mesh.positions[:, 2] / 2], 1) + 0.5)
    np.testing.assert_array_equal(mesh.uv_faces, mesh.faces)


@pytest.mark.parametrize("segments", [8, 64, 100])
def test_an_infinite_ground_faces_up_without_holes_in_faces_of_good_shape(segments):
    mesh = infinite_ground(3.0, segments)
    corners = mesh.positions[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    assert (normals[:, 1] > 0).all() and (normals[:, [0, 2]] == 0).all() and mesh.uvs is None and mesh.is_flat
    reach = 3e4
    np.testing.assert_allclose(normals.sum(), segments / 2 * np.sin(2 * np.pi / segments) * reach**2, rtol=1e-6)
    edges = {tuple(edge) for edge in mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
    rim = [edge for edge in edges if edge[::-1] not in edges]
    assert len(edges) == 3 * mesh.face_count and len(rim) == segments
    np.testing.assert_allclose(np.linalg.norm(mesh.positions[np.unique(rim)], axis=1), reach, rtol=1e-6)
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    distances = np.linalg.norm(corners, axis=2).max(axis=1)
    assert (lengths < 1.5 * 2 * np.pi / segments * np.maximum(distances, 1.5)).all()
    assert mesh.face_count < 6 * segments**2


def test_the_texture_of_an_infinite_ground_is_that_of_a_plane_and_repeats():
    texture = np.random.default_rng(0).uniform(size=(16, 16, 3)).astype(np.float32)
    camera = ws.Camera.look_at((0, 3, 0.01), (0, 0, 0), size=(32, 32), fov_y=40)
    images = [
        ws.Renderer(
            ws.Scene([ws.Body(mesh, texture=image)], ws.EnvironmentMap.constant(), camera, ws.Visibility("none"))
        ).render()[..., :3]
        for mesh, image in (
            (infinite_ground(4.0, texture_size=1.5), texture),
            (plane(4.5, 9), np.tile(texture, (3, 3, 1))),
        )
    ]
    np.testing.assert_allclose(*images, atol=0.01)
    assert images[0].std() > 0.1
    with pytest.raises(MeshError, match="texture_size: got 0, expected a positive number"):
        infinite_ground(texture_size=0)


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_an_icosphere_is_a_closed_sphere_seen_from_outside(subdivisions):
    mesh = icosphere(2.5, subdivisions)
    assert (mesh.vertex_count, mesh.face_count) == (10 * 4**subdivisions + 2, 20 * 4**subdivisions)
    np.testing.assert_allclose(np.linalg.norm(mesh.positions, axis=1), 2.5, rtol=1e-6)
    edges = {tuple(edge) for edge in mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
    assert len(edges) == 3 * mesh.face_count and edges == {(b, a) for a, b in edges}
    assert (np.sum(face_normals(mesh) * mesh.positions[mesh.faces].mean(1), axis=1) > 0).all()
    assert mesh.uvs is None


@pytest.mark.parametrize(
    "make",
    [
        lambda: plane(0.0),
        lambda: plane((1, np.inf)),
        lambda: plane(1, 0),
        lambda: plane(1, 2.5),
        lambda: infinite_ground(0.0),
        lambda: infinite_ground(np.nan),
        lambda: infinite_ground(1e18),
        lambda: infinite_ground((1, 2)),
        lambda: infinite_ground(1, 7),
        lambda: infinite_ground(1, 10.5),
        lambda: icosphere(-1),
        lambda: icosphere(1, 9),
    ],
)
def test_a_primitive_refuses_impossible_sizes(make):
    with pytest.raises(MeshError, match="(size|segments|radius|subdivisions): got .*, expected"):
        make()


# -------------------------------------------------------------------------------------------------------- OBJ


def test_spot_keeps_its_positions_and_uvs_apart(shared_data):
    mesh = load_mesh(shared_data / "meshes/spot.obj")
    assert (mesh.vertex_count, len(mesh.uvs), mesh.face_count) == (2930, 3225, 5856)
    np.testing.assert_array_equal(mesh.positions[0], np.float32([0.348799, -0.334989, -0.0832331]))
    np.testing.assert_array_equal(mesh.faces[0], [738, 734, 735])
    np.testing.assert_array_equal(mesh.uv_faces[0], [0, 1, 2])
    edges = {tuple(edge) for edge in mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
    assert edges == {(b, a) for a, b in edges}  # closed: seams do not open it


def test_the_bunny_keeps_every_vertex_and_warns_once_of_the_unused(shared_data):
    with pytest.warns(UserWarning) as caught:
        mesh = load_mesh(shared_data / "meshes/stanford-bunny.obj")
    assert (mesh.vertex_count, mesh.face_count, mesh.name) == (35947, 69451, "stanford-bunny")
    assert [str(w.message).split(": ")[1] for w in caught] == ["1113 unreferenced vertices"]
    assert caught[0].filename == __file__


def test_an_obj_may_have_polygons_negative_indices_normals_comments_and_continued_lines(tmp_path):
    text = (
        "# a comment\r\no thing\nv 0 0 0 1\nv 1 0 0\nv 1 1 0\nvn 0 0 1\nvt 0.25\nvt 1 0.5 0\n"
        "v 0 1 0\nf 1/1/1 2/2/1 \\\n 3/2/1 -1/-2/-1 # a quad\nf 1/1 2/1 3/1\nl 1 2\n"
    )
    with pytest.warns(UserWarning, match=": 1 duplicate faces dropped$"):
        mesh = load_mesh(write(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.uv_faces, [[0, 1, 1], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.uvs, np.float32([[0.25, 0], [1, 0.5]]))


@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_written_mesh_reads_back_bit_for_bit(tmp_path_factory, seed, with_uvs):
    random = np.random.default_rng(seed)
    positions = random.normal(size=(7, 3)) * 10.0 ** random.integers(-20, 18, (7, 1))
    uvs = (random.random((4, 2)), random.integers(0, 4, (5, 3))) if with_uvs else ()
    mesh = Mesh(positions, random.integers(0, 7, (5, 3)), *uvs)
    path = tmp_path_factory.mktemp("obj") / "mesh.obj"
    mesh.write(path)
    assert load_mesh(path).content_hash == mesh.content_hash


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\n", "line 1: 2 coordinates are too few, got 'v 0 0'"),
        ("v 0 0 0\nv 0 zero 0\n", "line 2: could not convert string to float: 'zero'"),
        ("v 0 0 0\nf 1 x 1\n", "line 2: invalid literal"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", "faces: got 2 corners at face 0, expected 3 or more"),
        ("v 0 0 0\nf 1 1 2\n", r"face 0: vertex 1\), expected 0 to 0"),
        ("v 0 0 0\nf 1 1 0\n", r"face 0: vertex -1\)"),
        ("v 0 0 0\nv nan 0 0\nf 1 1 1\n", "first at vertex 1"),
        ("v 0 0 0\nv 1 0 0\n", r"faces: got none \(2 vertices\)"),
        ("", r"faces: got none \(0 vertices\)"),
        ("\0\1\2 junk", r"faces: got none \(0 vertices\)"),
    ],
)
def test_a_bad_obj_is_refused_with_its_line_or_face(tmp_path, text, message):
    path = write(tmp_path, "bad.obj", text)
    with pytest.raises(MeshError, match=message) as error:
        load_mesh(path)
    assert str(path) in str(error.value)


def test_oddities_are_accepted_with_one_warning_that_counts_each(tmp_path):
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 9 9 9\n"
    path = write(tmp_path, "odd.obj", vertices + "vt 0 0\nf 1 2 3\nf 2/1 3/1 1/1\nf 1 2 2\nf 1 2 4\n")
    with pytest.warns(UserWarning) as caught:
        mesh = load_mesh(path)
    assert mesh.face_count == 3 and mesh.vertex_count == 5 and mesh.uvs is None
    (message,) = [str(warning.message) for warning in caught]
    expected = [
        "2 degenerate faces",
        "1 duplicate faces dropped",
        "1 unreferenced vertices",
        "uvs dropped because 9 of 12",
    ]
    assert all(text in message for text in expected)


# ---------------------------------------------------------------------------------------------- PLY, STL, GLB


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
@pytest.mark.parametrize(
    ("part", "messages"),
    [
        (0.6, {"stl": "9650 bytes, .* says 320 triangles, which are 16084", "stl_ascii": "no endsolid"}),
        (0.0, {"stl": "got 0 bytes, fewer than", "stl_ascii": "got 0 bytes, fewer than"}),
    ],
)
def test_an_stl_file_that_is_cut_off_says_so(tmp_path, kind, part, messages):
    import trimesh

    ball = icosphere(1.0, 2)
    content = trimesh.Trimesh(ball.positions, ball.faces, process=False).export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "x.stl").write_bytes(content[: int(part * len(content))])
    with pytest.raises(MeshError, match=f"x.stl: faces: got none.*cut off.*({messages[kind]})"):
        load_mesh(tmp_path / "x.stl")


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
@pytest.mark.parametrize("part", [0.1, 0.3, 0.9, 1.0])
def test_a_ply_file_that_is_cut_off_says_so(tmp_path, encoding, part):
    import trimesh

    ball = icosphere(1.0, 2)
    content = trimesh.Trimesh(ball.positions, ball.faces, process=False).export(file_type="ply", encoding=encoding)
    content = content.encode() if isinstance(content, str) else content
    length = 60 if part == 0.1 else int(part * len(content))  # within the header
    (tmp_path / "x.ply").write_bytes(content[:length])
    if part == 1:
        assert load_mesh(tmp_path / "x.ply").face_count == ball.face_count
    else:
        with pytest.raises(
            MeshError, match=r"x.ply: the file is cut off: (its header has no end|got \d+ (lines|bytes))"
        ):
            load_mesh(tmp_path / "x.ply")


def test_uvs_of_vertices_need_no_faces_of_their_own():
    quad = plane(2.0, 1)
    uvs = quad.positions[:, ::2]
    mesh = Mesh(quad.positions, quad.faces, uvs)
    np.testing.assert_array_equal(mesh.uvs, uvs)
    np.testing.assert_array_equal(mesh.uv_faces, quad.faces)
    with pytest.warns(UserWarning, match="1 duplicate faces dropped"):
        twice = Mesh(quad.positions, [*quad.faces, quad.faces[0]], uvs)
    np.testing.assert_array_equal(twice.uv_faces, quad.faces)


def cylinder(normals=None):
    """A ring of four quads whose first and last columns coincide in space and differ in u."""
    angle = np.linspace(0, 2 * np.pi, 5)
    angle[-1] = 0
    ring = np.stack([np.cos(angle), np.zeros(5), np.sin(angle)], axis=1)
    vertices = np.concatenate([ring, ring + [0, 1, 0]])
    uvs = np.stack([np.tile(np.linspace(0, 1, 5), 2), np.repeat([0, 1], 5)], axis=1)
    faces = np.array([f for i in range(4) for f in ([i, i + 5, i + 1], [i + 1, i + 5, i + 6])])
    return vertices, faces, uvs


def export(folder, name, *, uvs=None, normals=None, vertices, faces, colors=None):
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, vertex_colors=colors, process=False)
    if uvs is not None:
        mesh.visual = trimesh.visual.TextureVisuals(uv=uvs, material=trimesh.visual.material.PBRMaterial())
    options = (
        {}
        if name.endswith(".stl")
        else {"vertex_normal" if name.endswith(".ply") else "include_normals": normals is not None}
    )
    mesh.export(folder / name, **options)
    return folder / name


@pytest.mark.parametrize("name", ["a.ply", "a.glb"])
@pytest.mark.parametrize("smooth", [None, True, False])
def test_a_uv_seam_shares_its_faces_unless_the_file_says_its_normals_differ(tmp_path, name, smooth):
    vertices, faces, uvs = cylinder()
    normals = None
    if smooth is not None:
        normals = vertices * [1, 0, 1]
        if not smooth:
            normals[[4, 9]] = [0, 0, -1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = load_mesh(export(tmp_path, name, vertices=vertices, faces=faces, uvs=uvs, normals=normals))
    np.testing.assert_allclose(mesh.positions, vertices, atol=1e-6)
    np.testing.assert_allclose(mesh.uvs, uvs, atol=1e-6)
    np.testing.assert_array_equal(mesh.uv_faces, faces)
    welded = np.where(faces == 4, 0, np.where(faces == 9, 5, faces))
    np.testing.assert_array_equal(mesh.faces, faces if smooth is False else welded)


@pytest.mark.parametrize("name", ["a.ply", "a.glb"])
def test_without_uvs_ply_is_welded_and_gltf_whose_faces_are_flat_is_not(tmp_path, name):
    vertices, faces, _ = cylinder()
    mesh = load_mesh(export(tmp_path, name, vertices=vertices, faces=faces))
    welded = np.where(faces == 4, 0, np.where(faces == 9, 5, faces))
    np.testing.assert_array_equal(mesh.faces, welded if name == "a.ply" else faces)
    assert mesh.uvs is None and mesh.vertex_count == 10


def test_an_stl_is_merged_but_at_sharp_edges(tmp_path):
    """A cylinder: its side is smooth, and its caps have corners of their own."""
    import trimesh

    can = trimesh.creation.cylinder(1.0, 2.0, sections=24)
    mesh = load_mesh(export(tmp_path, "a.stl", vertices=can.vertices, faces=can.faces))
    assert (mesh.face_count, mesh.vertex_count) == (96, 4 * 24 + 2)  # both ends of the side and both caps, and centers
    assert mesh.surface.is_closed and not mesh.rounds_edges
    np.testing.assert_allclose(mesh.positions[mesh.faces], can.vertices[can.faces], atol=1e-6)
    twice = np.concatenate([can.faces, can.faces[:, ::-1]])
    with pytest.warns(UserWarning, match="96 duplicate faces dropped"):
        other = load_mesh(export(tmp_path, "c.stl", vertices=can.vertices, faces=twice))
    np.testing.assert_array_equal(other.faces, mesh.faces)


def test_an_stl_without_many_sharp_edges_is_as_smooth_as_the_obj(tmp_path):
    """A rough ball: its edges bend by all angles up to 92°."""
    ball = icosphere(subdivisions=2)
    rough = ball.positions * np.random.default_rng(0).uniform(0.85, 1.15, (ball.vertex_count, 1))
    stl, obj = (load_mesh(export(tmp_path, name, vertices=rough, faces=ball.faces)) for name in ("a.stl", "a.obj"))
    assert stl.vertex_count == obj.vertex_count == ball.vertex_count
    np.testing.assert_allclose(stl.positions[stl.faces], obj.positions[obj.faces], atol=1e-6)


PLY_HEADER = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
PENTAGON = "0 0 0\n1 0 0\n2 1 0\n1 2 0\n0 1 0\n"


def test_ply_polygons_become_fans(tmp_path):
    header = PLY_HEADER + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    mesh = load_mesh(write(tmp_path, "a.ply", header + PENTAGON + "5 0 1 2 3 4\n"))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])


@pytest.mark.parametrize("binary", [False, True])
def test_ply_uvs_of_face_corners_stay_with_the_corners(tmp_path, binary):
    header = PLY_HEADER + "element face 2\nproperty list uchar int vertex_indices\n"
    header += "property list uchar float texcoord\nend_header\n"
    faces, uvs = [[0, 1, 2], [0, 2, 3]], np.float32([[0, 0, 1, 0, 1, 1], [0.5, 0, 1, 1, 0, 1]])
    path = tmp_path / "a.ply"
    if binary:
        row = np.dtype([("n", "u1"), ("i", "<i4", 3), ("m", "u1"), ("uv", "<f4", 6)])
        body = np.array([(3, face, 6, uv) for face, uv in zip(faces, uvs, strict=True)], row).tobytes()
        points = np.array(PENTAGON.split(), "<f4").tobytes()
        path.write_bytes(header.replace("ascii", "binary_little_endian").encode() + points + body)
    else:
        path.write_text(header + PENTAGON + "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0.5 0 1 1 0 1\n")
    with pytest.warns(UserWarning, match="1 unreferenced vertices"):
        mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_array_equal(mesh.uvs[mesh.uv_faces].reshape(2, 6), uvs)
    import trimesh

    shape = trimesh.load(path, process=False)
    np.testing.assert_array_equal(load_mesh(shape).uvs[mesh.uv_faces].reshape(2, 6), uvs)
    shape.update_faces([1, 0])  # to which the file's uvs of corners no longer belong
    turned = load_mesh(shape)
    np.testing.assert_array_equal(turned.uvs[turned.uv_faces], uvs[::-1].reshape(2, 3, 2))


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
def test_the_nodes_of_a_scene_are_flattened_in_world_space(tmp_path, name):
    import trimesh

    scene = trimesh.Scene()
    box = trimesh.creation.box()
    for x, mirror in ((0.0, 1.0), (5.0, -1.0)):
        transform = np.diag([mirror, 1.0, 1.0, 1.0])
        transform[0, 3] = x
        scene.add_geometry(box, node_name=f"box at {x}", geom_name="box", transform=transform)
    if name.endswith("glb"):
        scene.export(tmp_path / name)
    else:
        for file, content in trimesh.exchange.gltf.export_gltf(scene).items():
            (tmp_path / file.replace("model", "scene")).write_bytes(content)
    mesh = load_mesh(tmp_path / name)
    assert (mesh.vertex_count, mesh.face_count) == (16, 24)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.5, -0.5], [5.5, 0.5, 0.5]])
    middles = mesh.positions[mesh.faces].mean(1)
    centers = np.where(middles[:, :1] > 2.5, [5, 0, 0], [0, 0, 0])
    outward = np.sum(face_normals(mesh) * (middles - centers), axis=1)
    assert (outward > 0).all()


def test_uvs_that_only_some_nodes_have_are_dropped_with_a_warning(tmp_path):
    import trimesh

    vertices, faces, uvs = cylinder()
    scene = trimesh.Scene([trimesh.creation.box()])
    textured = trimesh.Trimesh(vertices, faces, process=False)
    textured.visual = trimesh.visual.TextureVisuals(uv=uvs, material=trimesh.visual.material.PBRMaterial())
    scene.add_geometry(textured)
    scene.export(tmp_path / "a.glb")
    with pytest.warns(UserWarning, match="uvs dropped because 1 of 2 parts have none"):
        mesh = load_mesh(tmp_path / "a.glb")
    assert mesh.uvs is None and mesh.face_count == 12 + len(faces)


def test_a_broken_gltf_is_not_replaced_by_its_neighbor(tmp_path):
    import trimesh

    for file, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box())).items():
        (tmp_path / file).write_bytes(content)
    assert json.loads((tmp_path / "model.gltf").read_bytes())
    with pytest.raises(MeshError, match="broken.gltf: not a readable .gltf file"):
        load_mesh(write(tmp_path, "broken.gltf", "no json"))


def test_a_point_cloud_is_refused(tmp_path):
    path = write(tmp_path, "points.ply", PLY_HEADER + "end_header\n" + PENTAGON)
    with pytest.raises(MeshError, match="points.ply: faces: got none"):
        load_mesh(path)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb", "gltf", "usd", "usda", "usdz"])
@pytest.mark.parametrize("content", [b"", b"junk " * 40])
def test_an_empty_or_foreign_file_is_refused(tmp_path, suffix, content):
    path = tmp_path / f"bad.{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=f"bad.{suffix}: "):
        load_mesh(path)


def test_unknown_extensions_and_missing_files_are_named(tmp_path):
    with pytest.raises(MeshError, match=r"got extension '.xyz', expected one of .obj, .ply"):
        load_mesh(tmp_path / "a.xyz")
    with pytest.raises(FileNotFoundError, match="no such mesh file"):
        load_mesh(tmp_path / "a.obj")
    with pytest.raises(MeshError, match="expected .obj"):
        plane(segments=1).write(tmp_path / "a.ply")


# -------------------------------------------------------------------------------------------------------- USD


USD_QUAD = """#usda 1.0
( upAxis = "{up}" )
def Xform "root"
{{
    double3 xformOp:translate = (10, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "quad"
    {{
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 3)]
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform token orientation = "{orientation}"
        {uvs}
    }}
    def Mesh "hidden"
    {{
        token visibility = "invisible"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
    }}
}}
"""
UVS = "texCoord2f[] primvars:st = {} ( interpolation = '{}' )"
FOUR = "[(0, 0), (1, 0), (1, 1), (0, 1)]"


def usd_quad(folder, up="Y", orientation="rightHanded", counts="[4]", uvs=""):
    return write(folder, "quad.usda", USD_QUAD.format(up=up, orientation=orientation, counts=counts, uvs=uvs))


@pytest.mark.parametrize(
    ("uvs", "expected"),
    [
        (UVS.format(FOUR, "vertex"), [[0, 0], [1, 0], [1, 1], [0, 1]]),
        (UVS.format(FOUR, "faceVarying"), [[0, 0], [1, 0], [1, 1], [0, 1]]),
        (
            UVS.format("[(0, 0), (1, 1)]", "faceVarying") + "\n int[] primvars:st:indices = [0, 1, 1, 0]",
            [[0, 0], [1, 1], [1, 1], [0, 0]],
        ),
        ("", None),
    ],
)
def test_a_usd_mesh_comes_in_world_space_with_its_uvs(tmp_path, uvs, expected):
    mesh = load_mesh(usd_quad(tmp_path, uvs=uvs))
    np.testing.assert_array_equal(mesh.positions, [[10, 0, 0], [11, 0, 0], [11, 1, 0], [10, 1, 3]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    if expected is None:
        assert mesh.uvs is None
    else:
        np.testing.assert_array_equal(mesh.uvs[mesh.uv_faces], np.float32(expected)[mesh.faces])


def test_a_z_up_stage_is_turned_y_up(tmp_path):
    mesh = load_mesh(usd_quad(tmp_path, up="Z"))
    np.testing.assert_array_equal(mesh.positions, [[10, 0, 0], [11, 0, 0], [11, 0, -1], [10, 3, -1]])


def test_a_left_handed_usd_mesh_is_turned_over(tmp_path):
    mesh = load_mesh(usd_quad(tmp_path, orientation="leftHanded"))
    np.testing.assert_array_equal(mesh.faces, [[2, 1, 0], [3, 2, 0]])


def test_a_usd_mesh_whose_counts_disagree_is_refused(tmp_path):
    with pytest.raises(MeshError, match="/root/quad: got 4 corners, expected 5"):
        load_mesh(usd_quad(tmp_path, counts="[5]"))


@pytest.mark.filterwarnings("ignore:.*rocks.*:UserWarning")
@pytest.mark.parametrize(
    ("name", "vertices", "faces"), [("bunny", 6102, 12200), ("bear", 1986, 3968), ("rocks", 5437, 10866)]
)
def test_the_meshes_that_come_with_warp_load(name, vertices, faces):
    import warp.examples

    mesh = load_mesh(f"{warp.examples.get_asset_directory()}/{name}.usd")
    assert (mesh.vertex_count, mesh.face_count) == (vertices, faces)


def test_usd_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match=r'USD needs the package usd-core: pip install "warpshadow\[usd\]"'):
        load_mesh(usd_quad(tmp_path))


# ------------------------------------------------------------------------------------------------- unwrapping


def uv_areas(mesh):
    """Signed areas of the faces in the texture."""
    a, b, c = np.moveaxis(mesh.uvs.astype(np.float64)[mesh.uv_faces], 1, 0)
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def overlap(mesh, size=512):
    """Most faces that hold one texel's center of a texture, in floating point; near edges none counts."""
    rows, columns = np.mgrid[:size, :size]
    points = np.stack([(columns + 0.5) / size, (rows + 0.5) / size], axis=-1)
    counts = np.zeros((size, size), int)
    for corners in mesh.uvs.astype(np.float64)[mesh.uv_faces]:
        low, high = (corners.min(axis=0) * size).astype(int), (corners.max(axis=0) * size).astype(int) + 1
        box = np.s_[low[1] : high[1], low[0] : high[0]]
        edges = np.roll(corners, -1, axis=0) - corners
        to_points = points[box][:, :, None] - corners
        sides = edges[:, 0] * to_points[..., 1] - edges[:, 1] * to_points[..., 0]
        counts[box] += (np.sign(sides.sum(axis=-1, keepdims=True)) * sides > 1e-7).all(axis=-1)
    return counts.max()


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_unwrapping_adds_uvs_without_overlap_and_keeps_all_else(scale):
    mesh = icosphere(subdivisions=2).transformed(scale=scale, translation=np.full(3, 3 * scale))
    unwrapped = unwrap(mesh, size=256)
    np.testing.assert_array_equal(unwrapped.positions, mesh.positions)
    np.testing.assert_array_equal(unwrapped.faces, mesh.faces)
    assert unwrapped.name == mesh.name
    assert unwrapped.uvs.min() >= 0 and unwrapped.uvs.max() <= 1
    areas = np.abs(uv_areas(unwrapped))
    assert areas.sum() > 0.3  # of the texture
    assert areas.max() < 4 * areas.min()  # the faces of the sphere differ by 1.3, charts distort by the rest
    assert overlap(unwrapped) == 1


def test_each_corner_keeps_its_vertex_across_seams():
    """Two faces that share a uv share the vertex; some vertices have several uvs."""
    unwrapped = unwrap(icosphere(subdivisions=2))
    vertex_of_uv = np.full(len(unwrapped.uvs), -1)
    vertex_of_uv[unwrapped.uv_faces] = unwrapped.faces
    np.testing.assert_array_equal(vertex_of_uv[unwrapped.uv_faces], unwrapped.faces)
    assert len(unwrapped.uvs) > unwrapped.vertex_count


def test_charts_keep_their_distance():
    unwrapped = unwrap(icosphere(subdivisions=0), size=128, padding=8)
    unique = np.unique(np.sort(unwrapped.uv_faces, axis=1), axis=0)
    chart = np.arange(len(unwrapped.uvs))
    for _ in range(len(chart)):
        for face in unique:
            chart[face] = chart[face].min()
    separate = chart[:, None] != chart
    distance = np.linalg.norm(unwrapped.uvs[:, None] - unwrapped.uvs, axis=-1)
    assert separate.any() and distance[separate].min() > 6 / 160  # the packed size is about that asked for


def test_degenerate_faces_are_unwrapped_with_the_others():
    mesh = icosphere(subdivisions=1)
    faces = np.concatenate([[[0, 0, 1], [2, 2, 2]], mesh.faces])
    unwrapped = unwrap(Mesh(mesh.positions, faces))
    np.testing.assert_array_equal(unwrapped.faces, faces)
    areas = np.abs(uv_areas(unwrapped))
    assert (areas[:2] == 0).all() and (areas[2:] > 1e-3).all()


def test_a_mesh_without_area_lies_on_a_point():
    unwrapped = unwrap(Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2], [1, 1, 1]]))
    assert (uv_areas(unwrapped) == 0).all() and np.isfinite(unwrapped.uvs).all()


def test_a_sphere_so_fine_that_it_is_flat_everywhere_is_unwrapped():
    """Left to itself, xatlas takes it for one chart without an edge, and crashes."""
    unwrapped = unwrap(icosphere(subdivisions=6))
    assert (np.abs(uv_areas(unwrapped)) > 0).all()


def test_uvs_that_a_mesh_had_are_replaced():
    mesh = plane(segments=1)
    stacked = Mesh(mesh.positions, mesh.faces, np.zeros((1, 2)), np.zeros_like(mesh.faces))
    assert np.abs(uv_areas(unwrap(stacked))).sum() > 0.9


@pytest.mark.parametrize("options", [{"size": 0}, {"size": 64.0}, {"padding": -1}, {"size": 4, "padding": 4}])
def test_bad_sizes_of_an_atlas_are_refused(options):
    with pytest.raises(MeshError, match="size, padding: got"):
        unwrap(plane(segments=1), **options)


def test_unwrapping_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(ImportError, match=r'pip install "warpshadow\[unwrap\]"'):
        unwrap(plane(segments=1))


# ---------------------------------------------------------------------------------------------------- normals


def test_vertex_normals_equal_their_float64_twin_for_every_instance(device):
    mesh = icosphere(1.0, 2)
    stretched = np.stack([mesh.positions * [1, 2, 3], mesh.positions @ QUARTER_TURN_Y + 5]).astype(np.float32)
    positions = wp.array(stretched, dtype=wp.vec3, device=device)
    normals = vertex_normals(positions, wp.array(mesh.faces, dtype=wp.vec3i, device=device)).numpy()
    for instance, got in zip(stretched.astype(np.float64), normals, strict=True):
        np.testing.assert_allclose(got, normals_twin(instance, mesh.faces), atol=1e-5)


def test_normals_of_a_welded_seam_are_smooth_across_it(tmp_path, device):
    vertices, faces, uvs = cylinder()
    mesh = load_mesh(export(tmp_path, "a.glb", vertices=vertices, faces=faces, uvs=uvs))
    lower, upper = normals_of(mesh, device)[[0, 5]]
    np.testing.assert_allclose(lower, upper * [1, 1, -1], atol=ROUNDING)  # by symmetry, though the diagonals tilt both
    assert lower[0] > 0.9 > np.sqrt(0.5)  # the normal of either quad


def test_faces_without_area_give_zero_normals_and_zero_gradients(device, verified_tape):
    points = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0], [7, 7, 7]])  # three on a line, and one without a face
    positions = wp.array(points[None], dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        normals = vertex_normals(positions, wp.array([[0, 1, 2], [1, 1, 1]], dtype=wp.vec3i, device=device))
    tape.backward(grads={normals: wp.ones_like(normals)})
    np.testing.assert_array_equal(normals.numpy(), np.zeros((1, 4, 3)))
    np.testing.assert_array_equal(positions.grad.numpy(), np.zeros((1, 4, 3)))


@pytest.mark.parametrize("size", [1.0, 0.03])
def test_a_normalized_mesh_is_in_the_middle_and_of_a_size(size):
    mesh = icosphere(7.0, 1).transformed(scale=(1, 0.2, 3), translation=(100, 7, 0))
    low, high = mesh.normalized(size).bounds
    np.testing.assert_allclose(low + high, 0, atol=1e-6 * size)
    assert (high - low).max() == pytest.approx(size, rel=1e-5)
    np.testing.assert_allclose((high - low) / size, np.ptp(mesh.positions, axis=0) / 42, rtol=1e-4)  # not stretched
    np.testing.assert_array_equal(mesh.normalized(size).faces, mesh.faces)


def test_normalizing_names_the_size_it_refuses():
    with pytest.raises(ValueError, match="^size: got -1"):
        icosphere().normalized(-1)
