"""Smoothing: samples at a silhouette blend, so that an image changes smoothly as it moves."""

import functools

import warp as wp

from warpshadow import check
from warpshadow.device.batch import accumulate
from warpshadow.device.tape import record_adjoint
from warpshadow.device.warp_internals import scalar_type
from warpshadow.stages.silhouettes.find import (
    NOTHING,
    Silhouettes,
    _has_neighbor,
    _lean,
    _line,
    _opposite,
    _plane,
    distance,
    ends_before,
    neighbor,
    pixel_center,
    relative,
)

wp.set_module_options({"max_unroll": 1})  # it compiles in 2.2 s instead of 3.1 s, and runs as fast


# ------------------------------------------------------------------------------------------------ what they change


@wp.func
def _pull(line: wp.vec3, center: wp.vec2):
    """A line or plane relative to a point of the screen, as a gradient in clip space."""
    return wp.vec4(line[0], line[1], 0.0, line[2] - center[0] * line[0] - center[1] * line[1])


@wp.kernel(enable_backward=False)
def _measure_adjoint(
    # in
    pixels: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    face_ids: wp.array(dtype=wp.int32),
    barycentrics: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    width: int,
    height: int,
    adj_areas: wp.array2d(dtype=wp.float32),
    # out
    adj_clip_positions: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a side of an entry's pixel: it pulls at the vertices of the line there."""
    entry, side = wp.tid()
    edge = edges[entry, side]
    seed = adj_areas[entry, side]
    if edge[0] != NOTHING and seed != 0.0:
        axis = side / 2
        pixel = pixels[entry]
        batch = pixel / (width * height)
        clip = clip_positions[batch]
        half_size = 0.5 * wp.vec2(float(width), float(height))
        center = pixel_center(pixel, width, height)
        line = _line(pixel, side, edge, width, height, face_ids, faces, clip)
        t = wp.clamp(distance(line, side, half_size), 0.0, 1.0)
        m = wp.min(_lean(line, side, half_size), 1.0)
        decline = float(0.0)  # of e with t
        if t <= 0.5 * (1.0 - m):
            decline = 1.0
        elif t < 0.5 * (1.0 + m):
            decline = (0.5 * (1.0 + m) - t) / m
        onward = seed * decline * half_size[axis] * float(2 * (side % 2) - 1)  # gradient by the line's place
        if edge[0] >= 0:
            across_a = relative(clip[edge[0]], center)[1 - axis]
            across_b = relative(clip[edge[1]], center)[1 - axis]
            spread = wp.where(axis == 0, -line[0], line[1])
            pull = onward * _pull(line / line[axis], center)
            wp.atomic_add(adj_clip_positions, batch, edge[0], (across_b / spread) * pull)
            wp.atomic_add(adj_clip_positions, batch, edge[1], (-across_a / spread) * pull)
        else:
            for end in range(2):
                at = pixel
                sign = float(1.0)
                if end == 1:
                    at = neighbor(pixel, side, width)
                    sign = -1.0
                corners = faces[face_ids[at]]
                ray = pixel_center(at, width, height)
                plane = _plane(corners, ray, clip)
                pull = sign * onward * (plane[2] / line[axis]) * _pull(plane, ray)
                for k in range(3):
                    wp.atomic_add(adj_clip_positions, batch, corners[k], barycentrics[at][k] * pull)


@wp.func
def _in_common(share: wp.vec2, across: wp.vec2):
    """Half of the overlap of two areas beyond neighboring edges, as a fraction of the first."""
    return 0.5 * wp.max(share[1] + across[1] - 1.0, 0.0) * across[0]


@functools.cache
def _blend_kernel(dtype: type) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        # in
        image: wp.array2d(dtype=dtype),
        pixels: wp.array(dtype=wp.int32),
        shares: wp.array2d(dtype=wp.vec2),
        width: int,
        # out
        smoothed: wp.array2d(dtype=dtype),
    ):
        """A thread owns an entry's pixel of an image; the smoothed image is a copy before."""
        instance, entry = wp.tid()
        pixel = pixels[entry]
        if pixel >= 0:
            here = image[instance, pixel]
            total = here
            for side in range(4):
                share = shares[entry, side]
                if share[0] > 0.0:
                    across = wp.where(side < 2, 2, 0)
                    counts = share[1] - _in_common(share, shares[entry, across])
                    counts -= _in_common(share, shares[entry, across + 1])
                    total += share[0] * counts * (image[instance, neighbor(pixel, side, width)] - here)
            smoothed[instance, pixel] = total

    return blend


