"""Scenes: bodies, light, camera and how visibility is computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.color import GRAY, srgb_to_linear
from warpshadow.assets.image import ImageError, read_rgb
from warpshadow.assets.light import LIGHT, EnvironmentMap, check_coefficients
from warpshadow.assets.mesh import Mesh, MeshError
from warpshadow.assets.mesh_files import Material, MeshSource, is_of_trimesh, load_material, load_shape
from warpshadow.assets.topology import CREASE
from warpshadow.check import AnyPath
from warpshadow.maths import sh
from warpshadow.maths.directions import check_count, falloff_width
from warpshadow.scene.rotation import rotation_matrix, rotation_vector
from warpshadow.spheres import Spheres
from warpshadow.stages.visibility.directional import SOFTNESS
from warpshadow.stages.visibility.exponential import THRESHOLDS
from warpshadow.stages.visibility.merging import MERGING, check_merging
from warpshadow.stages.visibility.zonal_logs import LOGS

SPHERE_METHODS = ("directional", "log-sh")
METHODS = (*SPHERE_METHODS, "none", "ray-traced")
DEFAULT_METHOD = "directional"  # method of renderers that are kept, where none is named
AUTO = "auto"
READ_BY = {
    "directions": ("directional",),
    "softness": ("directional", AUTO),
    "merging": (*SPHERE_METHODS, AUTO),
    "self_shadows": (*SPHERE_METHODS, AUTO),
    "order": ("log-sh", "none", "ray-traced", AUTO),
    "log": ("log-sh",),
    "base": ("log-sh",),
    "samples": ("directional", "ray-traced"),
    "sampling": ("ray-traced",),
    "error": (AUTO,),
}
"""The methods that read each setting of a :class:`Visibility`; "auto" leaves some to the chosen method."""

_NAMING = {name for name, methods in READ_BY.items() if DEFAULT_METHOD in methods and "ray-traced" not in methods}
"""Settings that name :data:`DEFAULT_METHOD` where they are not the default."""

BOUNCING = (*SPHERE_METHODS, "ray-traced", AUTO)  # the methods that find light that bounces

MOST_BOUNCES = 16

Bounces = int | Literal["all"]  # how often light bounces

RECEIVERS = (AUTO, "vertex", "pixel", "adaptive")

SELF_SHADOWS = ("traced", "rays", "spheres")

SAMPLINGS = ("independent", "shared")

SHARED_DIRECTIONS = 512
"""Directions that receivers share unless ``samples`` says how many, as in stills. Of 23 scenes of demos/kinds.py (128²,
direct light) stills have a mean error of 1.7%, at worst 3.5%, in a cage. With 256 edges of dim shadows show as streaks.
"""

_RAYS = 1024  # rays unless ``samples`` says how many, where each receiver has its own
SCENE = "a Scene; load_scene(path) reads one"  # the types of scenes that functions accept, for messages
COLORS = ".npy"  # suffixes of files with a color for each vertex; other text is no albedo

VALUES = ".npy"
"""Suffix of files with a number for each vertex."""

_SPHERES = ".npz"

GLOSS = ("roughness", "metallic", "specular")
"""Arguments of a body that say how it shines."""

GLOSSY = ("directional", "none", "ray-traced", AUTO)
"""The methods that show it."""

MEANT = {"color": "albedo", "colour": "albedo", "position": "translation"}
"""Replacements for likely mistakes in a body's arguments, and keys."""

BodyLike = int | str  # a body of a scene: its number, from 0, or its name

Item = TypeVar("Item")
PerBody = Sequence[Item | None] | Mapping[int, Item | None] | Mapping[str, Item | None]
"""Something for each body of a scene, a list of them all; or for some, by their numbers or names."""


