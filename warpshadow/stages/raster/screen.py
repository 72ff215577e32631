"""Screen: where samples, lines and planes lie in an image.

An image consists of *samples*: its pixels, or the parts of pixels at which a supersampled image is evaluated. All
stages that locate points in an image agree on this:

    sample        number row · width + column, from the top left; in flat images of a batch, instances follow each other
    position      (x, y) from −1 to 1, x to the right and y downwards: the x/w and y/w of clip space
    center        of the sample at (column, row): ((2 column + 1) / width − 1, (2 row + 1) / height − 1)
    vertex        its (x, y, w) in clip space; z is for depth alone
    to a ray      (x − w x₀, y − w y₀, w), relative to the ray through a position (x₀, y₀): nothing cancels near the ray
    line          ℓ with ℓ·(x, y, 1) = 0; a × b is the line through vertices a and b
    plane         n with n·(x, y, w) = 1; relative to a ray, n_w is the 1/w at which the ray meets it
    direction     from a sample's center to that of a neighbor: 0 right, 1 left, 2 below, 3 above
    axis          direction // 2, of a direction: 0 is x, 1 is y
    distance      from a sample's center along a direction, 1 at the neighbor's center [samples]
"""

import warp as wp

# ---------------------------------------------------------------------------------------------------- samples


@wp.func
def center(column: int, row: int, width: int, height: int):
    """Position of a sample's center."""
    x = float(2 * column + 1 - width) / float(width)
    y = float(2 * row + 1 - height) / float(height)
    return wp.vec2(x, y)


@wp.func
def sample_center(sample: int, width: int, height: int):
    """Position of the center of a sample of flat images."""
    row = sample // width
    return center(sample - row * width, row % height, width, height)


@wp.func
def half_size(width: int, height: int):
    """Samples in a unit of position, across and down."""
    return 0.5 * wp.vec2(float(width), float(height))


@wp.func
def neighbor(sample: int, direction: int, width: int):
    """The next sample in a direction."""
    step = wp.where(direction < 2, 1, width)
    return sample + wp.where(direction % 2 == 0, step, -step)


@wp.func
def has_neighbor(sample: int, direction: int, width: int, height: int):
    """Whether a sample has a neighbor in a direction."""
    row = sample // width
    place = wp.where(direction < 2, sample - row * width, row % height)
    last = wp.where(direction < 2, width, height) - 1
    return wp.where(direction % 2 == 0, place < last, place > 0)


@wp.func
def opposite(direction: int):
    """The opposite direction."""
    return wp.where(direction % 2 == 0, direction + 1, direction - 1)


@wp.func
def direction_sign(direction: int):
    """1 where a direction leads to larger positions, else −1."""
    return 1.0 - 2.0 * float(direction % 2)


# ---------------------------------------------------------------------------------------------------- faces


@wp.func
def relative_to_ray(vertex: wp.vec4, position: wp.vec2):
    """A vertex relative to the ray through a position."""
    return wp.vec3(vertex[0] - position[0] * vertex[3], vertex[1] - position[1] * vertex[3], vertex[3])


@wp.func
def relative_to_ray_adjoint(position: wp.vec2, adj_relative: wp.vec3):
    """The adjoint of `relative_to_ray`, by the vertex."""
    return wp.vec4(
        adj_relative[0],
        adj_relative[1],
        0.0,
        adj_relative[2] - position[0] * adj_relative[0] - position[1] * adj_relative[1],
    )


@wp.func
def ray_volumes(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Volumes spanned by a ray and two vertices each, relative to the ray: of one sign where the ray meets face abc."""
    return wp.vec3(b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0], a[0] * b[1] - a[1] * b[0])


@wp.func
def volume_rates(a: wp.vec4, b: wp.vec4, c: wp.vec4, position: wp.vec2, step: wp.vec2):
    """Changes of the volumes of `ray_volumes` over their sum, by a step to the right and one down.

    A value that is linear on the face, Σ v_i value_i / Σ v_i, changes by Σ rate_i (value_i − value). ``a``, ``b`` and
    ``c`` are the vertices in clip space.
    """
    relative_a = relative_to_ray(a, position)
    relative_b = relative_to_ray(b, position)
    relative_c = relative_to_ray(c, position)
    vertex_volumes = ray_volumes(relative_a, relative_b, relative_c)
    volume_sum = vertex_volumes[0] + vertex_volumes[1] + vertex_volumes[2]
    volumes_by_x = wp.vec3(
        relative_b[1] * c[3] - b[3] * relative_c[1],
        relative_c[1] * a[3] - c[3] * relative_a[1],
        relative_a[1] * b[3] - a[3] * relative_b[1],
    )
    volumes_by_y = wp.vec3(
        b[3] * relative_c[0] - relative_b[0] * c[3],
        c[3] * relative_a[0] - relative_c[0] * a[3],
        a[3] * relative_b[0] - relative_a[0] * b[3],
    )
    # seen edge-on the total vanishes: no less, then, than a millionth of the change of the volumes in a step
    minimum = 1.0e-6 * (
        step[0] * (wp.abs(volumes_by_x[0]) + wp.abs(volumes_by_x[1]) + wp.abs(volumes_by_x[2]))
        + step[1] * (wp.abs(volumes_by_y[0]) + wp.abs(volumes_by_y[1]) + wp.abs(volumes_by_y[2]))
    )
    scale = wp.where(wp.abs(volume_sum) > minimum, volume_sum, minimum + 1.0e-30)
    return (step[0] / scale) * volumes_by_x, (step[1] / scale) * volumes_by_y


@wp.func
def orientation(a: wp.vec4, b: wp.vec4, c: wp.vec4):
    """Volume that the eye spans with a face; its sign is the winding of the face on screen."""
    origin = wp.vec3(a[0], a[1], a[3])
    return wp.dot(wp.cross(wp.vec3(b[0], b[1], b[3]) - origin, wp.vec3(c[0], c[1], c[3]) - origin), origin)


@wp.func
def face_plane(corners: wp.vec3i, position: wp.vec2, clip_positions: wp.array(dtype=wp.vec4)):
    """Plane of a face, relative to the ray through a position."""
    a = relative_to_ray(clip_positions[corners[0]], position)
    b = relative_to_ray(clip_positions[corners[1]], position)
    c = relative_to_ray(clip_positions[corners[2]], position)
    normal = wp.cross(b - a, c - a)
    return normal / wp.dot(normal, a)


# ---------------------------------------------------------------------------------------------------- lines


@wp.func
def line_distance(line: wp.vec3, direction: int, half: wp.vec2):
    """Distance at which a line, relative to a sample's center, crosses a direction; ``half`` is `half_size`."""
    axis = direction // 2
    return -direction_sign(direction) * half[axis] * line[2] / line[axis]


@wp.func
def line_slope(line: wp.vec3, direction: int, half: wp.vec2):
    """Slope of a line: by how much it moves along a direction from one row (or column) to the next [samples]."""
    axis = direction // 2
    return wp.abs(line[1 - axis] / line[axis]) * half[axis] / half[1 - axis]


@wp.func
def ends_before(line: wp.vec3, direction: int):
    """Whether a line, positive on the surface that ends there, bounds the surface of the sample, not its neighbor."""
    return -direction_sign(direction) * line[direction // 2] > 0.0