@functools.cache
def _blend_adjoint_kernel(dtype: type) -> wp.Kernel:
    inner = wp.mul if dtype is wp.float32 else wp.dot

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        # in
        image: wp.array2d(dtype=dtype),
        pixels: wp.array(dtype=wp.int32),
        shares: wp.array2d(dtype=wp.vec2),
        width: int,
        entries: wp.array(dtype=wp.int32),
        edge_colors: wp.array3d(dtype=dtype),
        adj_smoothed: wp.array2d(dtype=dtype),
        # out
        adj_image: wp.array2d(dtype=dtype),
        adj_areas: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns an entry's pixel of an image; ``adj_image`` already holds the part by the pixel's own color."""
        instance, entry = wp.tid()
        pixel = pixels[entry]
        if pixel >= 0:
            seed = adj_smoothed[instance, pixel]
            for side in range(4):
                share = shares[entry, side]
                if share[0] > 0.0:
                    other = neighbor(pixel, side, width)
                    across = wp.where(side < 2, 2, 0)
                    counts = share[1] - _in_common(share, shares[entry, across])
                    counts -= _in_common(share, shares[entry, across + 1])
                    if adj_image:
                        wp.atomic_add(adj_image, instance, other, share[0] * counts * seed)
                        wp.atomic_sub(adj_image, instance, pixel, share[0] * counts * seed)
                    if adj_areas:
                        contrast = image[instance, other] - image[instance, pixel]
                        if edge_colors:
                            beyond = edge_colors[instance, entries[other], _opposite(side)]
                            contrast = beyond - edge_colors[instance, entry, side]
                        change = inner(seed, contrast)
                        wp.atomic_add(adj_areas, entry, side, counts * change)
                        for k in range(2):
                            common = _in_common(shares[entry, across + k], share)
                            wp.atomic_sub(adj_areas, entry, across + k, common * change)

    return blend_adjoint


@wp.kernel(enable_backward=False)
def _find_edge_colors(
    # in
    image: wp.array2d(dtype=wp.vec4),
    pixels: wp.array(dtype=wp.int32),
    edges: wp.array2d(dtype=wp.vec2i),
    face_ids: wp.array(dtype=wp.int32),
    sides: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    shading: wp.array2d(dtype=wp.vec3),
    receivers: wp.array(dtype=wp.int32),
    albedo: wp.array2d(dtype=wp.vec3),
    width: int,
    height: int,
    # out
    edge_colors: wp.array3d(dtype=wp.vec4),
):
    """A thread owns an entry's pixel of an image."""
    instance, entry = wp.tid()
    pixel = pixels[entry]
    if pixel >= 0:
        batch = pixel / (width * height)
        lit = wp.min(instance + batch, shading.shape[0] - 1)
        reflected = wp.min(instance + batch, albedo.shape[0] - 1)
        center = pixel_center(pixel, width, height)
        half_size = 0.5 * wp.vec2(float(width), float(height))
        clip = clip_positions[batch]
        here = image[instance, pixel]
        for side in range(4):
            edge = edges[entry, side]
            if edge[0] != NOTHING:
                line = _line(pixel, side, edge, width, height, face_ids, faces, clip)
                color = here
                opposite = _opposite(side)
                if edges[entry, opposite][0] == NOTHING and _has_neighbor(pixel, opposite, width, height):
                    rise = here - image[instance, neighbor(pixel, opposite, width)]
                    if rise[3] == 0.0:
                        color += wp.clamp(distance(line, side, half_size), 0.0, 1.0) * rise
                if edge[0] >= 0 and ends_before(line, side):
                    back = int(0)
                    if sides:
                        back = wp.where(sides[pixel] < faces.shape[0], 0, clip.shape[0])
                    first = receivers[back + edge[0]]
                    second = receivers[back + edge[1]]
                    if wp.min(first, second) >= 0:
                        across_a = relative(clip[edge[0]], center)[1 - side / 2]
                        across_b = relative(clip[edge[1]], center)[1 - side / 2]
                        place = wp.clamp(across_a / (across_a - across_b), 0.0, 1.0)
                        received = wp.lerp(shading[lit, first], shading[lit, second], place)
                        received = wp.cw_mul(received, albedo[reflected, pixel % (width * height)])
                        color = wp.vec4(received[0], received[1], received[2], 1.0)
                edge_colors[instance, entry, side] = wp.where(wp.isfinite(color), color, here)