@check.frozen
@dataclass(frozen=True, eq=False)
class Visibility:
    """How visibility is computed. A setting that the method does not read is refused unless it is the default.

    Args:
        method: "directional" transmittance of spheres, "log-sh" of spheres, "none" (no shadows), or "ray-traced"
            visibility of the meshes, the reference. "auto" leaves the choice to
            :func:`warpshadow.tuning.tune.resolved`. None, where nothing is named: "directional" for renderers that are
            kept, fits and data sets, and for stills, as by :func:`warpshadow.render`, rays that all receivers share,
            which need neither spheres nor tables. A setting that "directional" alone reads names it.
        directions: Number of direction cells of "directional", a multiple of 16.
        softness: κ of "directional": half-width of a shadow's soft edge in cell radii.
        merging: τ: half-angle under which four neighboring spheres of 512 or more are seen as one, in radii of a cell
            ("directional") or of a cell for each coefficient ("log-sh"); 0 for never.
        self_shadows: How a body casts shadows on itself: from its mesh, "traced" once by rays wherever its shape is not
            free, or from its "spheres". "rays" are as "traced", but under "directional" pixels send rays to the
            brightest cells in every image: a sun's edge has no teeth, and rotations and cameras have no gradient.
            Pictures that are made once have that under a sun. Bodies may say otherwise.
        order: Number of SH bands, 2 to 8: of "log-sh", of the light that "none" shades with, and of free light by
            "ray-traced".
        log: Logarithm of one cap of "log-sh": "eigen" or "cap".
        base: Base approximation of the exponential of "log-sh": "quadratic", "linear" or "optimal_linear".
        samples: Number of rays: of "ray-traced" for a pixel, dealt to its samples, or the directions that are shared;
            of "directional" for a vertex of a static body, where other bodies move. None, the default, for 512 where
            they are shared, as in stills, and for 1024 elsewhere (:attr:`ray_count`).
        sampling: Where the rays of "ray-traced" go: "independent", drawn from the light for each receiver, so that
            errors are noise, and go away as rays become many; or "shared", in directions that all receivers have in
            common, each for a part of the light: few rays are enough and there is no grain, but an edge of a shadow
            has steps, of at most what a ray brings. Stills have these.
        error: Largest relative error of shading that "auto" is to accept.
    """

    method: str | None = None
    directions: int = 128
    softness: float = SOFTNESS
    merging: float = MERGING
    self_shadows: str = "traced"
    order: int = 8
    log: str = "eigen"
    base: str = "quadratic"
    samples: int | None = None
    sampling: str = "independent"
    error: float = 0.05

    def __post_init__(self) -> None:
        self._check_values()
        reader = self.method or DEFAULT_METHOD
        changed = [name for name in READ_BY if getattr(self, name) != getattr(Visibility, name)]
        for name in changed:
            if reader not in READ_BY[name]:
                readers = " or ".join(map(repr, READ_BY[name]))
                raise ValueError(
                    f"{name}: got {getattr(self, name)!r}, which {reader!r} does not read, expected the default, "
                    f"{getattr(Visibility, name)!r}, or method = {readers}; visibility.by({reader!r}) leaves behind "
                    "what a method does not read"
                )
        if self.method is None and set(changed) & _NAMING:
            object.__setattr__(self, "method", DEFAULT_METHOD)

    def _check_values(self) -> None:
        if self.method is not None:
            check.choice("method", self.method, (*METHODS, AUTO))
        check_count("directions", self.directions)
        sh.check_order(self.order)
        check.choice("log", self.log, LOGS)
        check.choice("base", self.base, THRESHOLDS)
        check.choice("self_shadows", self.self_shadows, SELF_SHADOWS)
        check.choice("sampling", self.sampling, SAMPLINGS)
        if self.samples is not None:
            check.whole("samples", self.samples, what="directions")
        if not (check.is_number(self.error) and self.error > 0):
            raise ValueError(f"error: got {self.error!r}, expected a positive number such as 0.05, which is 5%")
        falloff_width(self.softness, self.directions)
        check_merging(self.merging)

    @property
    def ray_count(self) -> int:
        """Number of rays: ``samples``, or as many as the method has by default."""
        if self.samples is not None:
            return self.samples
        return SHARED_DIRECTIONS if self.sampling == "shared" else _RAYS

    @classmethod
    def of(cls, settings: Mapping[str, object]) -> Visibility:
        """Make one from settings for any methods, by their names: all are checked, and the method's own are used."""
        check.known_keys("key", settings, ("method", *READ_BY))
        every = object.__new__(cls)
        vars(every).update(settings)
        every._check_values()
        reader = every.method or DEFAULT_METHOD
        return cls(every.method, **{name: getattr(every, name) for name in READ_BY if reader in READ_BY[name]})

    def with_method(self) -> Visibility:
        """The same by "directional" where no method is named, as renderers that are kept have it."""
        return self if self.method else self.by(DEFAULT_METHOD)

    def by(self, method: str) -> Visibility:
        """The same by another method, with the settings that both read."""
        return Visibility.of(vars(self) | {"method": method})


