"""Every kernel of the package as a GPU gets it, compiled without one by Warp's NVRTC: PTX, or a GPU's machine code."""

import importlib
import pkgutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import warp as wp

import warpshadow
from warpshadow.device import batch, lanes
from warpshadow.device.warp_internals import kernel_modules
from warpshadow.spheres import refine
from warpshadow.stages.bounces import form_factors, sphere_light
from warpshadow.stages.convex import coverage as convex
from warpshadow.stages.gloss import lobes, prefilter, traced_lobes
from warpshadow.stages.light import transfer
from warpshadow.stages.raster.interpolation import _make_interpolate
from warpshadow.stages.ray_traced import shared_rays, traced_transfer
from warpshadow.stages.self_visibility import gather, self_transfer, sun_cells, trace
from warpshadow.stages.silhouettes import smooth
from warpshadow.stages.visibility import directional, exponential, log_sh

LANES = 1
"""Receivers of a thread on a GPU, lanes.lane_count."""

ORDERS = (2, 8)

FACTORIES: dict[str, Callable[[], wp.Kernel]] = {
    **{
        f"{make.__name__} {order} {horizon}": partial(make, order, horizon, LANES)
        for make in (log_sh._make_accumulate, log_sh._make_accumulate_adjoint)
        for order, horizon in [(2, False), (8, True)]
    },
    **{
        f"_make_exponentiate {order} {base} {keeps}": partial(exponential._make_exponentiate, order, base, keeps, LANES)
        for order, base, keeps in [(2, "quadratic", True), *((8, base, False) for base in exponential.THRESHOLDS)]
    },
    **{
        f"_make_exponentiate_adjoint {order} {base}": partial(
            exponential._make_exponentiate_adjoint, order, base, LANES
        )
        for order, base in [(2, "quadratic"), *((8, base) for base in exponential.THRESHOLDS)]
    },
    **{
        f"{make.__name__} {has_horizon} {has_footprints}": partial(make, has_horizon, has_footprints, LANES)
        for make in (directional._make_transmit, directional._make_transmit_adjoint)
        for has_horizon, has_footprints in ((False, False), (True, False), (True, True))
    },
    **{
        f"_make_sh_transfer {name} {order} {is_shadowed}": lambda k=k, arguments=(order, is_shadowed, LANES): (
            transfer._make_sh_transfer(*arguments)[k]
        )
        for k, name in enumerate(("kernel", "adjoint"))
        for order, is_shadowed in [(2, True), (8, True), (8, False)]
    },
    **{f"_make_sh_product {order}": partial(transfer._make_sh_product, order, LANES) for order in ORDERS},
    **{f"_make_evaluate_rotated {order}": partial(self_transfer._make_evaluate_rotated, order) for order in ORDERS},
    **{
        f"{make.__name__} {dtype.__name__}": partial(make, dtype)
        for make in (_make_interpolate, batch._make_add, smooth._make_blend, smooth._make_blend_adjoint)
        for dtype in (wp.float32, wp.vec4)
    },
    **{f"_make_copy {dtype.__name__}": partial(batch._make_copy, dtype) for dtype in (wp.float32, wp.vec3)},
    **{make.__name__: partial(make, LANES) for make in (sphere_light._make_light, sphere_light._make_light_adjoint)},
    **{make.__name__: partial(make, LANES) for make in (convex._make_cover, convex._make_cover_adjoint)},
    **{make.__name__: partial(make, LANES) for make in (refine._make_project, refine._make_project_adjoint)},
    **{make.__name__: partial(make, LANES) for make in (gather._make_gather, gather._make_gather_adjoint)},
    "_make_sample_lobes": lambda: lobes._make_sample_lobes(LANES)[0],
    "_make_sample_lobes adjoint": lambda: lobes._make_sample_lobes(LANES)[1],
    "_make_look_up": lambda: prefilter._make_look_up(LANES)[0],
    "_make_look_up adjoint": lambda: prefilter._make_look_up(LANES)[1],
    "trace._make_trace": trace._make_trace,
    "_make_sum_hits": form_factors._make_sum_hits,
    "sun_cells._make_trace": sun_cells._make_trace,
    "shared_rays._make_trace False": partial(shared_rays._make_trace, False),
    "shared_rays._make_trace True": partial(shared_rays._make_trace, True),
    "gloss.traced_lobes._make_trace": traced_lobes._make_trace,
    "_make_trace_cosines False": partial(traced_transfer._make_trace_cosines, False),
    "_make_trace_cosines True": partial(traced_transfer._make_trace_cosines, True),
    "_make_empty": partial(lanes._make_empty, ""),
}
"""Makers of kernels that depend on an order, a dtype or an option, with the arguments that differ most."""


def import_package() -> None:
    """Import all files of the package, so that Warp knows their kernels."""
    for info in pkgutil.walk_packages(warpshadow.__path__, "warpshadow."):
        importlib.import_module(info.name)


def file_modules() -> dict[str, wp.Module]:
    """Warp modules that hold the kernels of a file of the package, by its name: those that no factory makes."""
    import_package()
    return {
        name: module for name, module in kernel_modules().items() if name.startswith("warpshadow") and module.kernels
    }


def compile_module(module: wp.Module, architectures: list[int], folder: Path, *, to_cubin: bool = False) -> list[Path]:
    """Compile a Warp module.

    Args:
        module: The module; a kernel's is ``kernel.module``.
        architectures: Compute capabilities, 90 for sm_90.
        folder: Empty folder to compile in.
        to_cubin: Make machine code, as a GPU of each architecture loads it; otherwise PTX.

    Returns:
        Files, one an architecture.
    """
    wp.compile_aot_module(module, device=None, arch=architectures, module_dir=folder, use_ptx=not to_cubin)
    return sorted(folder.glob("*.cubin" if to_cubin else "*.ptx"))
