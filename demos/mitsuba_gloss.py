"""glTF's metallic-roughness surface for Mitsuba, which has none: the same formula as the library's, for references."""

import functools
from typing import Any

import warpshadow as ws


@functools.cache
def register() -> None:
    """Make Mitsuba know the surface as "gltf", in the variant that is set."""
    import drjit as dr
    import mitsuba as mi

    class MetallicRoughness(mi.BSDF):
        """A dielectric over a diffuse surface, or a metal; single scattering."""

        def __init__(self, props: Any):
            mi.BSDF.__init__(self, props)
            self.color = mi.Color3f(*(props[channel] for channel in "rgb"))
            self.alpha = max(props["roughness"], 0.1) ** 2
            self.metallic, self.specular = props["metallic"], props["specular"]
            self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def _mirrors(self) -> Any:
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        def _eval_pdf(self, wi: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """The surface's reflection times the cosine, and the density of its samples."""
            mu, cosine = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
            active &= (mu > 0) & (cosine > 0)
            mirror = dr.normalize(wi + wo)
            square = self.alpha**2
            density = square / (dr.pi * ((mirror.z**2) * (square - 1) + 1) ** 2)
            slants = [dr.sqrt(x * x * (1 - square) + square) for x in (mu, cosine)]
            lobe = density * 0.5 / (cosine * slants[0] + mu * slants[1])
            grazing = dr.clip(1 - dr.dot(wi, mirror), 0, 1) ** 5
            fresnel = self.specular * (0.04 + 0.96 * grazing)
            metal = (self.color + (1 - self.color) * grazing) * lobe
            rest = (1 - fresnel) * self.color / dr.pi + fresnel * lobe
            value = (self.metallic * metal + (1 - self.metallic) * rest) * cosine
            pdf = 0.5 * cosine / dr.pi + 0.5 * self._mirrors().pdf(wi, mirror) / (4 * dr.dot(wi, mirror))
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> tuple[Any, Any]:
            """Draw a direction from the cosine, or from mirrors that are seen."""
            mirror, _ = self._mirrors().sample(si.wi, sample2)
            wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mi.reflect(si.wi, mirror))
            value, pdf = self._eval_pdf(si.wi, wo, active)
            result = dr.zeros(mi.BSDFSample3f)
            result.wo, result.pdf, result.eta = wo, pdf, 1.0
            result.sampled_type, result.sampled_component = mi.UInt32(+self.m_flags), mi.UInt32(0)
            return result, dr.select(pdf > 0, value / pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self._eval_pdf(si.wi, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self._eval_pdf(si.wi, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            return self._eval_pdf(si.wi, wo, active)

    mi.register_bsdf("gltf", MetallicRoughness)


def surface(body: ws.Body) -> dict[str, Any]:
    """The surface of a body that shines, of one color and one roughness."""
    register()
    values = {"roughness": 1.0, "metallic": 0.0, "specular": 1.0}
    for name in values:
        given = getattr(body, name)
        if given is not None:
            if given.size > 1:
                raise ValueError(f"Mitsuba: got {name} for each vertex, expected one number")
            values[name] = float(given[0])
    return {"type": "gltf", **dict(zip("rgb", body.albedo.tolist(), strict=True)), **values}