@check.frozen
@dataclass(frozen=True, eq=False, init=False)
class Body:
    """A mesh with its reflectance, placed in the world: scale first, then rotation, then translation.

    A point p of the mesh is at R(s p) + t. The world is right-handed with y up; a rotation turns about the origin of
    the mesh, counter-clockwise seen from the tip of its axis. Surfaces are diffuse, or shine
    (``roughness``). Colors are linear RGB: ``srgb_to_linear`` converts those that color pickers show.

    A path, relative to the current folder, stands for its file, as in scene files.

    Args:
        mesh: The mesh, or any source that :func:`warpshadow.load_mesh` reads: a file, or a mesh or a scene of trimesh.
        albedo: Reflectance, linear RGB, for the body [3] or for each vertex [vertex, 3], or an .npy file of it. By
            default the file's texture, if all its faces share one, or else the colors of the mesh, or gray, 0.8.
        texture: Reflectance as an image in place of ``albedo``, which then does not count, linear RGB of shape
            [height, width, 3], or a file that :func:`warpshadow.read_image` reads; needs uvs.
        blockers: Number of spheres to fit to the mesh, or "auto" for as many as it needs, 8 to 1024
            (:func:`warpshadow.fit_spheres`), or the spheres themselves, or an .npz file of them; 0 or none casts no
            shadow, by rays neither. By method "directional" a flat body blocks light as the part of a plane that it is,
            for any number, and with "auto" a body of closed convex pieces, such as boxes, of prisms that are at most 32
            of these, such as walls with windows, or of at most 32 panels of cloth, the light of others as these; by
            others a flat body with all else on one side is a ground, for which any number means one sphere touching it
            from behind. Where light bounces, a body of 0 or none is lit and reflects all the same, and takes its light
            from nobody. If it is not flat, other bodies get that light by rays only: a sphere sends light in place of
            the light it blocks.
        rotation: Axis-angle vector [degrees], shape [3]: (0, 90, 0) is a quarter turn about +y, through the origin of
            the mesh's own space, wherever its vertices are; :meth:`on_ground` then stands the body where it is to
            stand, and :meth:`Renderer.placed` can turn it about its middle. A matrix, shape [3, 3], becomes such a
            vector. (In :mod:`warpshadow.torch` and :mod:`warpshadow.stages` axis-angle vectors are in radians.)
        translation: Offset [scene units], shape [3].
        scale: Factor, positive.
        receivers: Where light is evaluated: at every "vertex", or at every "pixel" that shows the body, which a mesh
            of few faces needs to receive a shadow; or "adaptive": on a flat body at some pixels, close to each other
            where shadows have edges, between which it is interpolated (by pixel on other bodies, and on a GPU). "auto"
            leaves it to each renderer: flat bodies of faces of more than 2 pixels are adaptive, with directional
            visibility on a CPU. Else it is by pixel where its cameras see faces of more than 16 pixels on average, or
            5% of the body's pixels show faces longer than 16 pixels (in images larger than 256 × 256, 1/4096 of the
            pixels, at most 400, and four times the root of that). Pictures that are made once, as by
            :func:`warpshadow.render`, show flat bodies by pixel, and under a sun all.
        self_shadows: How it casts shadows on itself, "traced", by "rays" or by its "spheres", as for
            :class:`Visibility`; None for the scene's setting.
        name: Its name for lookups; None for that of its mesh, so of the mesh's file. :attr:`called` is the one that
            counts.
        shadow_catcher: Whether it models a surface in the photograph: :func:`warpshadow.insert` does not draw it, and
            has it darken the photograph, or with bounces tint it, by the ratio of the light that it receives with the
            other bodies to the light without them. In the image of :func:`warpshadow.render` its shadow is coverage
            alone. ``draw``, torch's renderer, fits and the viewer show it as any other body.
        roughness: glTF's, in [0, 1], one number or one for each vertex [vertex], or an .npy file of them: the surface
            shines by a GGX lobe of width α = roughness². None, the default, is what the mesh's file says, if that is
            glTF and neither ``albedo`` nor ``texture`` is given, and else a diffuse surface. Below 0.1 it is shown as
            0.1. Such a body has receivers at pixels; all methods but "log-sh" show it. It reflects other bodies
            where light bounces; with ``bounces=0`` they are black in it, so metals want bounces.
        metallic: Likewise, how much of it is metal, which reflects its albedo and has no diffuse light; by default 0.
        specular: Likewise, strength of the reflection of what is not metal, of which 1, the default, is 4% straight on.
    """

    mesh: Mesh
    albedo: np.ndarray
    texture: np.ndarray | None = field(repr=False)
    blockers: int | str | Spheres
    rotation: np.ndarray
    translation: np.ndarray
    scale: float
    receivers: str
    name: str | None
    self_shadows: str | None
    shadow_catcher: bool
    roughness: np.ndarray | None
    metallic: np.ndarray | None
    specular: np.ndarray | None

    @check.keywords(**MEANT, spheres="blockers", path="mesh")
    def __init__(
        self,
        mesh: Mesh | MeshSource,
        albedo: npt.ArrayLike | AnyPath | None = None,
        texture: npt.ArrayLike | AnyPath | None = None,
        blockers: int | str | Spheres | AnyPath = AUTO,
        rotation: npt.ArrayLike = (0.0, 0.0, 0.0),
        translation: npt.ArrayLike = (0.0, 0.0, 0.0),
        scale: float = 1.0,
        receivers: str = AUTO,
        name: str | None = None,
        self_shadows: str | None = None,
        shadow_catcher: bool = False,
        roughness: npt.ArrayLike | AnyPath | None = None,
        metallic: npt.ArrayLike | AnyPath | None = None,
        specular: npt.ArrayLike | AnyPath | None = None,
    ):
        vars(self).update(mesh=mesh, albedo=albedo, texture=texture, blockers=blockers)
        vars(self).update(rotation=rotation, translation=translation, scale=scale, receivers=receivers, name=name)
        vars(self).update(self_shadows=self_shadows, shadow_catcher=check.flag("shadow_catcher", shadow_catcher))
        vars(self).update(roughness=roughness, metallic=metallic, specular=specular)
        self._read_mesh()
        self._read_files()
        expected = "a Mesh or the path of a file, or a mesh of trimesh; Mesh(positions, faces) makes one of arrays"
        check.instance("mesh", self.mesh, Mesh, expected)
        object.__setattr__(self, "albedo", self._checked_albedo())
        if self.texture is not None:
            object.__setattr__(self, "texture", self._checked_texture(self.texture))
        if not isinstance(self.blockers, Spheres) and not (isinstance(self.blockers, str) and self.blockers == AUTO):
            if not check.is_integer(self.blockers) or self.blockers < 0:
                raise ValueError(
                    f"blockers: got {check.described(self.blockers)}, expected a number of spheres, 0 or more, or "
                    "'auto', or Spheres, such as fit_spheres(mesh).spheres, or an .npz file of them"
                )
            object.__setattr__(self, "blockers", int(self.blockers))
        object.__setattr__(self, "rotation", rotation_vector(self.rotation))
        object.__setattr__(self, "translation", check.array("translation", self.translation, (3,)))
        if not (check.is_number(self.scale) and 0 < self.scale <= check.LARGEST):
            raise ValueError(
                f"scale: got {check.described(self.scale)}, expected a positive number up to {check.LARGEST:g} for all "
                "axes; mesh.transformed(scale=(x, y, z)) stretches a mesh"
            )
        check.choice("receivers", self.receivers, RECEIVERS)
        self._check_gloss()
        if self.self_shadows is not None:
            check.choice("self_shadows", self.self_shadows, SELF_SHADOWS)
        if self.name is not None and not (isinstance(self.name, str) and self.name):
            raise ValueError(f"name: got {check.described(self.name)}, expected a name, or None for the mesh's")

    def __repr__(self) -> str:
        count = len(self.blockers) if isinstance(self.blockers, Spheres) else self.blockers
        texture = "" if self.texture is None else f", texture {self.texture.shape[1]} × {self.texture.shape[0]}"
        mesh = f"{self.mesh.vertex_count} vertices, {self.mesh.face_count} faces"
        return f"Body({self.called!r}, {mesh}, {count} spheres{texture})"

    @property
    def called(self) -> str:
        """Its name, or else its mesh's."""
        return self.name or self.mesh.name

    @property
    def casts_shadow(self) -> bool:
        """Whether the body blocks light."""
        return bool(len(self.blockers) if isinstance(self.blockers, Spheres) else self.blockers)

    @property
    def blocks_as_parts(self) -> bool:
        """Whether a method that knows convex parts takes these for what blocks the light of others."""
        return isinstance(self.blockers, str) and bool(self.mesh.convex_parts)

    def _read_mesh(self) -> None:
        """Load the mesh from its file or from trimesh, and its surface where none is given."""
        mesh, material = self.mesh, Material()
        source = check.file("mesh", mesh) if check.is_path(mesh) else mesh
        if check.is_path(source) or is_of_trimesh(source):
            with check.located("mesh", MeshError):
                if self.albedo is None and self.texture is None:
                    mesh, material = load_material(source)
                else:
                    mesh = load_shape(source)
        vars(self).update(
            mesh=mesh,
            albedo=_colors(mesh) if self.albedo is None else self.albedo,
            texture=material.texture if self.texture is None else self.texture,
        )
        is_diffuse = self.shadow_catcher or self.receivers in ("vertex", "adaptive")
        if all(getattr(self, name) is None for name in GLOSS) and not is_diffuse:
            vars(self).update(roughness=material.roughness, metallic=material.metallic)

    def _read_files(self) -> None:
        """Replace paths by the content of their files."""
        readers: tuple[tuple[str, Callable[[Path], Any], str, type[ValueError]], ...] = (
            ("texture", read_rgb, "", ImageError),
            ("albedo", _read_colors, COLORS, ValueError),
            ("blockers", Spheres.read, _SPHERES, ValueError),
            *((name, _read_values, VALUES, ValueError) for name in GLOSS),
        )
        for name, read, suffix, error in readers:
            value = getattr(self, name)
            if check.is_path(value) and str(value).endswith(suffix):
                path = check.file(name, value)
                with check.located(name, error):
                    object.__setattr__(self, name, read(path))

    def _checked_albedo(self) -> np.ndarray:
        count = self.mesh.vertex_count
        expected = "a linear color such as (0.8, 0.1, 0.1), one for each vertex, [vertex, 3], or an .npy file of them"
        if isinstance(self.albedo, str):
            raise ValueError(f"albedo: got {self.albedo!r}, expected {expected}{_meant(self.albedo)}")
        albedo = check.numbers("albedo", self.albedo, expected=expected)
        if albedo.shape not in ((3,), (count, 3)):
            raise ValueError(f"albedo: got shape {albedo.shape}, expected [3] or [{count}, 3] (one for each vertex)")
        check.reflectance("albedo", albedo)
        albedo.setflags(write=False)
        if getattr(self.albedo, "dtype", None) == np.uint8:  # as it is, all but black
            check.pixels("albedo", self.albedo, expected=expected)
        return albedo

    def _checked_texture(self, image: np.ndarray) -> np.ndarray:
        if self.mesh.uvs is None:
            raise ValueError(
                f"texture: got an image, but mesh {self.mesh.name!r} has no uvs; expected none, or uvs, as "
                "warpshadow.unwrap makes them"
            )
        texture = check.pixels("texture", image, expected="linear RGB [height, width, 3], or the path of a picture")
        check.shape("texture", texture.shape, ("height", "width", 3), check.channels_last(texture.shape))
        if texture.size == 0:
            raise ValueError(f"texture: got shape {texture.shape}, expected at least one texel")
        check.reflectance("texture", texture)
        texture.setflags(write=False)
        return texture

    def _check_gloss(self) -> None:
        """Hold roughness and its like as float32, [1] or [vertex]; without roughness there is none of them."""
        expected = f"a number from 0 to 1, one for each vertex, [vertex], or an {VALUES} file of them"
        for name in GLOSS:
            value = getattr(self, name)
            if value is None:
                continue
            if self.roughness is None:
                raise ValueError(f"{name}: got {check.described(value)} without roughness, expected roughness, too")
            numbers = np.atleast_1d(check.numbers(name, value, expected=expected))
            check.shape(name, numbers.shape, (1 if numbers.shape == (1,) else self.mesh.vertex_count,), expected)
            check.finite(name, numbers, minimum=0.0, maximum=1.0)
            numbers.setflags(write=False)
            object.__setattr__(self, name, numbers)
        if self.roughness is not None and self.shadow_catcher:
            raise ValueError("roughness: got some for a shadow catcher, expected None: it shows diffuse light alone")
        if self.roughness is not None and self.receivers in ("vertex", "adaptive"):
            raise ValueError(
                f"receivers: got {self.receivers!r} beside roughness, expected 'pixel' or 'auto', since "
                "reflections depend on the camera"
            )

    @property
    def is_glossy(self) -> bool:
        """Whether it shines."""
        return self.roughness is not None

    def rotation_matrix(self) -> np.ndarray:
        """The rotation as a matrix, float64 of shape [3, 3]."""
        return rotation_matrix(self.rotation)

    def creased(self, angle: float = CREASE) -> Body:
        """Part the vertices of its mesh along sharp edges, :meth:`warpshadow.Mesh.creased`; their colors go along.

        Args:
            angle: Edges are sharp where their faces bend by more [degrees], 0 to 180.
        """
        mesh = self.mesh.creased(angle)
        values: dict[str, Any] = {name: getattr(self, name) for name in GLOSS}
        of_vertices = {name: array[mesh.origins] for name, array in values.items() if np.size(array) > 1}
        colors = self.albedo if self.albedo.ndim == 1 else self.albedo[mesh.origins]
        return replace(self, mesh=mesh, albedo=colors, **of_vertices)

    @check.keywords(rotation="Body(…, rotation=…).on_ground(…)", scale="size", height="size", translation="foot")
    def on_ground(self, foot: npt.ArrayLike = (0.0, 0.0, 0.0), *, size: float | None = None) -> Body:
        """Stand the body on a ground, as it is turned; its spheres are not fitted again.

        Rotated, it stands at the same place and has the same size, since both come from the mesh's bounds.

        Args:
            foot: Where its bottom goes, below the middle of the mesh's bounds [scene units], shape [3].
            size: Longest edge of the mesh's bounds, turned with it [scene units]; by default its scale stays.
        """
        if np.ndim(foot) == 0:
            raise ValueError(
                f"foot: got {foot!r}, expected where its bottom goes, [3]; on_ground(size={foot!r}) scales it"
            )
        foot = check.array("foot", foot, (3,))
        low, high = (corner.astype(np.float64) for corner in self.mesh.bounds)
        scale = self.scale if size is None else check.positive("size", size) / (high - low).max()
        points = self.mesh.world_points().astype(np.float64) @ self.rotation_matrix().T
        bottom = self.rotation_matrix() @ (low + high) / 2
        bottom[1] = points[:, 1].min()
        return replace(self, scale=float(scale), translation=foot - scale * bottom)

    def world_points(self) -> np.ndarray:
        """The vertices that faces refer to, where they are in the world [scene units], float64 of shape [point, 3]."""
        points = self.mesh.world_points().astype(np.float64)
        return self.scale * points @ self.rotation_matrix().T + self.translation

    def world_mesh(self) -> Mesh:
        """The mesh in world space."""
        return self.mesh.transformed(
            rotation=self.rotation_matrix(), translation=np.array(self.translation), scale=self.scale
        )


