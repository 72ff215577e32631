"""warpshadow: differentiable soft shadows on meshes under environment light, in NVIDIA Warp.

In all functions ``device`` is Warp's device to compute on, and ``progress`` shows a bar where something takes longer
than a second.
"""

import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING

from warpshadow import check as _check
from warpshadow.assets.basis import CellBasis, HarmonicBasis
from warpshadow.assets.camera import Camera
from warpshadow.assets.camera_files import load_cameras
from warpshadow.assets.color import linear_to_srgb, srgb_to_linear
from warpshadow.assets.image import ImageError, read_image, write_image
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh import Mesh, MeshError
from warpshadow.assets.mesh_files import load_mesh
from warpshadow.assets.picture import Picture
from warpshadow.assets.primitives import icosphere, infinite_ground, plane
from warpshadow.assets.sky import synthetic_sky
from warpshadow.assets.unwrap import unwrap
from warpshadow.assets.video import write_video
from warpshadow.device.parallel import set_thread_count, thread_count
from warpshadow.device.progress import show_bars as _show_bars
from warpshadow.device.startup import start_quietly as _start_quietly
from warpshadow.device.threads import one_call as _one_call
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.scene.body import Body
from warpshadow.scene.camera_path import CameraPath, Keyframe
from warpshadow.scene.files import SceneError, load_scene, write_scene
from warpshadow.scene.lamps import load_lights, point_light, spot_light
from warpshadow.scene.mesh_scene import default_scene
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import Visibility
from warpshadow.scene.walls import walls_of_light
from warpshadow.spheres import Spheres, fit_spheres

if _TYPE_CHECKING:
    from warpshadow.pipeline.views.layers import Layers
    from warpshadow.rendering.insert import insert
    from warpshadow.rendering.renderer import Renderer, render
    from warpshadow.tuning.tune import Tuning, tune
    from warpshadow.viewer import view

__version__ = "0.1.0"

_MODULES = {
    "Layers": "pipeline.views.layers",
    "Renderer": "rendering.renderer",
    "Tuning": "tuning.tune",
    "insert": "rendering.insert",
    "render": "rendering.renderer",
    "tune": "tuning.tune",
    "view": "viewer",
}
"""Modules of the names that need kernels: each is imported on first use."""

_SOLID = "Body(trimesh.creation.{}(…)).creased(), or Body(path) of a file"

_NAME_REMEDIES = {
    "fit": "warpshadow.inverse.fit",
    "TorchRenderer": "warpshadow.torch.TorchRenderer",
    "MixedRenderer": "warpshadow.torch.MixedRenderer",
    "look_at": "Camera.look_at(eye, target, fov_y=…, size=…)",
    "Light": "EnvironmentMap, or Body(…, emission=…) for a lamp",
    "cube": _SOLID.format("box"),
    "box": _SOLID.format("box"),
    "cylinder": _SOLID.format("cylinder"),
    "sphere": "icosphere",
    **dict.fromkeys(("load_envmap", "read_envmap", "load_environment_map"), "EnvironmentMap.read(path)"),
}
"""Remedies for names that are looked for here."""

__all__ = [
    "Body",
    "Camera",
    "CameraPath",
    "CellBasis",
    "EnvironmentMap",
    "Geometry",
    "HarmonicBasis",
    "ImageError",
    "Keyframe",
    "Layers",
    "Mesh",
    "MeshError",
    "Picture",
    "Renderer",
    "Scene",
    "SceneError",
    "Spheres",
    "Tuning",
    "Visibility",
    "default_scene",
    "fibonacci",
    "fit_spheres",
    "icosphere",
    "infinite_ground",
    "insert",
    "linear_to_srgb",
    "load_cameras",
    "load_lights",
    "load_mesh",
    "load_scene",
    "plane",
    "point_light",
    "quiet",
    "read_image",
    "render",
    "set_thread_count",
    "spot_light",
    "srgb_to_linear",
    "synthetic_sky",
    "thread_count",
    "tune",
    "unwrap",
    "view",
    "walls_of_light",
    "write_image",
    "write_scene",
    "write_video",
]


def quiet(*, progress: bool = True) -> None:
    """Start Warp without its messages about devices and modules, and without a word of a missing GPU.

    Other warnings and errors stay.

    Args:
        progress: Whether progress bars show from now on; False hides all of them, as ``progress=False`` hides the bars
            of one call.
    """
    _show_bars(_check.flag("progress", progress))
    _start_quietly()


def __dir__() -> list[str]:
    """The names of the module, imported or not, for completion."""
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        remedy = _NAME_REMEDIES.get(name)
        hint = f" (write {remedy})" if remedy else _check.suggestion(name, __all__)
        raise AttributeError(f"module 'warpshadow' has no attribute {name!r}{hint}")
    with _one_call:  # kernels must not be made while another thread loads some
        return getattr(_importlib.import_module(f"warpshadow.{_MODULES[name]}"), name)
