"""All uses of Warp's private interface: a release of Warp may change them without notice.

``tests/device/test_warp_internals.py`` tells which of these a release breaks. pyproject.toml accepts the releases that
have passed it.
"""

import contextlib
import ctypes
import functools
import inspect
import itertools
import math
import os
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.spare_memory import SpareMemory


class _TapeOfThread(threading.local):
    """Warp's ``runtime.tape`` as each thread sees it; Warp asks and sets it by this attribute alone."""

    def __init__(self) -> None:
        self.own: list[wp.Tape | None] = []  # the thread's, the last of which is in use; without any the process's is

    def __get__(self, runtime: Any, owner: type | None = None) -> Any:
        if runtime is None:
            return self
        return self.own[-1] if self.own else vars(runtime).get("tape")

    def __set__(self, runtime: Any, tape: wp.Tape | None) -> None:
        if self.own:
            self.own[-1] = tape
        else:
            vars(runtime)["tape"] = tape


_Runtime = wp._src.context.Runtime
if "tape" not in vars(_Runtime):
    _Runtime.tape = _TapeOfThread()


def current_tape() -> wp.Tape | None:
    """The tape that records this thread's launches."""
    return wp._src.context.runtime.tape


@contextlib.contextmanager
def thread_tape(tape: wp.Tape | None) -> Iterator[None]:
    """Record this thread's launches on a tape that other threads do not see; None for no recording."""
    thread_tapes = _Runtime.tape.own
    thread_tapes.append(tape)
    try:
        yield
    finally:
        thread_tapes.pop()


if "inline" not in inspect.signature(wp.func).parameters:  # Warp 1.17, whose compiler decides on its own
    _func = wp.func

    @functools.wraps(_func)
    def _func_without_inline(*arguments: Any, inline: bool | None = None, **options: Any) -> Any:
        return _func(*arguments, **options)

    wp.func = _func_without_inline

_context, _types = wp._src.context, wp._src.types

BLOCK_DIM = 64  # threads of a block on CUDA: with few a block, some thousand receivers reach all multiprocessors

_MAX_STRIDE = 2**31 - 1  # bytes from one item of an axis to the next

_SCALAR_CODES = {
    wp.bool: "?",
    wp.int32: "i",
    wp.uint32: "I",
    wp.int64: "q",
    wp.uint64: "Q",
    wp.float32: "f",
    wp.float64: "d",
}
"""Letters of the module ``struct``."""


class _Argument(NamedTuple):
    """An argument of a CPU kernel, as it lies in the struct that the kernel gets."""

    pack: Callable[[Any], Any] | None  # a value's bytes, up to the next argument; None of an array
    dtype: Any  # of an array
    ndim: int
    zeros: bytes


class _CpuSignature(NamedTuple):
    """Calling convention of a CPU kernel."""

    arguments: list[_Argument]
    loaded_hooks: dict[str, Any]  # the loaded module with its entry points, as soon as one is


@functools.cache
def _cpu_signature(kernel: wp.Kernel) -> _CpuSignature | None:
    """Calling convention of a CPU kernel; None for a kernel that Warp itself has to launch."""
    if kernel.is_generic or not kernel.uses_warp_entry_point_abi:
        return None
    kinds = [argument.type for argument in kernel.adj.args]
    fields: list[tuple[str, Any]] = []
    for number, kind in enumerate(kinds):
        if _types.is_array(kind):
            if type(kind) is not wp.array:
                return None
            field = _types.array_t
        elif isinstance(kind, wp._src.codegen.Struct):
            field = kind.ctype
        elif isinstance(kind, type) and issubclass(kind, ctypes.Array):
            field = kind
        elif kind in _SCALAR_CODES:
            field = kind._type_
        else:
            return None
        fields.append((f"argument_{number}", field))
    layout = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    starts = [getattr(layout, name).offset for name, _ in fields]
    sizes = [end - start for start, end in itertools.pairwise([*starts, ctypes.sizeof(layout)])]
    arguments = [_argument(kind, *of) for kind, *of in zip(kinds, (field for _, field in fields), sizes, strict=True)]
    return _CpuSignature(arguments, {})


