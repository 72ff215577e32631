"""Body spans: consecutive receivers of one body, by which one launch serves receivers of many bodies.

A block of receivers lies in one span. Its number leads a kernel to the body's own blockers, which block none of its
light, or to its table.
"""

import functools
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.capacities import write_numbers
from warpshadow.device.constants import constant
from warpshadow.device.lanes import block_count
from warpshadow.device.parallel import split_row
from warpshadow.device.warp_internals import struct_of


class Span(NamedTuple):
    """Consecutive receivers of one body; −1 for receivers of bodies that are not distinct."""

    body: int
    first: int
    end: int


def spans_of(bodies: np.ndarray) -> tuple[Span, ...]:
    """Split a list of bodies into spans of the same body."""
    changes = np.flatnonzero(np.diff(bodies)) + 1
    bounds = [0, *changes.tolist(), len(bodies)] if len(bodies) else []
    return tuple(Span(int(bodies[first]), first, end) for first, end in itertools.pairwise(bounds))


def spans_between(bodies: Iterable[int], ends: np.ndarray) -> tuple[Span, ...]:
    """Spans of bodies whose receivers follow each other, without empty ones; ends [body + 1] begin with the first."""
    pairs = zip(bodies, itertools.pairwise(ends.tolist()), strict=True)
    return tuple(Span(body, first, end) for body, (first, end) in pairs if end > first)


def relative_spans(spans: Sequence[Span]) -> tuple[Span, ...]:
    """Count the receivers of spans from the first of them on."""
    return tuple(span._replace(first=span.first - spans[0].first, end=span.end - spans[0].first) for span in spans)


@wp.struct
class ReceiverSpans:
    """Consecutive spans of an instance. One span of all receivers has empty arrays."""

    receiver_count: int
    block_count: int  # of an instance
    first_receivers: wp.array(dtype=wp.int32)  # [span + 1], the last is the end
    first_blocks: wp.array(dtype=wp.int32)  # likewise


@wp.struct
class SpanValues:
    """A number of each span."""

    single: int  # of all receivers, read where ``values`` is empty
    values: wp.array(dtype=wp.int32)  # [span]


@wp.struct
class ReceiverBlock:
    """A block of receivers: as many as a thread has lanes, of one span.

    With one lane, :attr:`first`, :attr:`end` and :attr:`number` are of all receivers of the instance.
    """

    batch: int
    span: int
    first: int  # receiver of the span
    end: int
    number: int  # of the block among those of the span


@functools.cache
def make_find_span(lanes: int) -> wp.Function:
    """Make the kernel function that finds the block of a row, where the blocks of all instances follow each other."""

    @wp.func(inline=lanes == 1)
    def find_span(spans: ReceiverSpans, row: int):
        batch, number = split_row(row, spans.block_count)
        block = ReceiverBlock()
        block.batch = batch
        block.number = number
        block.end = spans.receiver_count
        if spans.first_blocks:
            block.span = wp.lower_bound(spans.first_blocks, number + 1) - 1
            if wp.static(lanes > 1):  # a single receiver is counted among all: that takes fewer registers
                block.first = spans.first_receivers[block.span]
                block.end = spans.first_receivers[block.span + 1]
                block.number = number - spans.first_blocks[block.span]
        return block

    return find_span


@wp.func
def value_of_span(values: SpanValues, span: int):
    """The number of a span."""
    value = values.single
    if values.values:
        value = values.values[span]
    return value


@wp.func
def value_of_receiver(values: SpanValues, spans: ReceiverSpans, receiver: int):
    """The number of the span in which a receiver of any instance is."""
    value = values.single
    if values.values:
        value = values.values[wp.lower_bound(spans.first_receivers, receiver + 1) - 1]
    return value


def receiver_spans(spans: Sequence[Span], receiver_count: int, lanes: int, device: wp.Device) -> ReceiverSpans:
    """Cut spans into blocks.

    Args:
        spans: Of the receivers of an instance, consecutive; () for one of all.
        receiver_count: Number of receivers of an instance.
        lanes: Receivers of a block.
    """
    ends = [span.end for span in spans] or [receiver_count]
    first_receivers = [0, *ends]
    counts = [block_count(end - first, lanes) for first, end in itertools.pairwise(first_receivers)]
    are_many = len(spans) > 1
    return struct_of(
        ReceiverSpans,
        receiver_count=receiver_count,
        block_count=sum(counts),
        first_receivers=_put(first_receivers if are_many else [], device),
        first_blocks=_put(list(itertools.accumulate(counts, initial=0)) if are_many else [], device),
    )


def span_values(values: Sequence[int], device: wp.Device) -> SpanValues:
    """Copy a number of each span to a device."""
    return struct_of(SpanValues, single=values[0], values=_put(values if len(values) > 1 else [], device))


@functools.cache
def _no_numbers(device: str) -> wp.array:
    return wp.empty(0, dtype=wp.int32, device=device)


def _put(numbers: Sequence[int], device: wp.Device) -> wp.array:
    """Copy numbers to a device. While a graph is captured nothing may be: it gets them as arguments of launches."""
    if not numbers:
        return _no_numbers(device.alias)
    if not device.is_capturing:
        return constant(np.array(numbers, np.int32), wp.int32, device)
    return write_numbers(np.array(numbers), device)
