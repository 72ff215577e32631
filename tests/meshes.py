"""Meshes of several tests of stages."""

import numpy as np

import warpshadow as ws


def box(size=(1.0, 1.0, 1.0)):
    """A box of 12 large faces that look outward."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * size
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return ws.Mesh(corners, faces)


PLANE = np.array([[-1.7, -0.5, -1.1], [1.6, -0.9, -0.9], [1.5, 1.1, 0.9], [-1.4, 0.8, 1.2]])


def through_plane(mesh):
    """A body that pokes through a slanted plane: positions, faces and the body of each face."""
    faces = np.concatenate([mesh.faces, np.array([[0, 1, 2], [0, 2, 3]]) + len(mesh.positions)])
    return np.concatenate([mesh.positions, PLANE]), faces, np.repeat([0, 1], [len(mesh.faces), 2])
