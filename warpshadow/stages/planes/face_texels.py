"""Face texels: radiosity at points of faces, of flat bodies from their grids, of others from the side of the face.

Faces of flat bodies may be as large as a room, and the shadows on them much smaller. A point with barycentrics w of a
face in a plane is at Σ w (a, b) in the axes of its grid (:mod:`.grid`), and has the bilinear radiosity of its texels
there, however far its body has been moved.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.stages.planes.cells import PlaneArrays, PlaneFootprint, fetch, find_mip_footprint, plane_arrays
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody, PlaneGrid
from warpshadow.stages.raster.interpolation import interpolate_at


@wp.struct
class FaceTexels:
    """The grids of flat bodies among all faces."""

    planes: PlaneArrays
    plane_of_face: wp.array(dtype=wp.int32)  # −1 for faces of other bodies; empty where no body is flat
    points: wp.array(dtype=wp.vec3)  # of vertices, along both axes of their plane [units of the body], and 0


def find_face_texels(
    blockers: PlaneBlockers, bodies: Sequence[PlaneBody], first_faces: Sequence[int], face_count: int, vertex_count: int
) -> FaceTexels:
    """Find where the faces of flat bodies are on their grids.

    Args:
        blockers: The planes.
        bodies: The same, of which each has a grid, and the number of its first vertex.
        first_faces: Number of the first face of each.
        face_count, vertex_count: Of all bodies.
    """
    plane_of_face, points = np.full(face_count, -1, np.int32), np.zeros((vertex_count, 3), np.float32)
    for plane, (body, first_face) in enumerate(zip(bodies, first_faces, strict=True)):
        plane_of_face[first_face : first_face + len(body.faces)] = plane
        of_body = slice(body.first_vertex, body.first_vertex + len(body.positions))
        points[of_body, :2] = (body.positions.astype(np.float64) - body.grid.origin) @ body.grid.frame[:2].T
    texels, device = FaceTexels(), blockers.levels.device
    texels.planes = plane_arrays(blockers, 1.0, None)
    texels.plane_of_face, texels.points = constant(plane_of_face, wp.int32, device), constant(points, wp.vec3, device)
    return texels


def no_face_texels(device: wp.DeviceLike) -> FaceTexels:
    """Make the face texels of a scene without flat bodies."""
    texels, planes = FaceTexels(), PlaneArrays()
    dtypes = {"grids": PlaneGrid, "levels": wp.vec3i, "level_scales": wp.vec2}
    dtypes |= {"covered": wp.vec3, "edges": wp.vec4, "edge_axes": wp.vec2}
    for name, dtype in dtypes.items():  # tapes ask all of them for gradients
        setattr(planes, name, wp.empty(0, dtype=dtype, device=device))
    texels.planes, texels.points = planes, wp.empty(0, dtype=wp.vec3, device=device)
    texels.plane_of_face = wp.empty(0, dtype=wp.int32, device=device)
    return texels


@wp.func
def radiosity_at(
    radiosity: wp.array(dtype=wp.vec3), texels: FaceTexels, faces: wp.array(dtype=wp.vec3i), side: int, weights: wp.vec3
):
    """Radiosity at a point of a side of a face, from all texels and, after them, all sides of faces."""
    face_count = texels.plane_of_face.shape[0]
    result = radiosity[radiosity.shape[0] - faces.shape[0] + side]
    if face_count > 0:
        plane = texels.plane_of_face[side % face_count]
        if plane >= 0:
            grid = texels.planes.grids[plane]
            if side < face_count or grid.sides == 2:
                point = interpolate_at(texels.points, faces[side], weights)
                footprint = PlaneFootprint()
                footprint.center = wp.vec2(point[0], point[1])
                first_level = grid.first_level + wp.where(side < face_count, 0, grid.level_count)
                mip = find_mip_footprint(grid, texels.planes, footprint)
                result = fetch(radiosity, texels.planes, first_level, mip)
    return result
