"""Arguments: check tensors, and pass them as Warp arrays."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch
from warpshadow.device.constants import IdentityKey
from warpshadow.device.warp_internals import item_shape
from warpshadow.pipeline.bodies.geometry import GEOMETRY_DTYPES, PLACED, Geometry, as_geometry
from warpshadow.pipeline.image_inputs import ImageInputs
from warpshadow.torch.autograd import TensorFunction, as_array, check_float32, is_capturing
from warpshadow.torch.replay import Replays

# tensors about which a renderer caches results while they stay the same
_CACHED_BY_VALUE = ("geometry.", "clip_matrices")


class Slot(NamedTuple):
    """Stands for the tensor of this number until its array is put there."""

    number: int


class Arguments:
    """Tensors that become arrays in the inputs of a function, checked and with a leading batch dimension.

    An input is the slot of a tensor that was added; or :class:`.ImageInputs`, a :class:`.Geometry` or a list that have
    such slots; or any other value, which stays as it is.
    """

    def __init__(self, device: torch.device, *, cameras: Sequence[Camera] | None = None):
        self.device = device
        self._cameras = cameras  # a batch beside the tensors' own
        self._has_batch = cameras is not None  # of results
        self.names: list[str] = []
        self.tensors: list[torch.Tensor] = []
        self.dtypes: list[type] = []

    def add(
        self,
        name: str,
        tensor: torch.Tensor,
        dtype: type,
        shape: tuple[int | str, ...],
        meaning: str = "",
        *,
        message_name: str | None = None,
    ) -> Slot:
        """Add a tensor of items of a Warp dtype, of a shape with or without a batch dimension before it.

        Messages about it call it ``message_name``, by default its name.
        """
        shape = (*shape, *item_shape(dtype))
        _check_tensor(message_name or name, tensor, self.device, shape, meaning)
        has_batch = tensor.ndim > len(shape)
        self._has_batch |= has_batch
        self.names.append(name)
        self.tensors.append(tensor if has_batch else tensor[None])
        self.dtypes.append(dtype)
        return Slot(len(self.names) - 1)

    def expand(self) -> None:
        """Repeat tensors with a batch of 1 for every instance of the others."""
        count = self._common_batch()
        self.tensors = [tensor.expand(count, *tensor.shape[1:]) for tensor in self.tensors]

    def add_geometry(
        self, name: str, geometry: Geometry[torch.Tensor], scene_geometry: Geometry[wp.array]
    ) -> Geometry[Slot]:
        """Add the tensors of a geometry, which has as many items as the scene's own geometry."""
        geometry, scene_arrays = as_geometry(name, geometry), scene_geometry.arrays()
        slots = {
            part: self.add(f"{name}.{part}", tensor, GEOMETRY_DTYPES[part], scene_arrays[part].shape[1:], PLACED)
            for part, tensor in geometry.arrays().items()
        }
        rotations = None
        if geometry.rotations is not None:
            assert scene_geometry.rotations is not None
            rotations = self.add(f"{name}.rotations", geometry.rotations, wp.mat33, scene_geometry.rotations.shape[1:])
        return Geometry(**slots, rotations=rotations, moving=geometry.moving, deformed=geometry.deformed)

    def filled(self, value: Any) -> Any:
        """An input with arrays in the slots, which require a gradient as the tensors do."""
        arrays = []
        for tensor, dtype in zip(self.tensors, self.dtypes, strict=True):
            arrays.append(as_array(tensor, dtype))
            arrays[-1].requires_grad = tensor.requires_grad and torch.is_grad_enabled()
        return _filled(value, arrays)

    def apply(
        self, function: Callable[..., Any], *inputs: Any, affine: Collection[str] = (), replays: Replays | None = None
    ) -> Any:
        """Apply a function of inputs, as :func:`~warpshadow.torch.apply` does, or replay it if there are replays.

        It gets the inputs with arrays in the slots, and returns an array, a tuple of them or a :class:`.Geometry`.
        Results lose a batch dimension that no tensor had.
        """
        self._common_batch()
        find_results = None
        if replays is not None:
            reused = [number for number, name in enumerate(self.names) if name.startswith(_CACHED_BY_VALUE)]
            find_results = functools.partial(replays.results, functools.partial(_key, [*inputs]), reused)
        geometries: list[Geometry[wp.array]] = []

        def call(*arrays: wp.array) -> Any:
            result = function(*(_filled(value, arrays) for value in inputs))
            if not isinstance(result, Geometry):
                return result
            geometries.append(result)
            return result.all_arrays()

        results = TensorFunction(call, self.dtypes, self.device, self.names, affine, find_results)(*self.tensors)
        if not self._has_batch:
            results = tuple(result[0] for result in results)
        if geometries:
            return geometries[0].with_arrays(results)
        return results if len(results) > 1 else results[0]

    def _common_batch(self) -> int:
        return common_batch({"cameras": self._cameras, **dict(zip(self.names, self.tensors, strict=True))})


def _key(value: Any) -> Hashable:
    """Key of an input, which equals the key of others that differ in their tensors alone."""
    if isinstance(value, Slot):
        return value
    if isinstance(value, Geometry):
        return *value.arrays().values(), value.rotations, value.moving, value.deformed
    if isinstance(value, ImageInputs):
        return tuple(map(_key, vars(value).values()))
    return tuple(map(_key, value)) if isinstance(value, list) else IdentityKey(value)


def _filled(value: Any, arrays: Sequence[wp.array]) -> Any:
    """An input with arrays in its slots."""
    if isinstance(value, Slot):
        return arrays[value.number]
    if isinstance(value, Geometry):
        return value.map(lambda slot: arrays[slot.number])
    if isinstance(value, ImageInputs):
        parts = {name: _filled(item, arrays) for name, item in vars(value).items() if item is not None}
        return dataclasses.replace(value, **parts)
    return [_filled(item, arrays) for item in value] if isinstance(value, list) else value


def _check_tensor(
    name: str, tensor: torch.Tensor, device: torch.device, shape: tuple[int | str, ...], meaning: str
) -> None:
    """Raise ValueError unless a tensor is of float32, finite, on the device, and of the shape or a batch of it."""
    check_float32(name, tensor)
    if tensor.device != device:
        raise ValueError(f"{name}: got device {tensor.device}, expected {device}: .to({str(device)!r}) moves it")
    check.shape(name, tuple(tensor.shape), ("batch", *shape) if tensor.ndim > len(shape) else shape, meaning)
    if tensor.numel() == 0 and 0 not in shape:
        raise ValueError(f"{name}: got shape {tuple(tensor.shape)}, expected at least one value")
    if device.type == "cuda" and not is_capturing(device):
        finite_arrays({name: as_array(tensor.detach() if tensor.ndim else tensor.detach()[None], wp.float32)})
    elif not np.isfinite(float(tensor.detach().sum())):
        check.finite(name, tensor.detach().numpy())