def _argument(kind: Any, field: Any, size: int) -> _Argument:
    """An argument of a type of Warp's, by the type and number of bytes that it has in the struct."""
    zeros, padding = bytes(size), bytes(size - ctypes.sizeof(field))
    if _types.is_array(kind):
        return _Argument(None, kind.dtype, kind.ndim, zeros)
    if kind in _SCALAR_CODES:
        return _Argument(struct.Struct(f"{_SCALAR_CODES[kind]}{len(padding)}x").pack, None, 0, zeros)
    if isinstance(kind, wp._src.codegen.Struct):
        return _Argument(lambda value: bytes(value.__ctype__()) + padding, None, 0, zeros)
    return _Argument(lambda value: bytes(value if type(value) is field else field(*value)) + padding, None, 0, zeros)


def _packed(arguments: Iterable[_Argument], values: Sequence[Any], *, are_gradients: bool = False) -> list[Any]:
    """Parts of the struct of a kernel's arguments, or of their gradients, one for each; any gradient may be None.

    Raises:
        TypeError: for an array that is not of the dtype and dimensions.
    """
    parts = []
    for (pack, dtype, ndim, zeros), value in zip(arguments, values, strict=True):
        if value is None and (are_gradients or pack is None):
            parts.append(zeros)
        elif pack is not None:
            parts.append(pack(value))
        elif type(value) is wp.array and value.dtype is dtype and value.ndim == ndim:
            parts.append(value.ctype or value.__ctype__())
        else:
            raise TypeError
    return parts


@functools.cache
def _fields(kind: Any) -> dict[str, _Argument]:
    """Fields of a struct, as they lie in it, by name."""
    fields = kind.ctype._fields_
    starts = [getattr(kind.ctype, name).offset for name, *_ in fields]
    sizes = [end - start for start, end in itertools.pairwise([*starts, ctypes.sizeof(kind.ctype)])]
    return {
        name: _argument(kind.vars[name].type, field, size) for (name, field), size in zip(fields, sizes, strict=True)
    }


def struct_of(kind: Any, **values: Any) -> Any:
    """Make a struct of the values of all its fields, as if they were set one by one, but quicker.

    Raises:
        TypeError: for a field that is missing or unknown, or an array of another type.
    """
    fields = _fields(kind)
    if values.keys() != fields.keys():
        raise TypeError(f"{kind.key}: got {sorted(values)}, expected {sorted(fields)}")
    parts = _packed(fields.values(), [values[name] for name in fields])
    instance = object.__new__(kind.instance_type)
    instance.__dict__.update(values, _ctype=kind.ctype.from_buffer_copy(b"".join(parts)))
    for name, value in values.items():
        if type(value) is wp.array and value._grad is not None:
            instance.__dict__[f"_{name}_grad"] = value._grad  # held, as Warp does
    return instance


@functools.lru_cache(maxsize=4096)
def _cpu_bounds(dim: tuple[int, ...], kernel_dimensions: int) -> Any:
    return ctypes.byref(wp._src.context._build_launch_bounds_from_tuple(dim, kernel_dimensions))


def _cpu_hooks(kernel: wp.Kernel, loaded_hooks: dict[str, Any], device: wp.Device) -> Any:
    """Entry points of a kernel, of its module as it was loaded or is loaded now."""
    module = kernel.module
    hasher = module.hashers.get(1)  # another one if anything of the module changed
    if (
        hasher is None
        or loaded_hooks.get("hasher") is not hasher
        or module.execs.get((None, 1)) is not loaded_hooks["module"]
    ):
        executable = module.load(device, 1)
        hooks = executable.get_kernel_hooks(kernel)
        loaded_hooks.update(module=executable, hooks=hooks, hasher=module.hashers.get(1))
    return loaded_hooks["hooks"]


