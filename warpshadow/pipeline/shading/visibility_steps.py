"""Steps of methods with sphere blockers: the functions of a method that compute."""

import abc
import functools
from collections.abc import Mapping
from typing import Generic, Protocol, TypeVar

import warp as wp

from warpshadow.assets.known_light import KnownLight
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.self_visibility import SelfLookup
from warpshadow.pipeline.node import Input
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces
from warpshadow.pipeline.receivers.static import StaticBodies, VertexRows
from warpshadow.pipeline.shading.found_visibility import CellVisibility, HarmonicVisibility
from warpshadow.pipeline.shading.method import Method
from warpshadow.pipeline.shading.scene_blockers import SceneBlockers
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT
from warpshadow.stages.light.shading import shade
from warpshadow.stages.receivers.quadtree import Quadtree

Projected = TypeVar("Projected", bound="ProjectedLight")
FoundVisibility = TypeVar("FoundVisibility", CellVisibility, HarmonicVisibility)


class ProjectedLight(Protocol):
    """Light in the basis in which a method finds visibility: cells of directions, or bands of spherical harmonics.

    Without coefficients it is the basis alone, by which visibility is found for any free light.
    """

    @property
    def coefficients(self) -> wp.array | None:
        """Of known or given light, vec3 of shape [batch, coefficient]; of light from a shell, its patches'."""

    def with_coefficients(self: Projected, coefficients: wp.array) -> Projected:
        """Light of the same basis."""


class VisibilitySteps(Method, Generic[Projected, FoundVisibility]):
    """How a method with sphere blockers finds visibility, and shades by it: functions that compute, and make no nodes.

    Its two types are those of light and of visibility in its basis. A method gives these members, besides those of
    :class:`.Method` for bodies that shine:

    | member | needed for | default |
    | --- | --- | --- |
    | :attr:`free_basis` | free light | – |
    | :meth:`project_light` | known light | – |
    | :meth:`find_visibility`, :meth:`find_transfer` | any light | – |
    | :meth:`coefficient_count` | ``explain`` | – |
    | :meth:`self_lookups` | self-visibility by rays | – |
    | :meth:`cached_rows` | static bodies among moving ones | – |
    | :meth:`shade_transfer` | known light | a sum over the coefficients |
    | :meth:`shade_transmittance` | known light, where it is faster than transfer vectors | transfer vectors |
    | :meth:`find_visibility_past_planes` | planes, if :attr:`scene_blockers` has any | refused |
    | :meth:`free_basis_of_shell` | light from a shell that a call gives | refused |
    | :attr:`scene_blockers` | planes and convex parts | spheres, and self-visibility by rays |
    | :attr:`emitter_cells` | lamps, past the self-visibility of receivers | None: without it |
    | :meth:`share_of_sharpest_light` | adaptive receivers | None, as where nothing blocks |

    :class:`VisibilityNode` calls find_visibility, then find_visibility_past_planes; :class:`TransferNode`
    goes on with find_transfer, and :class:`ShadingNode` with that and shade_transfer, or with shade_transmittance.

    Attributes:
        free_basis: The basis in which the method projects any free light, of the scene's shell if it has one.
        why_no_shadows: Why the method has no shadows, in words; empty if it has.
        adds_cached_rows: Whether visibility combines cached rows with moving blockers.
        shades_without_transfer: Whether known light is summed from transmittance directly, :meth:`shade_transmittance`.
            No transfer vectors are then stored, but for cached rows and light from a shell.
    """

    free_basis: Projected
    why_no_shadows = ""
    adds_cached_rows = False
    shades_without_transfer = False

    @property
    def emitter_cells(self) -> Projected | None:
        """Even light in the cells in which self-visibility towards emitters is looked up; None where nothing is."""
        return None

    @functools.cached_property
    def scene_blockers(self) -> SceneBlockers:
        """The blockers that the bodies are."""
        return SceneBlockers(self.merged_scene, progress=self.progress)

    def blocker_kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default."""
        return self.scene_blockers.kinds(geometry, rotations)

    def blocker_notes(self, blocker_kinds: BlockerKinds) -> list[str]:
        """Describe how each body blocks light, and why, a line each."""
        return [] if self.why_no_shadows else self.scene_blockers.notes(blocker_kinds)

    def find_visibility_past_planes(
        self, group: Group, visibility: FoundVisibility, projected_light: Projected
    ) -> FoundVisibility:
        """Visibility of a group past the flat bodies around it, given its visibility past all other blockers."""
        raise NotImplementedError

    @abc.abstractmethod
    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> Projected:
        """Project known light for the method: its coefficients, and the cells or bands they belong to.

        Args:
            light: The light.
            shell: Center and radius of the sphere that sends it, vec4 of shape [batch]; None for light infinitely far.
        Differentiable: shell.
        """

    def free_basis_of_shell(self, shell: wp.array) -> Projected:
        """The basis in which the method projects free light of another shell than the scene's."""
        raise NotImplementedError

    @abc.abstractmethod
    def coefficient_count(self, light: Input | None) -> int:
        """Number of light coefficients that shading uses; all of them where the light is None, not known yet."""

    @abc.abstractmethod
    def self_lookups(
        self, bodies: tuple[int, ...], rotations: wp.array, projected_light: Projected
    ) -> Mapping[int, SelfLookup]:
        """Self-visibility of receivers of some bodies, by body. Differentiable: rotations."""

    @abc.abstractmethod
    def find_visibility(self, group: Group, projected_light: Projected) -> FoundVisibility:
        """Visibility, or transmittance, past a group's spheres, convex parts and its own body."""

    @abc.abstractmethod
    def find_transfer(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Transfer vectors of a group."""

    def shade_transfer(self, transfer: wp.array, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light, given its transfer vectors."""
        return shade(transfer, projected_light.coefficients, maximum=LARGEST_COEFFICIENT)

    def shade_transmittance(self, visibility: FoundVisibility, group: Group, projected_light: Projected) -> wp.array:
        """Shading of a group in known light, given its visibility."""
        transfer = self.find_transfer(visibility, group, projected_light)
        return self.shade_transfer(transfer, group, projected_light)

    def find_squares(self, blocker_kinds: BlockerKinds, surfaces: AdaptiveSurfaces) -> Quadtree:
        """Find the squares in which samples of adaptive bodies interpolate."""
        from warpshadow.pipeline.receivers.adaptive import find_squares

        place = functools.partial(self.scene_blockers.place_blockers, blocker_kinds)
        return find_squares(place, self.share_of_sharpest_light, surfaces)

    def share_of_sharpest_light(self, group: Group) -> wp.array | None:
        """Share of a group's unblocked light that comes from the cells with the sharpest shadows.

        Returns:
            Shape [batch, receiver], the brightest cells in place of sharp ones if none is; None where nothing blocks.
        """
        return None

    @abc.abstractmethod
    def cached_rows(self, static_bodies: StaticBodies, light: Input | None, blocker_kinds: BlockerKinds) -> VertexRows:
        """Rows of transmittance past static bodies, for known light or for any."""