_DEFAULT_VISIBILITY = Visibility()


def _colors(mesh: Mesh | MeshSource) -> npt.ArrayLike:
    """The colors of a mesh, one where all are the same, or gray."""
    colors = mesh.colors if isinstance(mesh, Mesh) else None
    if colors is None:
        return GRAY
    return colors if np.ptp(colors, axis=0).any() else colors[0]


def _read_colors(path: Path, shape: str = "[vertex, 3]") -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"got {path} ({error}), expected an .npy file of {shape}") from error


def _read_values(path: Path) -> np.ndarray:
    return _read_colors(path, "[vertex]")


def _meant(color: str) -> str:
    """The linear RGB of a color of CSS, for messages; nothing for other text."""
    from PIL import ImageColor

    try:
        linear = srgb_to_linear(np.array(ImageColor.getrgb(color)[:3]) / 255)
    except ValueError:
        return ""
    return f": that color is ({', '.join(f'{value:.4g}' for value in linear)})"


def check_supersampling(count: object) -> None:
    """Raise ValueError unless it is a number of samples across a pixel, 1 to 16."""
    if not check.is_integer(count) or count not in range(1, 17):
        raise ValueError(f"supersampling: got {check.described(count)}, expected a whole number from 1 to 16")


def check_bounces(count: object) -> None:
    """Raise ValueError unless it is a number of bounces, 0 to 16, or "all"."""
    is_all = isinstance(count, str) and count == "all"
    if not is_all and (not check.is_integer(count) or count not in range(MOST_BOUNCES + 1)):
        expected = f'a whole number from 0 to {MOST_BOUNCES}, or "all"'
        raise ValueError(f"bounces: got {check.described(count)}, expected {expected}")


