"""The interface of methods of visibility: how light is blocked."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, HarmonicBasis, conversion
from warpshadow.assets.known_light import as_light
from warpshadow.pipeline.bodies.blockers import ONLY_SPHERES, BlockerKinds
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Input, Node
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces, ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.transfers import LightArgument, check_light, shade_free
from warpshadow.stages.receivers.quadtree import Quadtree
from warpshadow.stages.shell.shell_rays import check_shell, shell_array

if TYPE_CHECKING:  # they are imported where a body emits, or shines
    from warpshadow.pipeline.shading.emitters import SceneEmitters
    from warpshadow.pipeline.shading.lobe_light import LobeVisibility
    from warpshadow.pipeline.shading.mirrored_bodies import MirroredBodies


class Method(abc.ABC):
    """How light is blocked: a method of visibility.

    A method gives these members; a name that ends with ``_node`` makes a node. A method by spheres derives from
    :class:`.SphereMethod`, which gives all but :attr:`lobes` and :meth:`path_shading_node`; its own members are in the
    table of :class:`.VisibilitySteps`.

    | member | needed for | default |
    | --- | --- | --- |
    | :meth:`known_shading_node` | known light | – |
    | :meth:`transfer_node` | free light | – |
    | :meth:`emitted_light_node` | lamps | – |
    | :meth:`highlights_node` | lamps, on bodies that shine | – |
    | :attr:`lobes` | bodies that shine | no shadows in mirrored light |
    | :meth:`openness_node` | light that bounces between static patches | None: rays find it, as form factors |
    | :meth:`path_shading_node` | light that bounces along paths (:func:`.choose_bounce_solver`) | refused |
    | :meth:`blocker_kinds` | planes, convex parts, traced self-visibility | spheres alone |
    | :meth:`find_squares` | adaptive receivers | None, where every sample receives light |
    | the three fields below | as they say | False |

    A scene is refused whose bodies shine or emit, or whose light is near or bounces, where the method's row of
    ``METHOD_TRAITS`` (:mod:`warpshadow.scene.visibility`) says no: the method then needs no member for that.

    Args:
        merged_scene: The bodies.
        native_basis: Basis in which the method computes light.
        basis: Basis of free light; None for the method's own.
    """

    edges_as_wide_as_footprints = False  # edges of a sun's shadow on flat bodies are as wide as receivers' footprints

    shares_directions = False
    """Whether all receivers look for light in the same directions, so that one is enough for a surface in a pixel."""

    shares_lobes = False
    """Whether samples of a pixel on one face of a body that shines share a receiver. Else each is one, with its part of
    the lobe's samples, so that the image is continuous in poses."""

    def __init__(self, merged_scene: MergedScene, native_basis: Basis, basis: Basis | None, *, progress: bool = False):
        self.merged_scene, self.native_basis, self.progress = merged_scene, native_basis, progress
        self.basis = native_basis if basis is None else basis
        self.visibility = merged_scene.scene.visibility
        self.light = LightInput(merged_scene.scene.known_light)
        shell = merged_scene.scene.shell
        self.shell = None if shell is None else shell_array(shell, merged_scene.device)

    def blocker_kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default.

        Args:
            rotations: Of its bodies; None where nobody knows on which body a receiver is.
        """
        return ONLY_SPHERES

    def blocker_notes(self, blocker_kinds: BlockerKinds) -> list[str]:
        """Describe how each body blocks light, and why, a line each; nothing where all do by rays, or none does."""
        return []

    def find_squares(self, blocker_kinds: BlockerKinds, surfaces: AdaptiveSurfaces) -> Quadtree | None:
        """Find the squares in which samples of adaptive bodies interpolate (:func:`.adaptive.find_squares`)."""
        return None

    @functools.cached_property
    def emitters(self) -> SceneEmitters:
        """The bodies that emit."""
        from warpshadow.pipeline.shading.emitters import SceneEmitters

        return SceneEmitters(self.merged_scene)

    @functools.cached_property
    def mirrored_bodies(self) -> MirroredBodies:
        """The metals that lobes meet."""
        from warpshadow.pipeline.shading.mirrored_bodies import MirroredBodies

        return MirroredBodies(self.merged_scene)

    def cached_emitted_light_node(self, context: ShadingContext, materials: Materials) -> Node:
        """Direct light of emitters on points, vec3 of shape [batch, receiver], cached for the last emission."""
        return context.cached("emitted", materials.emission, lambda: self.emitted_light_node(context, materials))

    @abc.abstractmethod
    def emitted_light_node(self, context: ShadingContext, materials: Materials) -> Node:
        """Direct light of emitters on points, past the blockers between, vec3 of shape [batch, receiver]."""

    @abc.abstractmethod
    def highlights_node(self, context: ShadingContext, materials: Materials, roughness: Node, cameras: Input) -> Node:
        """Direct light of emitters in the lobes of points, past the blockers between: G and G', vec3 [batch, receiver].

        Args:
            context: Receivers on bodies that shine.
            materials: Of the bodies.
            roughness: Of the points, float32 of shape [batch, receiver].
            cameras: Clip matrices.
        """

    def light_input(
        self, context: ShadingContext, light: LightArgument | None, shell: wp.array | None = None
    ) -> LightInput:
        """The light of an image, or of other points, as an input, checked; the same for the same known light and shell.

        Args:
            context: The receivers of the image.
            light: None for the scene's.
            shell: Center and radius of the sphere that sends it [scene units], vec4 of shape [batch]; None for that of
                the light itself.
        """
        check_light(light)
        is_of_scene = light is None or light is self.merged_scene.scene.light
        if is_of_scene and shell is None:
            return self.light
        if isinstance(light, wp.array):
            return LightInput(light, self._shell_input(context, shell), why_new="light is given")
        known = self.light.value() if light is None else as_light(light)
        if shell is None and known.shell is not None:  # it is not that of the scene
            shell = shell_array(known.shell, self.merged_scene.device)
        shell_input = self._shell_input(context, shell)
        why_new = "" if context.last_cached("light") is None else "light changed since the last call"
        return context.cached("light", (known, shell_input), lambda: LightInput(known, shell_input, why_new=why_new))

    def _shell_input(self, context: ShadingContext, shell: wp.array | None) -> Input | None:
        """The shell of light that is not the scene's, the same while its values are; None for the scene's."""
        if shell is None:
            return None
        if self.shell is None:
            raise ValueError(
                "light: got some with a radius for a scene whose light is infinitely far away, expected none; the "
                "scene's light has to have one: EnvironmentMap(…, radius=…)"
            )
        check_shell(shell)
        renewed = Input.renewed("shell", shell, context.last_cached("shell"))
        return context.cached("shell", renewed, lambda: renewed)

    def shell_of(self, light: LightInput) -> Input | wp.array | None:
        """Center and radius of the sphere that sends light, vec4 of shape [batch]; None for light infinitely far."""
        return self.shell if light.shell is None else light.shell

    def cached_transfer_node(self, context: ShadingContext, shell: Input | None = None) -> Node:
        """Transfer vectors of points to :attr:`basis`, an array [batch, receiver, coefficient] for each portion.

        Args:
            shell: Of the light; None for that of the scene's.
        """
        return context.cached("transfers", shell, lambda: self.transfer_node(context, shell))

    def cached_for_light(self, name: str, context: ShadingContext, light: LightInput, make: Callable[[], Node]) -> Node:
        """A node of points in known light, cached for the scene's light and for the last other one."""
        name = f"{name} of the scene" if light is self.light else name
        return context.cached(name, light, make)

    def direct_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct light that points reflect as white surfaces, without light of emitters, vec3 [batch, receiver].

        Known light is shaded at once; free light meets transfer vectors, which are cached.
        """
        if light.is_free:
            return self._free_shading_node(context, light)
        return self.cached_for_light("direct", context, light, lambda: self.known_shading_node(context, light))

    @abc.abstractmethod
    def known_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct known light on points."""

    def _free_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct free light on points, which is converted where the transfer vectors are not."""
        transfers = self.cached_transfer_node(context, light.shell)
        matrix = self.native_from_basis if transfers.requires_grad else None
        items = functools.partial(receiver_text, context.weak_reference)
        name, shade = f"shading{context.suffix}", functools.partial(shade_free, matrix=matrix)
        return Node(name, shade, transfers, light, items=items)

    @functools.cached_property
    def native_from_basis(self) -> np.ndarray | None:
        """Matrix from free light to the method's native basis; None if they are the same, or bands of it."""
        basis, native = self.basis, self.native_basis
        if isinstance(native, HarmonicBasis) and isinstance(basis, HarmonicBasis) and basis.order <= native.order:
            return None
        return conversion(basis, native)

    @abc.abstractmethod
    def transfer_node(self, context: ShadingContext, shell: Input | None) -> Node:
        """Transfer vectors of points to :attr:`basis`, an array for each portion, for light from a shell."""

    @functools.cached_property
    def lobes(self) -> LobeVisibility:
        """How light in the lobes of bodies that shine is blocked."""
        from warpshadow.pipeline.shading.lobe_light import LobeVisibility

        return LobeVisibility(self.merged_scene, self.light, shares_receivers=self.shares_lobes)

    def path_shading_node(self, direct: Node, context: ShadingContext, light: LightInput, materials: Materials) -> Node:
        """Shading of points in known light that bounces along paths, added to direct light."""
        raise NotImplementedError

    def openness_node(self, context: ShadingContext) -> Node | None:
        """Light that points reflect as white surfaces under an even sky of 1; None where rays find it on average."""
        return None