def bound_kernel(
    kernel: wp.Kernel, arguments: Sequence[Any], device: wp.Device, *, gradients: Sequence[Any] | None = None
) -> Callable[..., None]:
    """Make the function that launches a kernel with arguments off the tape, or its adjoint where gradients are given.

    It takes the dimensions of a launch; then values in place of the first arguments, if they are others each time; and
    ``offsets``, bytes by which other arrays begin later, by argument index. Of an adjoint these are their gradients.

    On a CPU arguments go straight to the compiled function: ``wp.launch`` takes ten times as long to look at them as
    small kernels run. Warp itself launches unusual calls, such as with an argument of a wrong type, and reports the
    error.
    """
    signature = _cpu_signature(kernel) if device.is_cpu else None
    is_plain = wp._src.context.runtime._apic_capture is None and not wp.config.print_launches
    if signature is not None and is_plain and (structs := _structs(signature, arguments, gradients)) is not None:
        fields, loaded_hooks = signature

        # The parts of structs have addresses alone: the arrays are held for as long as the function.
        def run_plainly(
            dim: Sequence[int], *first: Any, offsets: Mapping[int, int] = {}, holds: Any = (arguments, gradients)
        ) -> None:
            values, *others = structs
            if first:
                values = [*_packed(fields[: len(first)], first), *values[len(first) :]]
            if offsets:
                values, others = list(values), [list(other) for other in others]
                for argument_index, offset in offsets.items():
                    if others:
                        values[argument_index] = _moved_part(values[argument_index], gradient=offset)
                    moved = others[0] if others else values
                    moved[argument_index] = _moved_part(moved[argument_index], data=offset)
            if 0 not in dim:
                hooks, bounds = _cpu_hooks(kernel, loaded_hooks, device), _cpu_bounds(tuple(dim), kernel.adj.kernel_dim)
                hook = hooks.backward if others else hooks.forward
                hook(bounds, b"".join(values), *map(b"".join, others))

        return run_plainly

    def run_by_warp(dim: Sequence[int], *first: Any, offsets: Mapping[int, int] = {}) -> None:
        options: dict[str, Any] = {"block_dim": BLOCK_DIM} if device.is_cuda else {}
        inputs, adjoints = list(arguments), None if gradients is None else list(gradients)
        for argument_index, offset in offsets.items():
            moved = _moved((inputs if adjoints is None else adjoints)[argument_index], offset)
            if adjoints is None:
                inputs[argument_index] = moved
            else:
                inputs[argument_index], adjoints[argument_index] = _moved(inputs[argument_index], 0, moved), moved
        if adjoints is not None:
            options |= {"adj_inputs": adjoints, "adjoint": True}
        inputs[: len(first)] = first
        wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_tape=False, **options)

    return run_by_warp


def _moved(array: wp.array, offset: int, gradient: wp.array | None = None) -> wp.array:
    """View memory of the shape of a contiguous array that begins some bytes after it."""
    return wp.array(ptr=array.ptr + offset, dtype=array.dtype, shape=array.shape, device=array.device, grad=gradient)


def _moved_part(part: Any, *, data: int = 0, gradient: int = 0) -> Any:
    """The descriptor of an array that begins some bytes after another, as does its gradient."""
    moved = _types.array_t.from_buffer_copy(part)
    moved.data += data
    moved.grad += gradient
    return moved


def _structs(
    signature: _CpuSignature, arguments: Sequence[Any], gradients: Sequence[Any] | None
) -> list[list[Any]] | None:
    """Parts of the structs of arguments, and of gradients if there are any; None where they are not the kernel's."""
    if len(arguments) != len(signature.arguments):
        return None
    try:
        structs = [_packed(signature.arguments, arguments)]
        if gradients is not None:
            structs.append(_packed(signature.arguments, gradients, are_gradients=True))
    except (TypeError, AttributeError, struct.error):
        return None
    return structs


