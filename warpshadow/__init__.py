"""warpshadow: differentiable soft shadows on meshes under environment light, in NVIDIA Warp."""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from warpshadow.basis import CellBasis, HarmonicBasis
    from warpshadow.camera import Camera
    from warpshadow.image import ImageError, read_image, write_image
    from warpshadow.light import EnvironmentMap, synthetic_sky
    from warpshadow.mesh import Mesh, MeshError, icosphere, load_mesh, plane
    from warpshadow.renderer import Renderer, render
    from warpshadow.scene import Body, Scene, SceneError, Visibility, load_scene
    from warpshadow.spheres import Spheres, fit_spheres

_HOMES = {
    "basis": ("CellBasis", "HarmonicBasis"),
    "camera": ("Camera",),
    "image": ("ImageError", "read_image", "write_image"),
    "light": ("EnvironmentMap", "synthetic_sky"),
    "mesh": ("Mesh", "MeshError", "icosphere", "load_mesh", "plane"),
    "renderer": ("Renderer", "render"),
    "scene": ("Body", "Scene", "SceneError", "Visibility", "load_scene"),
    "spheres": ("Spheres", "fit_spheres"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that importing the package stays light."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