def _check_order(settings: Mapping[str, object]) -> None:
    """Raise ValueError where a scene's arguments stand in each other's places."""
    swapped = [f"{role} in place of {name}" for name, value in settings.items() if (role := _role(value, name)) != name]
    if swapped:
        raise ValueError(f"Scene: got {' and '.join(swapped)}, expected Scene(bodies, light, camera, visibility)")


def _role(value: object, name: str) -> str:
    """The argument of a scene that a value is meant for; that of the name where it is of no such class."""
    items = value if isinstance(value, (list, tuple)) else [value]
    if any(isinstance(item, Body) for item in items):
        return "bodies"
    roles = {EnvironmentMap: "light", Camera: "camera", Visibility: "visibility"}
    return next((role for kind, role in roles.items() if isinstance(value, kind)), name)


@check.frozen
@dataclass(frozen=True, eq=False, init=False)
class Scene:
    """Bodies, their light and a camera, in a right-handed world with y up, in units of length of your choice.

    Light is linear RGB radiance from infinitely far away. An image is its color times reflectance, without exposure:
    white ground under light of 1 from everywhere is 1. Pictures have their own exposure, :class:`warpshadow.Picture`.

    Args:
        bodies: One or more bodies; they cast shadows on each other and on themselves.
        light: Environment map, or SH coefficients [order², 3] as of a :class:`warpshadow.HarmonicBasis`, or the path of
            a map, relative to the current folder. Coefficients in cells become a map by ``basis.to_map``.
        camera: The camera; None for one that shows all bodies, :meth:`Camera.framing`.
        visibility: How visibility is computed.
        supersampling: Each pixel averages this many samples across and down, which smooths silhouettes.
        bounces: How often light bounces between bodies before it reaches a visible surface, 0 to 16; 0 is direct light
            alone, which is the paper's model. Within a body, such as a bowl, it then goes on eight times more, which
            costs next to nothing; only paths, of ``ray-traced``, end after so many bounces of any kind. "all" costs as
            much as five, and adds all further ones as a sum of three geometric series (:mod:`.stages.bounces.tail`).
    """

    bodies: tuple[Body, ...]
    light: EnvironmentMap | np.ndarray
    camera: Camera
    visibility: Visibility
    supersampling: int = 2
    bounces: Bounces = 0

    @check.keywords(
        cameras="camera; several go to Renderer(scene, cameras=[…])",
        method="visibility=Visibility(method)",
        light="Scene(bodies, synthetic_sky()), or the path of a map",
    )
    def __init__(
        self,
        bodies: Iterable[Body],
        light: EnvironmentMap | npt.ArrayLike | AnyPath,
        camera: Camera | None = None,
        visibility: Visibility = _DEFAULT_VISIBILITY,
        supersampling: int = supersampling,
        bounces: Bounces = bounces,
    ):
        _check_order({"bodies": bodies, "light": light, "camera": camera, "visibility": visibility})
        check.instance("bodies", bodies, Iterable, "a list of one or more: [Body(mesh)]")
        vars(self).update(bodies=tuple(bodies), light=light, camera=camera)
        vars(self).update(visibility=visibility, supersampling=supersampling, bounces=bounces)
        if not self.bodies:
            raise ValueError("bodies: got none, expected one or more")
        for number, body in enumerate(self.bodies):
            check.instance(f"bodies[{number}]", body, Body, "a Body, as Body(mesh) makes it of a mesh")
            if body.name is not None and body.name in [other.name for other in self.bodies[:number]]:
                raise ValueError(f"bodies[{number}]: name: got {body.name!r}, as another has, expected one of its own")
        if camera is None:
            object.__setattr__(self, "camera", Camera.framing(self.bodies))
        check.instance("camera", self.camera, Camera, "a Camera; several go to Renderer(scene, cameras=[…])")
        check.instance("visibility", self.visibility, Visibility, "a Visibility, such as Visibility('directional')")
        value: Any = self.light
        if check.is_path(value):
            path = check.file("light", value)
            with check.located("light", ImageError):
                object.__setattr__(self, "light", EnvironmentMap.read(path))
        if not isinstance(self.light, EnvironmentMap):
            light = check.numbers("light", self.light, expected=f"{LIGHT}, or the path of a map")
            check_coefficients("light", light)
            with check.located("light"):
                sh.check_order(sh.order_of("light", light))
            light.setflags(write=False)
            object.__setattr__(self, "light", light)
        check_supersampling(self.supersampling)
        check_bounces(self.bounces)
        glossy = next((body for body in self.bodies if body.is_glossy), None)
        if glossy is not None and self.visibility.method not in (*GLOSSY, None):
            raise ValueError(
                f"roughness: got some for body {glossy.called!r}, which {self.visibility.method!r} does not show, "
                f"expected None, or method = one of {', '.join(map(repr, GLOSSY))}"
            )
        if self.bounces and self.visibility.method not in (*BOUNCING, None):
            finders = ", ".join(map(repr, BOUNCING))
            raise ValueError(
                f"bounces: got {self.bounces}, which {self.visibility.method!r} does not find, expected 0, or "
                f"method = one of {finders}"
            )

    def __repr__(self) -> str:
        light = self.light if isinstance(self.light, EnvironmentMap) else f"{len(self.light)} SH coefficients"
        bounces = f", {self.bounces} bounces" if self.bounces else ""
        bodies = ", ".join(map(repr, self.bodies))
        method = "" if self.visibility.method is None else f", {self.visibility.method!r}"
        return f"Scene([{bodies}], {light}, {self.camera!r}{method}{bounces})"

    def with_method(self) -> Scene:
        """The scene as renderers that are kept have it: "directional" where no method is named."""
        return self if self.visibility.method else replace(self, visibility=self.visibility.with_method())

    def background(self) -> np.ndarray:
        """The light as the camera sees it where no body is, linear RGB, float32 of shape [height, width, 3]."""
        supersampling = self.supersampling
        _, directions = self.camera.resized(supersampling).rays()
        if isinstance(self.light, EnvironmentMap):
            radiance = self.light.towards(directions)
        else:
            harmonics = sh.evaluate(sh.order_of("light", self.light), directions.reshape(-1, 3))
            radiance = np.maximum(harmonics @ self.light, 0).reshape(directions.shape)
        height, width, _ = directions.shape
        samples = radiance.reshape(height // supersampling, supersampling, width // supersampling, supersampling, 3)
        return samples.mean(axis=(1, 3)).astype(np.float32)

    def body_number(self, body: BodyLike, argument: str = "body") -> int:
        """Number of a body, from 0, given that or its name.

        Args:
            body: The number or the name.
            argument: Its name in messages.
        Raises:
            ValueError: for a body that there is not, and for a name that two bodies have from their meshes.
        """
        if not isinstance(body, str):
            by_name = f", or its name, such as {self.bodies[-1].called!r}"
            check.index(argument, body, len(self.bodies), "body", by_name)
            return int(body)
        names = [item.called for item in self.bodies]
        check.choice(argument, body, names)
        if names.count(body) > 1:
            numbers = [number for number, name in enumerate(names) if name == body]
            raise ValueError(
                f"{argument}: got {body!r}, as bodies {numbers} are called, expected a number, or "
                'a name of its own for each: Body(…, name="…")'
            )
        return names.index(body)

    def body_numbers(self, bodies: Iterable[BodyLike], argument: str = "bodies") -> tuple[int, ...]:
        """Numbers of some bodies, given numbers or names."""
        if not isinstance(bodies, Iterable) or isinstance(bodies, str):
            got = check.described(bodies)
            raise ValueError(f"{argument}: got {got}, expected a list of bodies, by numbers or names, such as [0]")
        return tuple(self.body_number(body, argument) for body in bodies)

    @property
    def catchers(self) -> tuple[int, ...]:
        """Numbers of the bodies that model surfaces of the photograph."""
        return tuple(number for number, body in enumerate(self.bodies) if body.shadow_catcher)

    def per_body(self, value: PerBody[Item] | None, argument: str) -> list[Item | None]:
        """One item for each body, None where nothing is given.

        Args:
            value: A list of as many as there are bodies; or a mapping of some of them, by numbers or names.
            argument: Its name in messages.
        Raises:
            ValueError: for a list of another length, and for bodies that there are not, or that come twice.
        """
        count = len(self.bodies)
        if value is None:
            return [None] * count
        if isinstance(value, Mapping):
            items: dict[int, Item | None] = {}
            for body, item in value.items():
                number = self.body_number(body, argument)
                if number in items:
                    raise ValueError(f"{argument}: got {body!r} beside the same body's number, expected one of them")
                items[number] = item
            return [items.get(number) for number in range(count)]
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise ValueError(
                f"{argument}: got {check.described(value)}, expected a list of {count} items, one for each body, None "
                "for what the scene has; or some by their bodies, such as {0: …}"
            )
        if len(value) != count:
            raise ValueError(f"{argument}: got {len(value)} items, expected {count}, one for each body")
        return list(value)
