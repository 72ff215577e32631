"""Launching: run kernels, and record their adjoints on the tape.

A kernel has either Warp's own adjoint, which the tape plays back, in slices where the kernel runs in slices, maybe of
functions with ``wp.func_grad``; or one written by hand as another kernel (``enable_backward=False``).
:func:`launch_with_adjoint` launches such a pair; where more than a launch is needed, :func:`differentiable` pairs
functions, and for several results :func:`.tape.record_adjoint`. Either way a result requires a gradient if an
array that it depends on does, and nothing is recorded if none does.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import warp as wp

from warpshadow.device import warp_internals
from warpshadow.device.memory import in_huge_pages, require_gradient
from warpshadow.device.parallel import Scratch, ScratchStruct, launch_adjoint_slices, launch_slices
from warpshadow.device.tape import record_adjoint, record_kernel
from warpshadow.device.warp_internals import contiguous_view, scalar_type, viewed_array


def launch(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    *,
    inputs: Sequence[Any],
    outputs: Sequence[wp.array | None] = (),
    sums: Sequence[wp.array | None] = (),
    scratch: Sequence[Scratch | ScratchStruct] = (),
    cost: float | None = None,
    shared: Sequence[wp.array | None] = (),
) -> None:
    """Launch a kernel on the device of its arrays.

    Outputs of a kernel with Warp's own adjoint require a gradient if an input does; the launch is then recorded.

    | arguments, in this order | the kernel | Warp's adjoint |
    | --- | --- | --- |
    | ``first_row``, ``worker`` | has them if it has a cost | |
    | ``inputs`` | reads them | one row adds to a place in their gradients |
    | … those ``shared`` by rows | reads them | all rows add to their gradients |
    | ``scratch`` | a row for each worker on a CPU, for each thread on a GPU, if it has a cost | knows it not |
    | ``outputs`` | one row writes to a place in them; without a cost any, atomically | they require a gradient |
    | ``sums``, None to skip one | all rows add to them | knows them not |

    Args:
        kernel: The kernel.
        dim: Threads in Warp's sense; if the kernel has a cost, the first dimension is that of rows.
        outputs: One that is to require a gradient must not be a view made before it does.
        cost: Roughly how long a thread takes [ns]: on a CPU the launch is cut into slices if they are worth it, which
            run on all cores (:mod:`warpshadow.device.parallel`). None runs it on one.
        shared: Of a kernel that has a cost and Warp's own adjoint.
    """
    device = _device_of((*outputs, *sums, *inputs))
    needs_gradient = kernel.options.get("enable_backward") is not False and any_requires_grad(inputs)
    if needs_gradient:
        for output in outputs:
            if output is not None:
                _require_gradient(in_huge_pages(output), kernel)
    if cost is None:
        shape, arguments = (dim,) if isinstance(dim, int) else dim, [*inputs, *outputs, *sums]
        warp_internals.bound_kernel(kernel, arguments, device)(shape)
        if needs_gradient:
            record_kernel(kernel, shape, arguments, device)
        return
    launch_slices(kernel, dim, cost=cost, inputs=inputs, outputs=outputs, scratch=scratch, sums=sums, device=device)
    if needs_gradient:
        assert not (scratch or sums), f"{kernel.key}: Warp's adjoint knows neither scratch memory nor sums"
        options = {"cost": 2 * cost, "inputs": inputs, "outputs": outputs, "shared": shared, "device": device}
        arrays = [value for value in (*inputs, *outputs) if isinstance(value, wp.array)]
        record_adjoint(lambda: launch_adjoint_slices(kernel, dim, **options), arrays)


def differentiable(
    forward: Callable[[wp.array], None],
    adjoint: Callable[[wp.array], None],
    result: wp.array,
    variables: Sequence[wp.array | None],
) -> wp.array:
    """Compute a result by launches whose adjoint is written by hand, and put that on the tape.

    Args:
        forward: Launches that write the result, which they get.
        adjoint: Launches that add to the gradients of the variables that have one; they get the result's. It is
            called whenever the tape plays back, and not at all where no variable requires a gradient.
        result: Memory for the result: ``wp.empty`` if it is large, since memory that was written to stays in small
            pages. It requires a gradient if a variable does.
        variables: Arrays that the result depends on differentiably; None is skipped.
    Returns:
        The result.
    """
    if any_requires_grad(variables):
        require_gradient(result)
    forward(in_huge_pages(result))
    record_adjoint(lambda: adjoint(result.grad), [*variables, result])
    return result


def launch_with_adjoint(
    kernel: wp.Kernel,
    adjoint_kernel: wp.Kernel | Callable[[], wp.Kernel],
    dim: int | Sequence[int],
    *,
    inputs: Sequence[Any],
    result: wp.array,
    variables: Sequence[wp.array | None],
    shared: Sequence[wp.array | None] = (),
    outputs: Sequence[wp.array | None] = (),
    adj_inputs: Sequence[wp.array] = (),
    scratch: Sequence[Scratch | ScratchStruct] = (),
    adj_scratch: Sequence[Scratch | ScratchStruct] = (),
    cost: float,
    adj_cost: float | None = None,
) -> wp.array:
    """Launch a kernel whose adjoint is another kernel, written by hand, and put that on the tape.

    | arguments of both, in this order | the kernel | its adjoint |
    | --- | --- | --- |
    | ``inputs`` | reads them | reads them |
    | ``adj_inputs``, such as outputs; the gradient of ``result`` | – | reads them |
    | ``scratch``; ``adj_scratch`` | has the first | has both |
    | ``outputs``, ``result`` | writes them | – |
    | gradients of ``variables``, None for one without | – | one row adds to a place in them |
    | gradients of ``shared`` variables | – | all rows add to them |

    Args:
        kernel, dim, scratch, cost: As for :func:`launch`.
        adjoint_kernel: The adjoint, or a function that makes it, which is called where there is a gradient.
        result: Memory for the result, as for :func:`differentiable`.
        variables, shared: Arrays that the result depends on differentiably.
        adj_cost: Cost of the adjoint; by default twice that of the kernel.
    Returns:
        The result.
    """

    def gradients(arrays: Sequence[wp.array | None]) -> list[wp.array | None]:
        return [None if array is None else array.grad for array in arrays]

    def adjoint(adj_result: wp.array) -> None:
        launch(
            adjoint_kernel if isinstance(adjoint_kernel, wp.Kernel) else adjoint_kernel(),
            dim,
            inputs=[*inputs, *adj_inputs, adj_result],
            outputs=gradients(variables),
            sums=gradients(shared),
            scratch=[*scratch, *adj_scratch],
            cost=2 * cost if adj_cost is None else adj_cost,
        )

    return differentiable(
        lambda result: launch(kernel, dim, inputs=inputs, outputs=[*outputs, result], scratch=scratch, cost=cost),
        adjoint,
        result=result,
        variables=[*variables, *shared],
    )


def any_requires_grad(values: Iterable[Any]) -> bool:
    """Whether one of some values is an array that requires a gradient."""
    for value in values:  # noqa: SIM110  (any takes twice as long)
        if isinstance(value, wp.array) and value.requires_grad:
            return True
    return False


def _device_of(values: Iterable[Any]) -> wp.Device:
    """Device of the first array of some values."""
    for value in values:
        if isinstance(value, wp.array):
            return value.device
    raise ValueError("got no array")


def without_gradient(array: wp.array) -> wp.array:
    """View an array without its gradient."""
    if not array.requires_grad:
        return array
    view = contiguous_view(array, array.shape, array.dtype, has_gradient=False)
    if view is None:
        view = array.reshape(array.shape)
        view.requires_grad = False
    return view


def _require_gradient(output: wp.array, kernel: wp.Kernel) -> None:
    is_real = scalar_type(output.dtype) in (wp.float32, wp.float64)
    if output.requires_grad or not is_real:
        return
    if viewed_array(output) is not None:
        raise RuntimeError(f"{kernel.key}: got an output that is a view, which has no gradient of its own")
    require_gradient(output)
