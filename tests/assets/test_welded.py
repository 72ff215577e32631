"""Vertices that exporters split along seams: normals are smooth across them, and sharp edges stay."""

import numpy as np
import pytest

import warpshadow as ws

trimesh = pytest.importorskip("trimesh")
BALL = ws.icosphere(1.0, 2)
BOX = trimesh.creation.box()


def split(mesh: ws.Mesh) -> ws.Mesh:
    """The same, parted along x = 0: the faces beyond have vertices of their own."""
    is_beyond = mesh.positions[mesh.faces].mean(axis=1)[:, 0] > 0
    faces = np.where(is_beyond[:, None], mesh.faces + mesh.vertex_count, mesh.faces)
    used, faces = np.unique(faces, return_inverse=True)
    return ws.Mesh(mesh.positions[used % mesh.vertex_count], faces.reshape(-1, 3), mesh.positions[used % 162, :2])


def shares_normals(mesh: ws.Mesh) -> bool:
    return len(np.unique(mesh.faces)) == BALL.vertex_count


def test_split_vertices_are_joined_and_uvs_and_numbers_stay():
    parted = split(BALL)
    seam = len(np.unique(parted.faces)) - BALL.vertex_count
    assert seam > 10 and parted.split_count == seam and not BALL.split_count
    joined = parted.welded()
    assert shares_normals(joined) and not joined.split_count
    np.testing.assert_array_equal(joined.positions, parted.positions)
    np.testing.assert_array_equal(joined.positions[joined.faces], parted.positions[parted.faces])
    np.testing.assert_array_equal(joined.uv_faces, parted.uv_faces)


def test_vertices_of_two_colors_and_those_at_the_sharp_edges_of_boxes_stay_apart():
    parted = split(BALL)
    colors = np.random.default_rng(0).uniform(size=(parted.vertex_count, 3))
    colored = ws.Mesh(parted.positions, parted.faces, colors=colors)
    np.testing.assert_array_equal(colored.welded().faces, colored.faces)
    apart = ws.Mesh(BOX.vertices[BOX.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    box = apart.welded()
    assert len(np.unique(box.faces)) == 24 and not box.rounds_edges  # the halves of its sides are joined


def test_a_split_mesh_draws_lines_and_a_warning_says_so():
    def scene(mesh):
        ball = ws.Body(mesh, blockers=0, name="ball", receivers="vertex")
        return ws.Scene([ball], ws.EnvironmentMap.constant(1.0), ws.Camera.framing(ball, size=(16, 16)))

    parted = split(BALL)
    with pytest.warns(UserWarning, match=rf"'ball'\): {parted.split_count} vertices coincide .*welded"):
        lined = ws.render(scene(parted))
    np.testing.assert_allclose(ws.render(scene(parted.welded())), ws.render(scene(BALL)), atol=1e-5)
    assert lined.shape == (16, 16, 4)


@pytest.mark.parametrize("normals", [None, False, True])
@pytest.mark.parametrize("uvs", [False, True])
def test_ply_files_and_meshes_of_trimesh_are_smooth_across_seams(tmp_path, uvs, normals):
    """Whether they have normals that trimesh computed of the split mesh, or none."""
    parted = split(BALL)
    visual = trimesh.visual.TextureVisuals(uv=parted.uvs) if uvs else None
    source = trimesh.Trimesh(parted.positions, parted.faces, visual=visual, process=False)
    if normals is not None:
        source.export(tmp_path / "ball.ply", vertex_normal=normals)
    mesh = ws.load_mesh(source if normals is None else tmp_path / "ball.ply")
    assert shares_normals(mesh) and mesh.vertex_count == parted.vertex_count
    assert (mesh.uvs is not None) == uvs


def test_obj_files_are_read_as_they_are(tmp_path):
    parted = split(BALL)
    parted.write(tmp_path / "ball.obj")
    np.testing.assert_array_equal(ws.load_mesh(tmp_path / "ball.obj").faces, parted.faces)