def find_edge_colors(
    image: wp.array,
    silhouettes: Silhouettes,
    clip_positions: wp.array,
    shading: wp.array,
    receivers: wp.array,
    albedo: wp.array,
) -> wp.array:
    """Find the colors that surfaces have at the edges themselves.

    Shading changes fastest where a surface turns away from the eye: over the last half pixel of a ball, by a tenth. So
    the color of the near surface, which ends at the edge, is interpolated between the edge's vertices. The far surface
    has no vertices there: its color is extrapolated linearly from the two nearest pixels that see it.

    Args:
        image: Color and coverage before smoothing, vec4 of shape [batch, height, width].
        silhouettes: Of :func:`find_silhouettes`.
        clip_positions: Those that the silhouettes were found for, vec4 of shape [batch, vertex].
        shading: Of the receivers, vec3 of shape [batch, receiver].
        receivers: Receiver of each vertex, −1 for none, int32 of shape [vertex]; where the silhouettes' fragments have
            sides, those of their backs follow.
        albedo: Of the samples, vec3 of shape [batch, height, width].

    Returns:
        For each side of each entry the color at the edge of what the entry's pixel sees, vec4 of shape
        [instance, entry, 4], for :func:`smooth_silhouettes`.

    Not differentiable.
    """
    fragments = silhouettes.fragments
    batch_count, height, width = fragments.face_ids.shape
    instances = (image.shape[0] // batch_count, batch_count * height * width)
    edge_colors = wp.zeros((instances[0], *silhouettes.edges.shape), dtype=wp.vec4, device=image.device)
    wp.launch(
        _find_edge_colors,
        dim=edge_colors.shape[:2],
        inputs=[
            image.reshape(instances),
            silhouettes.pixels,
            silhouettes.edges,
            fragments.face_ids.flatten(),
            None if fragments.sides is None else fragments.sides.flatten(),
            silhouettes.faces,
            clip_positions,
            shading,
            receivers,
            albedo.reshape((albedo.shape[0], -1)),
            width,
            height,
        ],
        outputs=[edge_colors],
        device=image.device,
        record_tape=False,
    )
    return edge_colors


def smooth_silhouettes(
    image: wp.array, silhouettes: Silhouettes, clip_positions: wp.array, edge_colors: wp.array | None = None
) -> wp.array:
    """Smooth an image along silhouettes, by how much of a pixel lies beyond them.

    It takes a copy of the image and, beside that, time in proportion to the length of the silhouettes.

    Args:
        image: float32 or a vector of them, shape [batch, height, width]; of ones where there is a face and zeros
            elsewhere it becomes the coverage.
        silhouettes: Of :func:`find_silhouettes`; if their batch is 1 they serve every image.
        clip_positions: Those that the silhouettes were found for, vec4 of shape [batch, vertex]; they are moved.
        edge_colors: Of :func:`find_edge_colors`, by which edges pull at vertices; by default those of pixels.

    Returns:
        Smoothed image, like ``image``; a pixel lies within the range of itself and its four neighbors.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: image, clip_positions. Without edge colors an edge has those of the pixels beside it: where shading
    changes by δ over a pixel there, its gradient is δ/2 off. None have intersections within one surface, cuts
    by the near plane, and what leaves the image: there is no neighbor to take from.
    """
    fragments = silhouettes.fragments
    batch_count, height, width = fragments.face_ids.shape
    check.shape("image", image.shape, ("batch" if batch_count == 1 else batch_count, height, width))
    check.shape("clip_positions", clip_positions.shape, (batch_count, "vertex"))
    if scalar_type(image.dtype) is not wp.float32:
        raise ValueError(f"image: got dtype {image.dtype.__name__}, expected float32 or a vector of them")
    device, pixels, shares = image.device, silhouettes.pixels, silhouettes.shares
    smoothed = wp.clone(image, requires_grad=False)
    smoothed.requires_grad = image.requires_grad or clip_positions.requires_grad
    instances = (image.shape[0] // batch_count, batch_count * height * width)
    flat, flat_smoothed = image.reshape(instances), smoothed.reshape(instances)
    wp.launch(
        _blend_kernel(image.dtype),
        dim=(instances[0], pixels.size),
        inputs=[flat, pixels, shares, width],
        outputs=[flat_smoothed],
        device=device,
        record_tape=False,
    )

    def adjoint() -> None:
        adj_areas = None
        if image.requires_grad:
            accumulate(flat_smoothed.grad, flat.grad)
        if clip_positions.requires_grad:
            adj_areas = wp.zeros(shares.shape, dtype=wp.float32, device=device)
        wp.launch(
            _blend_adjoint_kernel(image.dtype),
            dim=(instances[0], pixels.size),
            inputs=[flat, pixels, shares, width, silhouettes.entries, edge_colors, flat_smoothed.grad],
            outputs=[flat.grad, adj_areas],
            device=device,
        )
        if clip_positions.requires_grad:
            wp.launch(
                _measure_adjoint,
                dim=shares.shape,
                inputs=[
                    pixels,
                    silhouettes.edges,
                    fragments.face_ids.flatten(),
                    fragments.barycentrics.flatten(),
                    silhouettes.faces,
                    clip_positions,
                    width,
                    height,
                    adj_areas,
                ],
                outputs=[clip_positions.grad],
                device=device,
            )

    record_adjoint(adjoint, [image, clip_positions, smoothed])
    return smoothed
