"""Total reflectance: the share of even light that a surface reflects in all directions, for light that bounces from it.

    ρ = (1 − m) (a (1 − s (F₀ + (1 − F₀) e)) + s (F₀ (W − W') + W')) + m a

for albedo a, metallic m, specular s and F₀ = 0.04, as :mod:`.reflection` mixes them; e is the mean of e(μ) there.
W(r) is the reflectance of white facets of roughness r, and W' that of facets which reflect (1 − v·h)⁵ [Karis 2013,
"Real Shading in Unreal Engine 4"; there for each direction of view].

Patches send light as diffuse surfaces of this albedo. Metals would send W a + (1 − a) W': so the image around three
metals is 0.2 to 0.4% nearer to Mitsuba, and 0.1 to 0.6% farther around three others, which send more to the ground than
diffuse surfaces do.
"""

import warp as wp

from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.gloss.reflection import DIELECTRIC_F0

# fitted to means over visible normals [Heitz 2018], by which W is off by at most 0.006, and W' by 0.0006
_WHITE = wp.constant(wp.vec4(0.0, 0.2478, -2.059, 1.2215))  # of r, r², r³ and r⁴ in W − 1
_SMOOTH_GRAZING = wp.constant(0.0466)  # W' of a mirror, where 1/21 is exact
_GRAZING = wp.constant(wp.vec4(0.0477, -0.4376, 0.5808, -0.235))  # of r, r², r³ and r⁴ in W' − W'(0)

_EVEN_GRAZING = wp.constant(0.0037)  # e: the mean of (1 − v·h)⁵ over directions of view and light, by their cosines


@wp.kernel
def _find_total_reflectance(
    # in
    albedo: wp.array2d(dtype=wp.vec3),
    roughness: wp.array2d(dtype=wp.vec3),
    metallic: wp.array2d(dtype=wp.vec3),
    specular: wp.array2d(dtype=wp.vec3),
    # out
    reflectance: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a point of an instance."""
    batch, point = wp.tid()
    a = albedo[instance_in(batch, albedo.shape[0]), point]
    r = roughness[instance_in(batch, roughness.shape[0]), point][0]
    m = metallic[instance_in(batch, metallic.shape[0]), point][0]
    s = specular[instance_in(batch, specular.shape[0]), point][0]
    powers = wp.vec4(r, r * r, r * r * r, r * r * r * r)
    white = 1.0 + wp.dot(_WHITE, powers)
    grazing = _SMOOTH_GRAZING + wp.dot(_GRAZING, powers)
    mirrored = s * (DIELECTRIC_F0 * (white - grazing) + grazing)
    diffuse = 1.0 - s * (DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * _EVEN_GRAZING)
    reflectance[batch, point] = ((1.0 - m) * diffuse + m) * a + (1.0 - m) * wp.vec3(mirrored, mirrored, mirrored)


def total_reflectance(albedo: wp.array, roughness: wp.array, metallic: wp.array, specular: wp.array) -> wp.array:
    """Find ρ of patches or vertices.

    Args:
        albedo: a, vec3 of shape [batch, point].
        roughness, metallic, specular: r, m and s as grays, vec3 of shape [batch, point]; s = m = 0 of diffuse surfaces,
            whose ρ is their albedo. Any batch may be 1, and then serves every instance.

    Returns:
        vec3 of shape [batch, point].

    Differentiable: all.
    """
    arrays = {"albedo": albedo, "roughness": roughness, "metallic": metallic, "specular": specular}
    reflectance = empty((common_batch(arrays), albedo.shape[1]), dtype=wp.vec3, device=albedo.device)
    launch(_find_total_reflectance, reflectance.shape, inputs=[*arrays.values()], outputs=[reflectance])
    return reflectance
