"""glTF's metallic-roughness surface for Mitsuba, which has none: the same formula as the library's, for references."""

import functools
from typing import Any

import numpy as np

import warpshadow as ws
from warpshadow.scene.material import GLOSS_ARGUMENTS

NAMES = ("color", *GLOSS_ARGUMENTS)


@functools.cache
def register() -> None:
    """Make Mitsuba know the surface as "gltf", in the variant that is set."""
    import drjit as dr
    import mitsuba as mi

    class MetallicRoughness(mi.BSDF):
        """A dielectric over a diffuse surface, or a metal; single scattering."""

        def __init__(self, props: Any):
            mi.BSDF.__init__(self, props)
            self.color, self.roughness, self.metallic, self.specular = (props[name] for name in NAMES)
            self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def _width(self, si: Any, active: Any) -> Any:
            return dr.maximum(self.roughness.eval_1(si, active), 0.1) ** 2

        def _mirrors(self, si: Any, active: Any) -> Any:
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self._width(si, active), True)

        def _eval_pdf(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """The surface's reflection times the cosine, and the density of its samples."""
            wi, color = si.wi, self.color.eval(si, active)
            metallic, specular = self.metallic.eval_1(si, active), self.specular.eval_1(si, active)
            mu, cosine = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
            active &= (mu > 0) & (cosine > 0)
            mirror = dr.normalize(wi + wo)
            square = self._width(si, active) ** 2
            density = square / (dr.pi * ((mirror.z**2) * (square - 1) + 1) ** 2)
            slants = [dr.sqrt(x * x * (1 - square) + square) for x in (mu, cosine)]
            lobe = density * 0.5 / (cosine * slants[0] + mu * slants[1])
            grazing = dr.clip(1 - dr.dot(wi, mirror), 0, 1) ** 5
            fresnel = specular * (0.04 + 0.96 * grazing)
            metal = (color + (1 - color) * grazing) * lobe
            rest = (1 - fresnel) * color / dr.pi + fresnel * lobe
            value = (metallic * metal + (1 - metallic) * rest) * cosine
            pdf = 0.5 * cosine / dr.pi + 0.5 * self._mirrors(si, active).pdf(wi, mirror) / (4 * dr.dot(wi, mirror))
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> tuple[Any, Any]:
            """Draw a direction from the cosine, or from mirrors that are seen."""
            mirror, _ = self._mirrors(si, active).sample(si.wi, sample2)
            wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mi.reflect(si.wi, mirror))
            value, pdf = self._eval_pdf(si, wo, active)
            result = dr.zeros(mi.BSDFSample3f)
            result.wo, result.pdf, result.eta = wo, pdf, 1.0
            result.sampled_type, result.sampled_component = mi.UInt32(+self.m_flags), mi.UInt32(0)
            return result, dr.select(pdf > 0, value / pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self._eval_pdf(si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self._eval_pdf(si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            return self._eval_pdf(si, wo, active)

    mi.register_bsdf("gltf", MetallicRoughness)


def texture(name: str, values: np.ndarray, channels: int = 1) -> dict[str, Any]:
    """Mitsuba's texture of a property of a body, one value or an image of linear values."""
    import mitsuba as mi

    if values.size != channels and values.ndim < 2 + (channels > 1):
        raise ValueError(f"Mitsuba: got {name} for each vertex, expected one or a texture")
    size = values.shape[:2] if values.size > channels else (1, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.array(values).reshape(*size, channels)), "raw": True}


def color_of(body: ws.Body) -> dict[str, Any]:
    """Mitsuba's texture of the reflectance of a body."""
    return texture("albedo", body.albedo if body.texture is None else body.texture, 3)


def surface(body: ws.Body, kind: str = "gltf") -> dict[str, Any]:
    """The surface of a body that shines: the library's, or Mitsuba's "principled", which differs a little."""
    values = dict.fromkeys(GLOSS_ARGUMENTS, np.ones(1, np.float32)) | {"metallic": np.zeros(1, np.float32)}
    values |= {name: given for name in values if (given := getattr(body, name)) is not None}
    textures = {name: texture(name, each) for name, each in values.items()}
    if kind == "gltf":
        register()
        return {"type": "gltf", "color": color_of(body), **textures}
    if values["specular"].size > 1:
        raise ValueError("Mitsuba: got specular values of a body, expected one, which is all that principled takes")
    textures["specular"] = 0.5 * float(values["specular"][0])  # 4% straight on
    return {"type": "principled", "base_color": color_of(body), **textures}


def alike(body: ws.Body) -> dict[str, dict[str, Any]]:
    """Mitsuba's own surfaces for a body of one metal or one plastic, by their names."""
    color = {"type": "rgb", "value": [*map(float, body.albedo)]}
    microfacets = {"distribution": "ggx", "alpha": float(body.roughness[0]) ** 2}
    if body.metallic is not None and body.metallic[0] == 1:
        other = {"type": "roughconductor", "material": "none", "specular_reflectance": color, **microfacets}
    else:
        other = {"type": "roughplastic", "int_ior": 1.5, "diffuse_reflectance": color, **microfacets}
    return {"principled": surface(body, "principled"), other["type"]: other}


def reflected_light(of_surface: dict[str, Any], degrees: float, rows: int = 64) -> np.ndarray:
    """The BRDF of a surface times the cosine, over directions of the hemisphere of equal solid angles, [3, direction].

    Args:
        of_surface: As of :func:`surface`, or one of Mitsuba's own.
        degrees: Angle of the viewer from the normal.
        rows: Of directions, of which each has twice as many.
    """
    import drjit as dr
    import mitsuba as mi

    height, azimuth = ((np.mgrid[:rows, : 2 * rows] + 0.5) / np.array([rows, 2 * rows])[:, None, None]).reshape(2, -1)
    azimuth, slant, viewer = 2 * np.pi * azimuth, np.sqrt(1 - height**2), np.radians(degrees)
    directions = mi.Vector3f(slant * np.cos(azimuth), slant * np.sin(azimuth), height)
    point = dr.zeros(mi.SurfaceInteraction3f, len(height))
    point.wi = mi.Vector3f(float(np.sin(viewer)), 0.0, float(np.cos(viewer)))
    return np.array(mi.load_dict(of_surface).eval(mi.BSDFContext(), point, directions, mi.Bool(True)))
