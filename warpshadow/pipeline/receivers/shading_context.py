"""Context of shading: points that are lit, their surroundings, and the values that are cached for them."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import warp as wp

from warpshadow.pipeline.bodies.blockers import ONLY_SPHERES, BlockerKinds
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Call, Input, Node
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.receiver_footprints import FootprintInputs
from warpshadow.stages.receivers.receivers import Receivers

if TYPE_CHECKING:
    from warpshadow.pipeline.receivers.static import StaticBodies

Cached = TypeVar("Cached")
Context = TypeVar("Context", bound="ShadingContext")


class AdaptiveSurfaces(NamedTuple):
    """Surfaces that the samples of an image see, some of them by adaptive receivers."""

    positions: wp.array  # of all vertices, vec3 of shape [batch, vertex]
    normals: wp.array  # likewise
    fragments: Fragments
    spheres: tuple[wp.array, wp.array]  # centers and radii of all spheres
    is_adaptive: np.ndarray  # flat bodies whose samples interpolate, bool of shape [body]
    supersampling: int  # samples of a pixel across and down
    footprint_inputs: FootprintInputs


class ReceiverCount(NamedTuple):
    """Number of receivers."""

    moving: int  # those on bodies that may move
    static: int
    is_bound: bool = False  # whether there may be fewer that move


class ShadingContext:
    """Receivers, such as a view's, and all that their shading depends on but the light and the method.

    PBRT calls such records contexts.

    Args:
        merged_scene: The bodies among which they are.
        materials: Of the scene's bodies.
        vertices: Positions of all vertices.
        spheres: Centers and radii of the spheres.
        receivers: The points.
        call: Holds values of the points that may not be cached.
        static_bodies: The bodies that stay where they are in this call, while others move; None where any may move.
        normals: Node of the normals of all vertices, vec3 of shape [batch, vertex]; by default its own.
        blocker_kinds: Which bodies block light by something else than their spheres.
        is_scene_view: Whether bodies and points are where the scene and its camera have them, for good.
        nearest_spheres: Where the points are patch samples, the sphere nearest to the patch of each: its index among
            the spheres of bodies that are not flat, −1 for none; NumPy of shape [receiver]. None for other points.
        shares_cache_with: Other points among the same bodies, with which values of these are shared.
        suffix: Put after the names of stages, to tell them from those of other points.
    """

    def __init__(
        self,
        merged_scene: MergedScene,
        materials: Materials,
        vertices: Input,
        spheres: Input,
        receivers: Node,
        call: Call,
        static_bodies: StaticBodies | None = None,
        normals: Node | None = None,
        blocker_kinds: BlockerKinds = ONLY_SPHERES,
        is_scene_view: bool = False,
        nearest_spheres: np.ndarray | None = None,
        shares_cache_with: ShadingContext | None = None,
        suffix: str = "",
    ):
        self.suffix = suffix
        self.blocker_kinds, self.is_scene_view, self.nearest_spheres = blocker_kinds, is_scene_view, nearest_spheres
        self.materials, self.merged_scene = materials, merged_scene
        self.vertices, self.spheres, self.receivers_node = vertices, spheres, receivers
        self.call, self.static_bodies = call, static_bodies
        self.normals = Node("", vertex_normals, vertices, merged_scene.one_rings) if normals is None else normals
        self._cached: dict[str, tuple[Hashable, Any]] = {}
        self._cached_with_neighbors: dict[str, tuple[Hashable, Any]] = {}
        if shares_cache_with is not None:
            self._cached_with_neighbors = shares_cache_with._cached_with_neighbors

    def cached(self, name: str, key: Hashable, make: Callable[[], Cached]) -> Cached:
        """A value for the points, such as a node, cached under a name while its inputs stay the same."""
        return _cached(self._cached, name, key, make)

    def last_cached(self, name: str) -> Any:
        """The value cached under a name, whatever it was made from; None without one."""
        return self._cached.get(name, (None, None))[1]

    def cached_for_bodies(self, name: str, key: Hashable, make: Callable[[], Cached]) -> Cached:
        """A cached value that all points among the same bodies share."""
        return _cached(self._cached_with_neighbors, name, key, make)

    def with_receivers(self: Context, receivers: Node) -> Context:
        """Copy with other receivers, without cached values; any of the blockers may move."""
        points = copy.copy(self)
        points.receivers_node, points.static_bodies, points.is_scene_view = receivers, None, False
        points._cached = {}
        return points

    def preview(self: Context) -> Context:
        """The points with the values cached so far, which does not add its own to them."""
        points = copy.copy(self)
        points._cached_with_neighbors = dict(self._cached_with_neighbors)
        points._cached = {
            name: (key, value.preview() if isinstance(value, ShadingContext) else value)
            for name, (key, value) in self._cached.items()
        }
        return points

    @property
    def weak_reference(self: Context) -> Context:
        """A weak reference to the points, for functions that put a node of theirs into words.

        These must not hold the points, which hold the node: arrays would stay until Python collects garbage.
        """
        return weakref.proxy(self)

    @property
    def receivers(self) -> Receivers:
        """Where light is evaluated."""
        return self.receivers_node.value(self.call)

    def counts(self) -> ReceiverCount:
        """How many receivers may move and how many are static; at most so many where they are not found yet."""
        receivers = self.receivers
        return ReceiverCount(receivers.points.size, len(receivers.static_vertices))


def _cached(values: dict[str, tuple[Hashable, Any]], name: str, key: Hashable, make: Callable[[], Cached]) -> Cached:
    if name not in values or values[name][0] != key:
        values[name] = key, make()
    return values[name][1]  # type: ignore[no-any-return]


def receiver_text(context: ShadingContext, *, moving: bool = True, static: bool = True) -> str:
    """Number of receivers, in words."""
    count = context.counts()
    return f"{'up to ' * count.is_bound}{moving * count.moving + static * count.static:,} receivers"
