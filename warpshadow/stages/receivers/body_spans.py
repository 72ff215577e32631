"""Body spans: consecutive receivers of one body, by which one launch serves receivers of many bodies.

A block of receivers lies in one span. Kernels leave out the body's own blockers, or read its table.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.lanes import block_count
from warpshadow.device.parallel import split_row


class Span(NamedTuple):
    """Consecutive receivers of one body; body −1 has all receivers that share their blockers."""

    body: int
    first: int
    end: int


def spans_of(bodies: np.ndarray) -> tuple[Span, ...]:
    """Split a list of bodies into spans of the same body."""
    changes = np.flatnonzero(np.diff(bodies)) + 1
    bounds = [0, *changes.tolist(), len(bodies)] if len(bodies) else []
    return tuple(Span(int(bodies[first]), first, end) for first, end in itertools.pairwise(bounds))


def relative_spans(spans: Sequence[Span]) -> tuple[Span, ...]:
    """Count the receivers of spans from the first of them on."""
    return tuple(span._replace(first=span.first - spans[0].first, end=span.end - spans[0].first) for span in spans)


@wp.struct
class ReceiverSpans:
    """Spans that follow each other; the last item of both arrays is the end of the last span."""

    first_receivers: wp.array(dtype=wp.int32)  # [span + 1]
    first_blocks: wp.array(dtype=wp.int32)  # [span + 1], of an instance


@wp.struct
class ReceiverBlock:
    """A block of receivers: its instance, its span with the receivers there, and its number among their blocks."""

    batch: int
    span: int
    first: int
    end: int
    number: int


@wp.func
def find_span(spans: ReceiverSpans, row: int):
    """The block of a row, where the blocks of all instances follow each other."""
    batch, number = split_row(row, spans.first_blocks[spans.first_blocks.shape[0] - 1])
    span = wp.lower_bound(spans.first_blocks, number + 1) - 1
    block = ReceiverBlock()
    block.batch = batch
    block.span = span
    block.first = spans.first_receivers[span]
    block.end = spans.first_receivers[span + 1]
    block.number = number - spans.first_blocks[span]
    return block


@wp.func
def span_of_receiver(spans: ReceiverSpans, receiver: int):
    """The span of a receiver of any instance."""
    return wp.lower_bound(spans.first_receivers, receiver + 1) - 1


class SpanBlocks(NamedTuple):
    """Spans as kernels read them, and the number of blocks of an instance."""

    spans: ReceiverSpans
    block_count: int


def find_blocks(spans: Sequence[Span], receiver_count: int, lanes: int, device: wp.Device) -> SpanBlocks:
    """Cut spans into blocks.

    Args:
        spans: Of all receivers, in their order; () for one of all.
        receiver_count: Number of receivers.
        lanes: Receivers of a block.
    """
    return _find_blocks(tuple(span.end for span in spans) or (receiver_count,), lanes, device)


@cached_by_values
def _find_blocks(ends: tuple[int, ...], lanes: int, device: wp.Device) -> SpanBlocks:
    first_receivers = np.array([0, *ends], np.int32)
    first_blocks = np.cumsum([0, *(block_count(int(size), lanes) for size in np.diff(first_receivers))])
    spans = ReceiverSpans()
    spans.first_receivers = constant(first_receivers, wp.int32, device)
    spans.first_blocks = constant(first_blocks, wp.int32, device)
    return SpanBlocks(spans, int(first_blocks[-1]))
