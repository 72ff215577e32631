"""Nodes: a computed value, its inputs, whether it is cached, and why.

An :class:`Input` is a value from the caller, such as vertices or a light; a :class:`Node` computes one from inputs and
nodes, when its value is asked for. A node computes its value once and keeps it, unless it carries a gradient (a tape is
good for one playback), says ``caches=False``, as samples do, or the call does not cache, as in the capture of a graph.
Inputs never change; a new value is a new input, with new nodes after it.
"""

import contextlib
import operator
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import note_use
from warpshadow.device.cuda_graph import is_readable
from warpshadow.device.memory import copied
from warpshadow.device.tape import record


class Input:
    """An input of the pipeline: a value that the caller gives.

    Args:
        name: Its name in words.
        value: The value; or a function that makes it when it is first asked for.
        why_new: Why it takes the place of another, in words, such as "light is given".
    Attributes:
        requires_grad: Whether a gradient to it is asked for.
    """

    def __init__(self, name: str, value: Any, *, why_new: str = ""):
        self.name, self.why_new, self.original, self._value = name, why_new, value, value
        self.requires_grad = False
        for item in value if isinstance(value, (tuple, list)) else [value]:
            self.requires_grad |= getattr(item, "requires_grad", False)

    @property
    def root_inputs(self) -> "dict[Input, None]":
        """Itself. Stored it would be a cycle, and arrays would stay until Python collects garbage."""
        return {self: None}

    @property
    def differentiated_inputs(self) -> "dict[Input, None]":
        """Itself if a gradient to it is asked for."""
        return {self: None} if self.requires_grad else {}

    def value(self, call: "Call | None" = None) -> Any:
        """The value."""
        if callable(self._value):
            self._value = self._value()
        note_use(self._value)
        return self._value

    @classmethod
    def renewed(cls, name: str, value: Any, last: "Input | None") -> "Input":
        """Make an input with a copy of the value, or return the last input if the value is the same.

        On a CPU values are compared. On a GPU, which would have to wait for that, an array is the same if it has the
        same ``origin``, the tensor whose memory it is, and the same ``version``, which counts the writes to that.
        While a graph is captured no array counts as the same: its replays read values that are written later.
        """
        result = cls(name, value)
        if result.requires_grad:
            return result
        if last is not None and not last.requires_grad:
            if _is_same(value, last):
                return last
            result.why_new = f"{name} changed since the last call"
        result._value = _copied(value)
        return result


def _arrays(value: Any) -> list[wp.array]:
    """The arrays of a value, which may be one or a sequence of them."""
    return [item for item in (value if isinstance(value, (tuple, list)) else [value]) if isinstance(item, wp.array)]


def _copied(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_copied, value))
    return copied(value) if isinstance(value, wp.array) else value


def _is_same(new_value: Any, last: Input) -> bool:
    """Whether a value equals an input's, as far as the host knows without waiting."""
    arrays, value = _arrays(new_value), last.value()
    if not arrays:
        return bool(new_value == value)
    originals = _arrays(last.original) or [None] * len(arrays)  # none of a value that a function makes
    return all(map(_is_same_array, arrays, originals, _arrays(value)))


def _is_same_array(array: wp.array, before: wp.array | None, copy: wp.array) -> bool:
    """Whether an array equals a stored copy; on a GPU, whether it is the array before, not written to since."""
    if array.device.is_capturing:
        return False
    if is_readable(array.device):  # it sees writes by NumPy, which torch does not count
        return np.array_equal(np.asarray(array), np.asarray(copy))
    origin = getattr(array, "origin", None)
    if before is None or origin is None:
        return False
    marks = [(item.ptr, item.shape, item.strides, getattr(item, "version", None)) for item in (array, before)]
    return origin is getattr(before, "origin", None) and marks[0] == marks[1]


class ExplainRow(NamedTuple):
    """A row of ``explain``: a stage as it is timed and explained.

    A named node is one row. Further rows are steps that its function times itself, and steps that it makes needless,
    which are idle.

    Items and why_idle may be functions that make the words.
    """

    name: str
    items: str | Callable[[], str] = ""  # on how many items it is computed, in words
    why_idle: str | Callable[[], str] = ""  # why there is nothing to do, in words
    has_adjoint: bool = True  # whether its adjoint launches kernels
    inputs: "tuple[AnyInput, ...]" = ()  # its inputs, where they are fewer than its node's