@functools.lru_cache(maxsize=4096)
def _cpu_array(shape: Any, dtype: type) -> tuple[dict[str, Any], bytes, int]:
    """Attributes of a new CPU array but for its memory, its descriptor, and its bytes."""
    check_strides(shape, dtype)
    array = wp.empty(shape, dtype, device="cpu")
    attributes = vars(array) | {"deleter": _spare_memory.give_back}
    return attributes, bytes(array.__ctype__()), array.capacity


_spare_memory = SpareMemory(
    lambda size: wp._src.context.runtime.core.wp_alloc_host(size, None) or 0,
    lambda block: wp._src.context.runtime.core.wp_free_host(block),
    limit=2**29,
)


def check_strides(shape: int | Sequence[int], dtype: type) -> None:
    """Raise MemoryError for an array whose items Warp's strides, int32, do not reach: kernels would miss them."""
    stride = wp.types.type_size_in_bytes(dtype)
    for length in (shape,) if isinstance(shape, int) else tuple(shape)[::-1]:
        if stride > _MAX_STRIDE and length > 1:
            raise MemoryError(
                f"got an array of shape {shape}, parts of which take {stride:,} bytes, expected up to {_MAX_STRIDE:,} "
                "of each part where there are several: instances in calls of their own, or fewer directions, "
                "receivers or pixels take less"
            )
        stride *= length


@functools.lru_cache(maxsize=4096)
def byte_count(shape: tuple[int, ...], dtype: type) -> int:
    """Bytes of an array, which strides must reach as :func:`check_strides` says."""
    check_strides(shape, dtype)
    return math.prod(shape) * wp.types.type_size_in_bytes(dtype)


def empty(shape: int | Sequence[int], dtype: type, device: wp.DeviceLike) -> wp.array:
    """Make an array of uninitialized memory: ``wp.empty``, but in a third of the time."""
    device = device if isinstance(device, wp.Device) else wp.get_device(device)
    if not device.is_cpu or _context.runtime._apic_capture is not None:
        check_strides(shape, dtype)
        return wp.empty(shape, dtype, device=device)
    attributes, descriptor, size = _cpu_array(shape if isinstance(shape, int) else tuple(shape), dtype)
    pointer = _spare_memory.take(size) if size else None
    if size and not pointer:
        raise MemoryError(f"got no memory for an array of {size:,} bytes")
    return _new_array(attributes, descriptor, pointer)


def _new_array(attributes: dict[str, Any], descriptor: bytes, pointer: int | None) -> wp.array:
    """Make an array of attributes and a descriptor of :func:`_cpu_array`, of the memory at an address."""
    array = object.__new__(wp.array)
    array.__dict__ = fields = attributes.copy()  # quicker than an update
    fields["ptr"], fields["ctype"] = pointer, _types.array_t.from_buffer_copy(descriptor)
    fields["ctype"].data = pointer or 0
    return array


def array_at(pointer: int, shape: Sequence[int], dtype: type, *, owner: Any) -> wp.array:
    """Make a contiguous CPU array of memory that belongs to another, an array or anything else that holds it."""
    attributes, descriptor, _ = _cpu_array(tuple(shape), dtype)
    array = _new_array(attributes, descriptor, pointer)
    fields = array.__dict__
    fields["deleter"], fields["_ref" if isinstance(owner, wp.array) else "owner"] = None, owner
    return array


def contiguous_view(
    array: wp.array, shape: Sequence[int], dtype: type, *, first: int = 0, has_gradient: bool = True
) -> wp.array | None:
    """View contiguous memory of a CPU array, and of its gradient, from a byte on, in another shape or dtype.

    None where Warp is to do it: of arrays on a GPU, and of such that are not contiguous or empty.
    """
    gradient = array._grad if has_gradient else None
    is_whole = array.is_contiguous and array.ptr and (gradient is None or gradient.is_contiguous)
    if not is_whole or not array.device.is_cpu or _context.runtime._apic_capture is not None:
        return None
    view = array_at(array.ptr + first, shape, dtype, owner=array)
    if gradient is not None:
        set_gradient(view, array_at(gradient.ptr + first, shape, dtype, owner=gradient))
    return view


