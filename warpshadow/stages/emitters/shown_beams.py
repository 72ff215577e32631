"""Emission that a camera sees of emitters with a beam."""

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_dimensions, run_length, split_launch
from warpshadow.stages.emitters.samples import PlacedSamples
from warpshadow.stages.emitters.spot_cones import spot_falloff
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.raster.project import eye_position
from warpshadow.stages.raster.rasterization import Fragments

_COST = 15.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _show_beams(
    first_row: int,
    worker: int,
    # in
    emission: wp.array2d(dtype=wp.vec3),
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    positions: wp.array2d(dtype=wp.vec3),
    clip_matrices: wp.array(dtype=wp.mat44),
    axes: wp.array2d(dtype=wp.vec3),
    emitter_of_face: wp.array(dtype=wp.int32),
    beams: wp.array(dtype=wp.vec2),
    run: int,
    # out
    shown_emission: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of samples of an instance."""
    row, column = wp.tid()
    batch, thread = split_launch(worker, first_row + row, column)
    fragment_batch = instance_in(batch, face_ids.shape[0])
    body_batch = instance_in(batch, positions.shape[0])
    eye = eye_position(clip_matrices[instance_in(batch, clip_matrices.shape[0])])
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[fragment_batch, sample]
        emitter = int(-1)
        if face >= 0:
            emitter = emitter_of_face[face]
        radiance = emission[instance_in(batch, emission.shape[0]), sample]
        if emitter >= 0:
            point = interpolate_at(positions[body_batch], faces[face], barycentrics[fragment_batch, sample])
            axis = wp.normalize(axes[instance_in(batch, axes.shape[0]), emitter])
            shown_emission[batch, sample] = spot_falloff(axis, eye - point, beams[emitter]) * radiance
        else:
            shown_emission[batch, sample] = radiance


def show_beams(
    emission: wp.array,
    fragments: Fragments,
    faces: wp.array,
    positions: wp.array,
    clip_matrices: wp.array,
    samples: PlacedSamples,
    emitter_of_face: wp.array,
    beams: np.ndarray,
) -> wp.array:
    """Take from the emission that samples of an image show the part that goes elsewhere.

    Args:
        emission: Of the samples, vec3 of shape [batch, height, width].
        faces: Corners, vec3i of shape [face].
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        clip_matrices: Cameras, mat44 of shape [batch].
        emitter_of_face: Number of the emitter that each face is of, −1 for none, int32 of shape [face].
        beams: Of all emitters, shape [emitter, 2].
    Returns:
        vec3 of shape [batch, height, width].
    Differentiable: emission, barycentrics of the fragments, positions, clip_matrices, samples.
    """
    _, height, width = emission.shape
    arrays = {"emission": emission, "fragments": fragments.face_ids, "geometry": positions, "cameras": clip_matrices}
    count, device = common_batch(arrays | {"emitters": samples.axes}), emission.device
    run = run_length(device, width)
    shown_emission = empty((count, height * width), dtype=wp.vec3, device=device)
    launch(
        _show_beams,
        run_dimensions(device, height * width // run, count),
        inputs=[
            *(rows(emission), *fragments.rows, faces, positions, clip_matrices, samples.axes),
            *(emitter_of_face, constant(beams, wp.vec2, device), run),
        ],
        outputs=[shown_emission],
        shared=[positions, clip_matrices, samples.axes],
        cost=_COST * run,
    )
    return reshaped(shown_emission, (count, height, width))