class Node:
    """A value of the pipeline that a function computes from inputs.

    Args:
        name: Name of its own row of ``explain``; empty for a node that is neither timed nor explained.
        function: Computes the value from the inputs' values; None where there is nothing to compute: the value is None.
        inputs: Nodes and inputs of the pipeline; anything else is passed on as it is.
        items, why_idle, has_adjoint: As for :class:`ExplainRow`; an idle node still calls its function, untimed.
        caches: Whether the value may outlive a call.
        extra_inputs: Other nodes that run for this one.
        rows: Further rows, before its own.

    Attributes:
        row: Its own row of ``explain``; None without a name.
        dependencies: The nodes and inputs that it depends on at once.
        root_inputs: All inputs that it depends on.
        requires_grad: Whether a gradient to any of them is asked for; then nothing is cached.
        differentiated_inputs: The inputs that get a gradient from here.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any] | None,
        *inputs: Any,
        items: str | Callable[[], str] = "",
        why_idle: str | Callable[[], str] = "",
        has_adjoint: bool = True,
        caches: bool = True,
        extra_inputs: tuple["Node", ...] = (),
        rows: tuple[ExplainRow, ...] = (),
    ):
        self.function, self.inputs = function, inputs
        self.row = ExplainRow(name, items, why_idle, has_adjoint) if name else None
        self.rows = rows if self.row is None else (*rows, self.row)
        self.dependencies: list[AnyInput] = []
        self.root_inputs: dict[Input, None] = {}  # in order
        self.differentiated_inputs: dict[Input, None] = {}
        self.requires_grad = False
        for item in (*inputs, *extra_inputs):
            if isinstance(item, (Node, Input)):
                self.dependencies.append(item)
                self.root_inputs |= item.root_inputs
                self.differentiated_inputs |= item.differentiated_inputs
                self.requires_grad |= item.requires_grad
        self.caches = caches and not self.requires_grad
        self.is_cached = False
        self._cached: Any = None

    def value(self, call: "Call") -> Any:
        """The value, which is computed unless it is cached or the call has it."""
        if self.is_cached:
            note_use(self._cached)
            return self._cached
        if self not in call:
            value = self.compute(call)
            if self.caches and call.caches:
                self._cached, self.is_cached = value, True
                self.inputs = ()  # which may be large, and constants are not asked for again
                return value
            call[self] = value
        return call[self]

    def compute(self, call: "Call") -> Any:
        """Compute the value."""
        if self.function is None:
            return None
        values = self.values(call)
        if self.row is None or isinstance(self.row.why_idle, str) and self.row.why_idle:
            return self.function(*values)
        with self.timed(call, self.row):
            return self.function(*values)

    def timed(self, call: "Call", row: ExplainRow) -> AbstractContextManager[None]:
        """Time one of its rows while it computes its value."""
        inputs = row.inputs or (self,)
        times_adjoint = row.has_adjoint and any(item.differentiated_inputs for item in inputs)
        return call.timed(row.name, times_adjoint=times_adjoint)

    def values(self, call: "Call") -> list[Any]:
        """The values of the inputs."""
        return [item.value(call) if isinstance(item, (Node, Input)) else item for item in self.inputs]

    def value_if_known(self, call: "Call") -> Any:
        """The value if it needs no computation, else None."""
        return self._cached if self.is_cached else call.get(self)


AnyInput = Node | Input


def identity(value: Any) -> Any:
    """The function of a node that passes its input's value on."""
    return value


def detached(node: AnyInput, *, is_constant: bool = False) -> Node:
    """Make an input of a node's value that passes no gradient to the node.

    Args:
        node: The node or input.
        is_constant: Whether the value is independent of the inputs' values.
    """
    result = Node("", identity, node, caches=False)
    result.differentiated_inputs = {}
    if is_constant:
        result.dependencies, result.root_inputs, result.requires_grad = [], {}, False
    return result


def field_of(node: Node, name: str, *, caches: bool = True) -> Node:
    """Make a node of a field of a node's value, which is a named tuple."""
    return Node("", operator.attrgetter(name), node, caches=caches)


class Timing:
    """Seconds of the host that a stage took when it last ran; on a GPU, the time to launch it."""

    def __init__(self) -> None:
        self.forward = 0.0
        self.adjoints: dict[object, float] = {}  # of each part of it

    @property
    def backward(self) -> float | None:
        """Seconds that its adjoint took; None where it did not run."""
        return sum(self.adjoints.values()) if self.adjoints else None


class Clock:
    """How long each stage took when it last ran.

    Attributes:
        timings: By the stages' names.
        waits: Whether a stage begins and ends with the device idle. On a GPU times are of its work then, and an image
            takes longer.
    """

    def __init__(self) -> None:
        self.timings: dict[str, Timing] = {}
        self.waits = False

    def now(self) -> float:
        """Seconds since some moment."""
        if self.waits:
            wp.synchronize()
        return time.perf_counter()


class Call(dict[Node, Any]):
    """One call of the pipeline: the values that it computed and that are not cached, by node.

    Args:
        clock: Where times are noted.
        known: Values that are known before.
        caches: Whether nodes may keep values. Values made during the capture of a CUDA graph belong to the graph.
    """

    def __init__(self, clock: Clock, known: Mapping[Node, Any] | None = None, *, caches: bool = True):
        super().__init__(known or {})
        self.caches = caches
        self._clock = clock
        self._timings: dict[str, Timing] = {}

    @contextlib.contextmanager
    def timed(self, name: str, *, times_adjoint: bool) -> Iterator[None]:
        """Time a stage, or one more part of a stage that has run in this call.

        Its adjoint is timed by marks on the tape.
        """
        timing = self._timings.get(name)
        if timing is None:
            timing = self._timings[name] = self._clock.timings[name] = Timing()
        part, now = object(), self._clock.now

        def end_adjoint() -> None:
            timing.adjoints[part] += now()

        def start_adjoint() -> None:
            timing.adjoints[part] = -now()

        if times_adjoint:
            record(end_adjoint)  # the tape plays back from the end
        start = now()
        yield
        if times_adjoint:
            record(start_adjoint)
        timing.forward += now() - start
