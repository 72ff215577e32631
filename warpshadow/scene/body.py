"""Bodies: meshes with reflectance and blockers, placed in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.color import GRAY, srgb_to_linear
from warpshadow.assets.image import ImageError, read_rgb
from warpshadow.assets.mesh import Mesh, MeshError
from warpshadow.assets.mesh_files import Material, MeshSource, is_of_trimesh, load_material, load_shape
from warpshadow.assets.topology import CREASE
from warpshadow.check import AnyPath
from warpshadow.scene.material import GLOSS_ARGUMENTS, MATERIAL_FIELDS
from warpshadow.scene.rotation import rotation_matrix, rotation_vector
from warpshadow.scene.visibility import AUTO, SELF_SHADOWS, Visibility
from warpshadow.spheres import Spheres

RECEIVERS = (AUTO, "vertex", "pixel", "adaptive")

ARRAY_SUFFIX = ".npy"  # suffix of files with a color or a number for each vertex; other text is no albedo

_SPHERES_SUFFIX = ".npz"


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Body:
    """A mesh with its reflectance, placed in the world: scale first, then rotation, then translation.

    A point p of the mesh is at R(s p) + t. The world is right-handed with y up; a rotation turns about the origin of
    the mesh, counter-clockwise seen from the tip of its axis. Surfaces are diffuse, or shine (``roughness``). Colors
    are linear RGB: ``srgb_to_linear`` converts the colors that color pickers show. A path, relative to the current
    folder, stands for its file.

    Args:
        mesh: The mesh, or any source that :func:`warpshadow.load_mesh` reads: a file, or a mesh or a scene of trimesh.
        albedo: Reflectance, linear RGB, for the body [3] or for each vertex [vertex, 3], or an .npy file of it. By
            default the file's texture, if all its faces share one, or else the colors of the mesh, or gray, 0.8.
        texture: Reflectance as an image in place of ``albedo``, which then does not count, linear RGB of shape
            [height, width, 3], or a file that :func:`warpshadow.read_image` reads; needs uvs.
        blockers: Number of spheres to fit to the mesh, or "auto" for as many as it needs, 8 to 1024
            (:func:`warpshadow.fit_spheres`), or the spheres themselves, or an .npz file of them; 0, or no spheres,
            casts no shadow, by any method. Flat bodies, and with "auto" convex pieces and cloth, may block by their own
            shape instead ("Blockers" in scene/README.md). Bounced light passes a body without blockers, too; "Bounces"
            in pipeline/README.md says onto which bodies it reflects.
        rotation: Axis-angle vector [degrees], shape [3]: (0, 90, 0) is a quarter turn about +y, through the origin of
            the mesh's space, wherever its vertices are. (:meth:`on_ground` stands a body on a point;
            :meth:`Renderer.placed` can turn it about its middle.) A matrix, shape [3, 3], becomes such a vector.
        translation: Offset [scene units], shape [3].
        scale: Factor, positive.
        receivers: Where light is evaluated: at every "vertex"; at every "pixel" that shows the body, which a mesh of
            few faces needs to receive a shadow; or "adaptive", on a flat body at some pixels, close to each other where
            shadows have edges (by pixel on other bodies, and on a GPU). "auto" leaves it to each renderer, which
            chooses by the table of pipeline/receivers/README.md.
        self_shadows: How it casts shadows on itself, as for :class:`Visibility`; None for the scene's setting.
        name: Its name for lookups, by default that of its mesh, so of the mesh's file: ``scene.bodies["cow"]``.
        shadow_catcher: Whether it models a surface in the photograph: :func:`warpshadow.insert` does not draw it, and
            has it darken the photograph, or with bounces tint it, by the ratio of the light that it receives with the
            other bodies to the light without them. In the image of :func:`warpshadow.render` its shadow is coverage
            alone. ``draw``, torch's renderer, fits and the viewer show it as any other body.
        roughness: glTF's, in [0, 1], one number, one for each vertex [vertex], or a texture [height, width], which
            needs uvs, or an .npy file of them: the surface shines by a GGX lobe of width α = roughness², shown as 0.1
            below 0.1. None, the default, is the roughness of the mesh's file, if that is glTF and neither ``albedo``
            nor ``texture`` is given, and else a diffuse surface. Such a body has receivers at pixels; all methods but
            "log-sh" show it. With ``bounces=0`` other bodies are black in it, so metals want bounces.
        metallic: Likewise, how much of it is metal, which reflects its albedo and has no diffuse light; by default 0.
        specular: Likewise, strength of the reflection of all but metal, of which 1, the default, is 4% straight on.
        emission: Radiance that its surface emits, linear RGB, 0 or more, for the body [3] or for each vertex
            [vertex, 3], or a texture [height, width, 3], which needs uvs, or an .npy file of it: a lamp, which lights
            other bodies, and itself if it is not convex. None, the default, is no emission, or that of the mesh's file,
            if that is glTF and neither ``albedo`` nor ``texture`` is given. Open bodies emit to both sides. All methods
            but "log-sh" have it.
        beam: Of a body that emits, a cone in which alone it does, as a spot light: an inner and an outer angle from its
            axis [degrees], 0 ≤ inner ≤ outer ≤ 180, between which radiance falls smoothly to 0; equal ones have a sharp
            edge, without a gradient. The axis turns with the body: the mean of its normals, such as that of a disc, or,
            of a body that faces all ways, such as a ball, −z in its own space, as in glTF. None is all directions.
    """

    mesh: Mesh
    albedo: np.ndarray
    texture: np.ndarray | None = field(repr=False)
    blockers: int | str | Spheres
    rotation: np.ndarray
    translation: np.ndarray
    scale: float
    receivers: str
    name: str
    self_shadows: str | None
    shadow_catcher: bool
    roughness: np.ndarray | None
    metallic: np.ndarray | None
    specular: np.ndarray | None
    emission: np.ndarray | None
    beam: tuple[float, float] | None

    @check.keywords(spheres="blockers", size="Body(…).on_ground(size=…)")
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
        emission: npt.ArrayLike | AnyPath | None = None,
        beam: npt.ArrayLike | None = None,
    ):
        vars(self).update(mesh=mesh, albedo=albedo, texture=texture, blockers=blockers)
        vars(self).update(rotation=rotation, translation=translation, scale=scale, receivers=receivers, name=name)
        vars(self).update(self_shadows=self_shadows, shadow_catcher=check.flag("shadow_catcher", shadow_catcher))
        vars(self).update(roughness=roughness, metallic=metallic, specular=specular, emission=emission)
        vars(self).update(beam=beam)
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
        if self.emission is not None:
            object.__setattr__(self, "emission", self._checked_emission(self.emission))
        if self.beam is not None:
            object.__setattr__(self, "beam", self._checked_beam(self.beam))
        if self.self_shadows is not None:
            check.choice("self_shadows", self.self_shadows, SELF_SHADOWS)
        if self.name is not None and not (isinstance(self.name, str) and self.name):
            raise ValueError(f"name: got {check.described(self.name)}, expected a name, or None for the mesh's")
        object.__setattr__(self, "name", self.name or self.mesh.name)

    def __repr__(self) -> str:
        count = len(self.blockers) if isinstance(self.blockers, Spheres) else self.blockers
        texture = "" if self.texture is None else f", texture {self.texture.shape[1]} × {self.texture.shape[0]}"
        mesh = f"{self.mesh.vertex_count} vertices, {self.mesh.face_count} faces"
        return f"Body({self.name!r}, {mesh}, {count} spheres{texture})"

    @property
    def has_own_name(self) -> bool:
        """Whether its name is another than its mesh's."""
        return self.name != self.mesh.name

    @property
    def casts_shadow(self) -> bool:
        """Whether the body blocks light."""
        return bool(len(self.blockers) if isinstance(self.blockers, Spheres) else self.blockers)

    def self_shadows_in(self, visibility: Visibility) -> str:
        """How it casts shadows on itself: by its own setting, or else by a scene's."""
        return self.self_shadows or visibility.self_shadows

    @property
    def is_thin(self) -> bool:
        """Whether its spheres bulge out of its mesh between vertices: of sheets, and bodies of several convex parts.

        Not of flat bodies for which one sphere stands in.
        """
        if self.mesh.is_flat:
            return isinstance(self.blockers, Spheres)
        return not self.mesh.surface.is_closed or len(self.mesh.convex_parts) > 1

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
        if all(getattr(self, name) is None for name in GLOSS_ARGUMENTS) and not is_diffuse:
            vars(self).update({item.name: getattr(material, item.name) for item in MATERIAL_FIELDS if item.is_in_files})
        if self.emission is None and not self.shadow_catcher:
            vars(self).update(emission=material.emission)

    def _read_files(self) -> None:
        """Replace paths by the content of their files."""
        readers: tuple[tuple[str, Callable[[Path], Any], str, type[ValueError]], ...] = (
            ("texture", read_rgb, "", ImageError),
            ("albedo", _read_colors, ARRAY_SUFFIX, ValueError),
            ("emission", _read_colors, ARRAY_SUFFIX, ValueError),
            ("blockers", Spheres.read, _SPHERES_SUFFIX, ValueError),
            *((name, partial(_read_colors, shape="[vertex]"), ARRAY_SUFFIX, ValueError) for name in GLOSS_ARGUMENTS),
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
            raise ValueError(f"albedo: got {self.albedo!r}, expected {expected}{_css_color_hint(self.albedo)}")
        albedo = _checked_colors("albedo", self.albedo, expected)
        if albedo.shape not in ((3,), (count, 3)):
            raise ValueError(f"albedo: got shape {albedo.shape}, expected [3] or [{count}, 3] (one for each vertex)")
        check.reflectance("albedo", albedo)
        albedo.setflags(write=False)
        if getattr(self.albedo, "dtype", None) == np.uint8:  # as it is, all but black
            check.pixels("albedo", self.albedo, expected=expected)
        return albedo

    def _checked_emission(self, radiance: npt.ArrayLike) -> np.ndarray:
        count = self.mesh.vertex_count
        expected = "a linear color of 0 or more such as (5, 4, 3), one for each vertex, [vertex, 3], or an .npy file"
        emission = _checked_colors("emission", radiance, expected)
        dtype = np.asarray(radiance).dtype
        if dtype.kind == "u" or (dtype.kind == "i" and emission.ndim == 3):
            raise ValueError(
                f"emission: got codes of a picture ({dtype}), expected linear radiance: of 8 bits "
                "warpshadow.srgb_to_linear(image / 255), times the radiance of white"
            )
        if emission.ndim == 3:
            self._check_uvs("emission", "colors of vertices, [vertex, 3]")
        if not emission.size or emission.shape not in ((3,), (count, 3), (*emission.shape[:2], 3)):
            raise ValueError(
                f"emission: got shape {emission.shape}, expected [3], [{count}, 3] (one for each vertex), or a texture "
                "[height, width, 3]"
            )
        check.finite("emission", emission, minimum=0)
        if self.shadow_catcher:
            raise ValueError("emission: got some for a shadow catcher, expected None: it is not drawn")
        emission.setflags(write=False)
        return emission

    def _checked_beam(self, angles: npt.ArrayLike) -> tuple[float, float]:
        expected = "inner and outer angles [degrees] from the axis, 0 <= inner <= outer <= 180, such as (20, 30)"
        inner, outer = check.array("beam", angles, (2,), expected).tolist()
        if not 0 <= inner <= outer <= 180 or outer == 0:
            raise ValueError(f"beam: got {(inner, outer)}, expected {expected}")
        if self.emission is None:
            raise ValueError("beam: got one without emission, expected emission, too")
        return inner, outer

    def _check_uvs(self, name: str, alternative: str) -> None:
        if self.mesh.uvs is None:
            raise ValueError(
                f"{name}: got an image, but mesh {self.mesh.name!r} has no uvs; expected {alternative}, or uvs, as "
                "warpshadow.unwrap makes them"
            )

    def _checked_texture(self, image: np.ndarray) -> np.ndarray:
        self._check_uvs("texture", "none")
        texture = check.pixels("texture", image, expected="linear RGB [height, width, 3], or the path of a picture")
        check.shape("texture", texture.shape, ("height", "width", 3), check.channels_last(texture.shape))
        if texture.size == 0:
            raise ValueError(f"texture: got shape {texture.shape}, expected at least one texel")
        check.reflectance("texture", texture)
        texture.setflags(write=False)
        return texture

    def _check_gloss(self) -> None:
        """Convert roughness and the like to float32: [1], [vertex] or [height, width]."""
        count = self.mesh.vertex_count
        for name, _, minimum, maximum, _ in MATERIAL_FIELDS:
            value = getattr(self, name)
            if value is None:
                continue
            if self.roughness is None:
                raise ValueError(
                    f"{name}: got {check.described(value)} without roughness, expected roughness, too, such as 0.3"
                )
            number = f"a number from {minimum:g} to {maximum:g}"
            expected = f"{number}, one for each of the {count} vertices, or a texture [height, width]"
            numbers = np.atleast_1d(check.numbers(name, value, expected=expected))
            if numbers.ndim == 2 and numbers.size:
                self._check_uvs(name, "numbers of vertices, [vertex]")
            if not numbers.size or (numbers.ndim != 2 and numbers.shape not in ((1,), (count,))):
                raise ValueError(f"{name}: got shape {numbers.shape}, expected {expected}")
            check.finite(name, numbers, minimum=minimum, maximum=maximum)
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
    def is_emitter(self) -> bool:
        """Whether it emits light."""
        return self.emission is not None

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
        values: dict[str, Any] = {name: getattr(self, name) for name in GLOSS_ARGUMENTS}
        of_vertices = {
            name: array[mesh.origins]
            for name, array in values.items()
            if np.shape(array) == self.mesh.positions.shape[:1]
        }
        for name in ("albedo", "emission"):
            if np.ndim(getattr(self, name)) == 2:
                of_vertices[name] = getattr(self, name)[mesh.origins]
        return replace(self, mesh=mesh, **of_vertices)

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
        if size is None:
            scale = self.scale
        elif extent := (high - low).max():
            scale = check.positive("size", size) / extent
        else:
            raise ValueError(
                f"size: got {size:g} for a mesh ({self.name!r}) whose vertices coincide, expected one that has a size"
            )
        points = self.mesh.world_points().astype(np.float64) @ self.rotation_matrix().T
        bottom = self.rotation_matrix() @ (low + high) / 2
        bottom[1] = points[:, 1].min()
        return replace(self, scale=float(scale), translation=foot - scale * bottom)

    def world_points(self) -> np.ndarray:
        """The vertices that faces refer to, where they are in the world [scene units], float64 of shape [point, 3]."""
        return self.to_world(self.mesh.world_points().astype(np.float64))

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Take points of the body's own space to the world, float64 of shape [..., 3]."""
        return self.scale * points @ self.rotation_matrix().T + self.translation

    def from_world(self, points: np.ndarray) -> np.ndarray:
        """Take points of the world to the body's own space, float64 of shape [..., 3]."""
        return (points - self.translation) @ self.rotation_matrix() / self.scale

    def world_mesh(self) -> Mesh:
        """The mesh in world space."""
        return self.mesh.transformed(
            rotation=self.rotation_matrix(), translation=np.array(self.translation), scale=self.scale
        )


def _colors(mesh: Mesh | MeshSource) -> npt.ArrayLike:
    """The colors of a mesh, one where all are the same, or gray."""
    colors = mesh.colors if isinstance(mesh, Mesh) else None
    if colors is None:
        return GRAY
    return colors if np.ptp(colors, axis=0).any() else colors[0]


def _checked_colors(name: str, colors: npt.ArrayLike, expected: str) -> np.ndarray:
    """Colors as an array; ValueError, which has the color, for a number that stands for a gray."""
    result = check.numbers(name, colors, expected=expected)
    if result.ndim == 0:
        raise ValueError(f"{name}: got {result:g}, expected {expected}; that gray is {(result.item(),) * 3}")
    return result


def _read_colors(path: Path, shape: str = "[vertex, 3]") -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"got {path} ({error}), expected an .npy file of {shape}") from error


def _css_color_hint(color: str) -> str:
    """The linear RGB of a color of CSS, for messages; nothing for other text."""
    from PIL import ImageColor

    try:
        linear = srgb_to_linear(np.array(ImageColor.getrgb(color)[:3]) / 255)
    except ValueError:
        return ""
    return f": that color is ({', '.join(f'{value:.4g}' for value in linear)})"


def into_own_space(body: Body) -> dict[str, Any]:
    """Arguments of ``transformed`` that take meshes or spheres from the world into the space of a body."""
    inverse = body.rotation_matrix().T
    return {"rotation": inverse, "translation": -inverse @ body.translation / body.scale, "scale": 1 / body.scale}
