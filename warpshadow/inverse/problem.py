"""Problems: a scene, targets, free parameters, and a loss."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.basis import Basis
from warpshadow.assets.camera import Camera
from warpshadow.check import AnyPath
from warpshadow.inverse.free import Light
from warpshadow.inverse.free.base import Free, FreeOfBody, Values
from warpshadow.inverse.loss import Loss
from warpshadow.inverse.target import Target
from warpshadow.inverse.world import FitContext, FittedScene
from warpshadow.scene.blockers import blocking_planes, fit_scene_spheres
from warpshadow.scene.remarks import is_out_of_frame
from warpshadow.scene.scene import Scene, change_bodies, check_scene
from warpshadow.scene.visibility import METHODS, SPHERE_METHODS, Visibility
from warpshadow.tuning.tune import resolved

Kind = TypeVar("Kind", bound=Free)

_SQUARES, _RAYS = Loss(), Visibility("ray-traced")


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Problem:
    """A fit's problem.

    Args:
        scene: Start of the fit: free parameters begin with its values, all else stays as it is.
        targets: The images to explain, of one size; one, or several views. Arrays and files are taken as
            :class:`Target` takes them.
        free: The free parameters.
        loss: The loss.
        still: How visibility is computed where no geometry and no camera moves: rays by default, since then they are
            traced once and an iteration costs the same; None for the scene's own method.
    """

    scene: Scene
    targets: Sequence[Target]
    free: Sequence[Free]
    loss: Loss
    still: Visibility | None

    @check.keywords(parameters="free", visibility="Scene(…, visibility=…), or still=")
    def __init__(
        self,
        scene: Scene,
        targets: Target | np.ndarray | AnyPath | Sequence[Target | np.ndarray | AnyPath],
        free: Free | Sequence[Free],
        loss: Loss = _SQUARES,
        still: Visibility | None = _RAYS,
    ):
        vars(self).update(scene=scene, targets=targets, free=free, loss=loss, still=still)
        check_scene(self.scene)
        check.instance("loss", self.loss, Loss, "a Loss, such as Loss('huber')")
        rays = "a Visibility, such as Visibility('ray-traced'), or None for the scene's"
        check.instance("still", self.still, (Visibility, type(None)), rays)
        for name in ("targets", "free"):
            items = getattr(self, name)
            items = tuple(items) if isinstance(items, Sequence) and not isinstance(items, str) else (items,)
            if not items:
                raise ValueError(f"{name}: got none, expected one or more")
            object.__setattr__(self, name, items)
        object.__setattr__(self, "targets", tuple(self._as_targets()))
        for number, target in enumerate(self.targets):
            check.instance(f"targets[{number}]", target, Target, "a Target, as Target(image) makes it, or an image")
        for number, item in enumerate(self.free):
            check.instance(f"free[{number}]", item, Free, "a free parameter, such as Pose(0) or Light()")
        numbered = list(self._numbered())
        free = sorted((item.beside(numbered) for item in numbered), key=lambda item: item.moves_last)
        object.__setattr__(self, "free", tuple(free))
        self._check_combinations()
        if self.still is not None:
            object.__setattr__(self, "still", self.still.with_method())
            check.choice("still.method", self.still.method, METHODS)
        object.__setattr__(self, "scene", resolved(self.scene))
        if self.moves and self.scene.visibility.method == "ray-traced":
            raise ValueError(
                'scene: got visibility.method = "ray-traced" with free geometry, of which rays have no derivative; '
                'expected "directional", "log-sh" or "none"'
            )
        for number, item in enumerate(self.free):
            with check.located(f"free[{number}]"):
                item.check_scene(self.scene, len(self.targets))
        for number, target in enumerate(self.targets):
            for outlined in target.outlines:
                self.scene.body_number(outlined, f"targets[{number}].outlines")
        cameras = self.cameras()  # raises for an image of other proportions
        if not self.moves and all(is_out_of_frame(body, camera) for body in self.scene.bodies for camera in cameras):
            raise ValueError(
                "targets: got cameras that see no body, expected one that does, since neither bodies nor cameras move"
            )

    def __repr__(self) -> str:
        free = ", ".join(free.name for free in self.free)
        height, width, _ = self.targets[0].image.shape
        return f"Problem({self.scene!r}, {len(self.targets)} targets of {width} × {height}, free: {free})"

    def _check_combinations(self) -> None:
        """Raise ValueError for targets of several shapes, and parameters that exclude each other."""
        shapes = {target.image.shape for target in self.targets}
        if len(shapes) > 1:
            raise ValueError(f"targets: got images of shapes {sorted(shapes)}, expected one shape")
        names = [free.name for free in self.free]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"free: got {twice[0]} twice, expected it once")
        for free in self.free:
            for key, reason in free.excludes.items():
                excluded = free.name.replace(free.key, key, 1)  # of the same body
                if excluded in names:
                    raise ValueError(f"free: got {excluded} and {free.name}, expected one of them: {reason}")

    def _as_targets(self) -> Iterator[Target]:
        for number, item in enumerate(self.targets):
            with check.located(f"targets[{number}]"):
                image: Any = item
                is_image = isinstance(image, (np.ndarray, torch.Tensor)) or check.is_path(image)
                yield Target(image) if is_image else image

    def _numbered(self) -> Iterator[Free]:
        for number, item in enumerate(self.free):
            with check.located(f"free[{number}]"):
                yield item.numbered(self.scene)

    def free_of(self, kind: type[Kind]) -> list[Kind]:
        """The free parameters of a kind."""
        return [item for item in self.free if isinstance(item, kind)]

    @property
    def free_of_bodies(self) -> list[FreeOfBody]:
        """The free parameters of bodies."""
        return [item for item in self.free if isinstance(item, FreeOfBody)]

    @property
    def moves(self) -> bool:
        """Whether geometry or cameras are free."""
        return any(free.moves for free in self.free)

    @property
    def visibility(self) -> Visibility:
        """Visibility settings of the fit."""
        visibility = self.scene.visibility if self.moves or self.still is None else self.still
        min_directions = max(free.min_directions for free in self.free)
        if not min_directions or visibility.method != "directional":
            return visibility
        return replace(visibility, directions=max(self.scene.direction_count, min_directions))

    @property
    def light(self) -> Light | None:
        """The free light; None where it is known."""
        return next(iter(self.free_of(Light)), None)

    @property
    def basis(self) -> Basis | None:
        """Basis of the light of its images: of free light, or of a sun beside the map; None for the scene's own."""
        return next((free.basis for free in self.free if free.basis is not None), None)

    def cameras(self) -> list[Camera]:
        """Camera of each target."""
        height, width, _ = self.targets[0].image.shape
        return [target.camera or _camera_of_size(self.scene.camera, width, height) for target in self.targets]

    def context(self, device: torch.device, *, progress: bool = False) -> FitContext:
        """Fit the spheres and find the units."""
        cameras = self.cameras()
        scene = replace(self.scene, camera=cameras[0], visibility=self.visibility)
        if scene.visibility.method in SPHERE_METHODS:  # another one would leave the found scene without its blockers
            spheres = fit_scene_spheres(scene, device=str(device), progress=progress)
            # bodies that block light as planes do so in the scene that is found, too
            reshaped = {free.number for free in self.free_of_bodies if free.reshapes}
            numbers = set(range(len(spheres))) - (set(blocking_planes(scene)) - reshaped)
            scene = change_bodies(scene, "blockers", {number: spheres[number] for number in numbers})
        color = np.stack([target.image[..., :3] for target in self.targets]).astype(np.float64)
        weights = np.stack([target.weights() for target in self.targets])[..., None]
        unit = float(np.sqrt((weights * color**2).sum() / (3 * weights.sum())))
        return FitContext(scene, cameras, unit or 1.0, device)

    def start(self, context: FitContext) -> dict[str, Values]:
        """The scene's values of the free parameters, by name."""
        return {free.name: free.start(context) for free in self.free}

    def fitted_scene(self, values: dict[str, Values], context: FitContext) -> FittedScene:
        """The scene with values in it, and its own visibility."""
        fitted = FittedScene(
            replace(context.scene, visibility=self.scene.visibility),
            list(context.cameras),
            [1.0] * len(context.cameras),
        )
        with torch.no_grad():
            for free in self.free:
                free.export(values[free.name], context, fitted)
        return fitted

    def fingerprint(self) -> str:
        """A digest of all that the result depends on, in hexadecimal."""
        return _fingerprint(self)

    def fingerprints(self) -> dict[str, str]:
        """Digests of its arguments, by their names, in hexadecimal."""
        return {entry.name: _fingerprint(getattr(self, entry.name)) for entry in dataclasses.fields(self)}


def _camera_of_size(camera: Camera, width: int, height: int) -> Camera:
    """The camera with an image of another size."""
    if (camera.width, camera.height) == (width, height):
        return camera
    if camera.width * height != camera.height * width:
        raise ValueError(
            f"targets: got an image of {width} × {height} pixels, expected the proportions of the scene's camera, "
            f"{camera.width} × {camera.height}, or a camera of its own"
        )
    return camera.stretched(width, height)


def _fingerprint(value: object) -> str:
    digest = hashlib.sha256()
    _digest(value, digest)
    return digest.hexdigest()


def _digest(value: object, digest: hashlib._Hash) -> None:
    """Add numbers, strings, arrays, and sequences and dataclasses of them."""
    if dataclasses.is_dataclass(value):
        digest.update(type(value).__name__.encode())
        for entry in dataclasses.fields(value):
            digest.update(entry.name.encode())
            _digest(getattr(value, entry.name), digest)
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, dict):
        _digest(list(value.items()), digest)
    elif isinstance(value, (tuple, list)):
        digest.update(f"{len(value)} items".encode())
        for item in value:
            _digest(item, digest)
    else:
        digest.update(f"{value!r};".encode())  # or 1, 23 were 12, 3