def set_gradient(array: wp.array, gradient: wp.array) -> None:
    """Give an array a gradient of its own shape and dtype that was made for it."""
    if array.ctype is None or not gradient.ptr:
        array.grad = gradient
        return
    array._grad, array._requires_grad = gradient, True
    array.ctype.grad = gradient.ptr


def verify_access(tape: wp.Tape, kernel: wp.Kernel, arguments: Sequence[Any]) -> None:
    """Warn of arrays that a recorded kernel writes to although another has read them, where Warp is to look for it."""
    if wp.config.verify_autograd_array_access:
        tape._check_kernel_array_access(kernel, arguments)


def item_shape(dtype: type) -> tuple[int, ...]:
    """Shape of an item of a dtype: (3,) of vec3, () of float32."""
    return getattr(dtype, "_shape_", ())


def scalar_type(dtype: type) -> type:
    """Type of the numbers in an item of a dtype: float32 of vec3, and of float32 itself."""
    return getattr(dtype, "_wp_scalar_type_", dtype)


def field_dtype(struct: Any, field: str) -> type:
    """Type of the items of an array that is a field of a struct."""
    return struct.vars[field].type.dtype


def viewed_array(array: wp.array) -> wp.array | None:
    """The array that another views, as a part of it or in another shape; None for an array with memory of its own."""
    return getattr(array, "_ref", None)


def kernel_modules() -> dict[str, wp.Module]:
    """Warp's modules by the names of the Python modules whose kernels they hold."""
    return wp._src.context.user_modules


def around_compilation(context: Callable[[], contextlib.AbstractContextManager]) -> None:
    """Compile modules of kernels within a context from now on; of several processes, one compiles.

    The others wait, and load it from Warp's cache. Should the one be killed, its lock ends with it, and the next
    compiles. A module that was compiled before, maybe where nothing can be written, is read without.
    """
    compile_before = wp.Module._compile

    def compile_within(
        module: wp.Module, device: Any = None, output_dir: Any = None, *rest: Any, **options: Any
    ) -> bool:
        if output_dir is None or os.path.exists(output_dir):
            return compile_before(module, device, output_dir, *rest, **options)
        with context(), _locked(os.fspath(output_dir)):
            return compile_before(module, device, output_dir, *rest, **options)

    wp.Module._compile = compile_within


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[None]:
    from filelock import FileLock

    lock = FileLock(f"{folder}.lock", is_singleton=True)  # two copies of the package lock it twice in a thread
    with contextlib.suppress(OSError, NotImplementedError):  # where no file can be locked, each compiles for itself
        lock.acquire()
    try:
        yield
    finally:
        if lock.is_locked:
            lock.release()
        if not lock.is_locked:
            with contextlib.suppress(OSError):  # of Windows, where filelock removes it
                os.unlink(lock.lock_file)


def load_silently(package: str) -> None:
    """Load modules of a package's kernels from now on without Warp's line for each.

    Its other messages stay, and so do these where ``wp.config.log_level`` is ``wp.LOG_DEBUG``.
    """
    load = wp.Module.load

    @functools.wraps(load)
    def load_in_silence(module: wp.Module, *arguments: Any, **options: Any) -> Any:
        level = getattr(wp.config, "log_level", None)  # releases without it say no more than config.verbose asks for
        if level is None or level != wp.LOG_INFO or not _is_of(module, package):
            return load(module, *arguments, **options)
        wp.config.log_level = wp.LOG_WARNING
        try:
            return load(module, *arguments, **options)
        finally:
            if wp.config.log_level == wp.LOG_WARNING:
                wp.config.log_level = level

    wp.Module.load = load_in_silence


def _is_of(module: wp.Module, package: str) -> bool:
    """Whether kernels of a module are a package's; modules of single kernels are named after these alone."""
    kernel = next(iter(module.kernels.values()), None)
    # functions that Warp makes itself, as for array operators, have no module
    return kernel is not None and (kernel.func.__module__ or "").partition(".")[0] == package
