"""Warnings about a view: it shows nothing, a body is misplaced, or faces are too coarse for receivers at vertices."""

from collections.abc import Sequence

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.pipeline.receivers.choice_of_receivers import face_sizes, warn_of_coarse_faces
from warpshadow.pipeline.views.view import View
from warpshadow.scene.body import Body
from warpshadow.scene.remarks import (
    black_metals,
    blurred_shell,
    enclosures,
    lined_surfaces,
    misplacements,
    rounded_edges,
    sun_below,
    unframed,
)


def warn_of_view(view: View, cameras: Sequence[Camera] | None) -> bool:
    """Warn of an image that shows nothing, and of each likely mistake in the scene where its own cameras are given.

    Returns:
        Whether there was anything to warn of.
    """
    remarks, scene = [view.emptiness()], view.merged_scene.scene
    if cameras is not None:
        remarks += [] if remarks[0] else unframed(scene, cameras)
        remarks += [*enclosures(scene, cameras), *misplacements(scene), *rounded_edges(scene), *lined_surfaces(scene)]
        remarks += [*blurred_shell(scene), *sun_below(scene), *black_metals(scene)]
    for remark in filter(None, remarks):
        check.warn(remark)
    return any(remarks)


def warn_of_vertex_receivers(view: View, bodies: Sequence[Body], camera: Camera) -> None:
    """Warn of bodies with receivers at vertices whose faces are so large that shadows fall between these."""
    if any(body.receivers == "vertex" for body in bodies):
        clip_positions = view.clip_positions.value(view.call).numpy()
        images = zip(view.fragments.face_ids.numpy(), clip_positions, strict=True)
        warn_of_coarse_faces(bodies, face_sizes(images, view.merged_scene, camera))
