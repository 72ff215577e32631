"""Arguments: check tensors, and pass them as Warp arrays."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.device.batch import common_batch
from warpshadow.device.warp_internals import item_shape
from warpshadow.pipeline.geometry import GEOMETRY_DTYPES, PLACED, Geometry, as_geometry
from warpshadow.torch.autograd import apply, as_array, check_float32, is_capturing


class Arguments:
    """Tensors that become arguments of a function of Warp arrays, checked and with a leading batch dimension."""

    def __init__(self, device: torch.device, *, cameras: Sequence[Camera] | None = None):
        self.device = device
        self._cameras = cameras  # a batch beside the tensors' own
        self._has_batch = cameras is not None  # of results
        self.names: list[str] = []
        self.tensors: list[torch.Tensor] = []
        self.dtypes: list[type] = []
        self._bodies: dict[str, dict[str, Any]] = {}  # of geometries: the moving ones and the deformed ones

    def add(
        self,
        name: str,
        tensor: torch.Tensor,
        dtype: type,
        shape: tuple[int | str, ...],
        meaning: str = "",
        *,
        messages: str | None = None,
    ) -> None:
        """Add a tensor of items of a Warp dtype, of a shape with or without a batch dimension before it.

        Messages about it call it ``messages``, by default its name.
        """
        shape = (*shape, *item_shape(dtype))
        _check_tensor(messages or name, tensor, self.device, shape, meaning)
        has_batch = tensor.ndim > len(shape)
        self._has_batch |= has_batch
        self.names.append(name)
        self.tensors.append(tensor if has_batch else tensor[None])
        self.dtypes.append(dtype)

    def expand(self) -> None:
        """Repeat tensors with a batch of 1 for every instance of the others."""
        count = self._common_batch()
        self.tensors = [tensor.expand(count, *tensor.shape[1:]) for tensor in self.tensors]

    def add_geometry(self, name: str, geometry: Geometry[torch.Tensor], like: Geometry[wp.array]) -> None:
        """Add the tensors of a geometry, of which arrays there are as many items as of another."""
        geometry, own = as_geometry(name, geometry), like.arrays()
        self._bodies[name] = {"moving": geometry.moving, "deformed": geometry.deformed}
        for part, tensor in geometry.arrays().items():
            self.add(f"{name}.{part}", tensor, GEOMETRY_DTYPES[part], own[part].shape[1:], PLACED)
        if geometry.rotations is not None:
            assert like.rotations is not None
            self.add(f"{name}.rotations", geometry.rotations, wp.mat33, like.rotations.shape[1:])

    def geometry(self, name: str, arrays: Mapping[str, wp.array]) -> Geometry[wp.array] | None:
        """A geometry that was added, of arrays; None if none was."""
        if name not in self._bodies:
            return None
        parts = (arrays[f"{name}.{part}"] for part in GEOMETRY_DTYPES)
        return Geometry(*parts, rotations=arrays.get(f"{name}.rotations"), **self._bodies[name])

    def arrays(self) -> dict[str, wp.array]:
        """The tensors as arrays, which require a gradient as they do."""
        result = {}
        for name, tensor, dtype in zip(self.names, self.tensors, self.dtypes, strict=True):
            result[name] = as_array(tensor, dtype)
            result[name].requires_grad = tensor.requires_grad and torch.is_grad_enabled()
        return result

    def apply(self, function: Callable[[Mapping[str, wp.array]], Any], *, affine: Collection[str] = ()) -> Any:
        """Apply a function of arrays by their names, as :func:`~warpshadow.torch.apply` does.

        Results lose a batch dimension that no tensor had.
        """
        self._common_batch()
        results = apply(
            lambda *arrays: function(dict(zip(self.names, arrays, strict=True))),
            *self.tensors,
            dtypes=self.dtypes,
            device=self.device,
            names=self.names,
            affine=affine,
        )
        if self._has_batch:
            return results
        return tuple(result[0] for result in results) if isinstance(results, tuple) else results[0]

    def apply_geometry(
        self, function: Callable[[Mapping[str, wp.array]], Geometry[wp.array]]
    ) -> Geometry[torch.Tensor]:
        """Apply a function that makes a geometry."""
        made: list[Geometry[wp.array]] = []

        def make(arrays: Mapping[str, wp.array]) -> tuple[wp.array, ...]:
            made.append(function(arrays))
            rotations = made[0].rotations
            return (*made[0].arrays().values(), *([] if rotations is None else [rotations]))

        positions, centers, radii, *rotations = self.apply(make)
        return Geometry(
            positions,
            centers,
            radii,
            moving=made[0].moving,
            rotations=rotations[0] if rotations else None,
            deformed=made[0].deformed,
        )

    def _common_batch(self) -> int:
        return common_batch({"cameras": self._cameras, **dict(zip(self.names, self.tensors, strict=True))})


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
    if not is_capturing(device) and not np.isfinite(float(tensor.detach().sum())):
        check.finite(name, tensor.detach().cpu().numpy())
