"""The names that ``warpshadow.stages`` exports; stages import each other from their own modules."""

from warpshadow.stages.geometry.deform import DeformationGraph
from warpshadow.stages.geometry.nearest_rotation import nearest_rotations
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.geometry.rotations import rotation_matrices
from warpshadow.stages.image.film import average, sample_radiance
from warpshadow.stages.image.slopes import moving_radiance
from warpshadow.stages.light.light_samples import LightSamples, even_samples, sample_map
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer, sh_transfer
from warpshadow.stages.raster.barycentrics import find_barycentrics
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import compose_clip_matrices, to_clip
from warpshadow.stages.raster.rasterization import Fragments, rasterize
from warpshadow.stages.raster.sides import find_sides
from warpshadow.stages.ray_traced.traced_transfer import trace_transfer
from warpshadow.stages.rays.ray_tracing import trace_shading, trace_visibility
from warpshadow.stages.receivers.receivers import Receivers, find_receivers
from warpshadow.stages.receivers.vertex_receivers import Numbering, number_receivers, seen_vertices
from warpshadow.stages.silhouettes.edge_colors import find_edge_colors
from warpshadow.stages.silhouettes.silhouettes import Silhouettes, find_silhouettes
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes
from warpshadow.stages.textures.footprint import Footprints, find_footprints
from warpshadow.stages.textures.pyramid import Textures, mip_pyramids
from warpshadow.stages.textures.sample import sample_albedo, textured_radiance
from warpshadow.stages.textures.seen import fill_unseen, seen_texels
from warpshadow.stages.visibility.directional import transmittance
from warpshadow.stages.visibility.exponential import exponentiate
from warpshadow.stages.visibility.log_sh import accumulate

__all__ = [
    "DeformationGraph",
    "Footprints",
    "Fragments",
    "LightSamples",
    "Numbering",
    "Poses",
    "Receivers",
    "Silhouettes",
    "Textures",
    "accumulate",
    "average",
    "compose_clip_matrices",
    "directional_transfer",
    "even_samples",
    "exponentiate",
    "fill_unseen",
    "find_barycentrics",
    "find_edge_colors",
    "find_footprints",
    "find_receivers",
    "find_sides",
    "find_silhouettes",
    "interpolate",
    "mip_pyramids",
    "moving_radiance",
    "nearest_rotations",
    "number_receivers",
    "rasterize",
    "rotation_matrices",
    "sample_albedo",
    "sample_map",
    "sample_radiance",
    "seen_texels",
    "seen_vertices",
    "sh_transfer",
    "shade",
    "smooth_silhouettes",
    "textured_radiance",
    "to_clip",
    "trace_shading",
    "trace_transfer",
    "trace_visibility",
    "transmittance",
    "vertex_normals",
]
