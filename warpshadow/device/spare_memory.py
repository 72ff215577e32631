"""Spare memory: large blocks that arrays are done with, for the next arrays of about their size.

An iteration frees what the next one takes again. The C library gives large blocks back to the system at once, and every
page of a new one stops the kernel that first writes to it: a fifth of an iteration of a pose.
"""

import threading
from collections.abc import Callable

_MIN_BYTES = 2**16  # smaller blocks the C library keeps itself
_MAX_BYTES = 2**30  # of a block; larger ones are not kept
_STEPS = 4  # sizes for each power of two: a block is less than a fourth larger than what it was taken for


class SpareMemory:
    """Takes blocks of memory and keeps those that were given back, up to a limit.

    It may be called from any thread, and by the garbage collector in the midst of a call of its own.

    Args:
        take: Takes a new block of so many bytes from the system; returns its address, 0 where there is none.
        give_back: Gives the block at an address back to the system.
        limit: Most bytes that are kept in all; when they would be more, all are given back.
    """

    def __init__(self, take: Callable[[int], int], give_back: Callable[[int], None], *, limit: int):
        self._take, self._give_back, self._limit = take, give_back, limit
        octaves = range(_MIN_BYTES.bit_length() - 1, _MAX_BYTES.bit_length())
        steps = [2**octave * (_STEPS + step) // _STEPS for octave in octaves for step in range(_STEPS)]
        self._kept: dict[int, list[int]] = {size: [] for size in steps if size <= _MAX_BYTES}
        self._lock = threading.RLock()
        self.bytes_kept = 0  # of blocks that nobody uses

    def take(self, size: int) -> int:
        """Take a block of at least ``size`` bytes; returns its address, 0 where there is no memory."""
        size = _rounded(size)
        with self._lock:
            if self._kept.get(size):
                self.bytes_kept -= size
                return self._kept[size].pop()
        block = self._take(size)
        if not block and self.bytes_kept:
            self.clear()
            block = self._take(size)
        return block

    def give_back(self, block: int, size: int) -> None:
        """Give back a block that was taken for ``size`` bytes."""
        size = _rounded(size)
        if size not in self._kept:
            self._give_back(block)
            return
        with self._lock:
            self._kept[size].append(block)
            self.bytes_kept += size
        if self.bytes_kept > self._limit:
            self.clear()

    def clear(self) -> None:
        """Give all that is kept back to the system."""
        with self._lock:
            for blocks in self._kept.values():
                while blocks:
                    self._give_back(blocks.pop())
            self.bytes_kept = 0


def _rounded(size: int) -> int:
    """Bytes of a block for ``size`` bytes: in four sizes for each power of two, if it is to be kept."""
    if not _MIN_BYTES < size <= _MAX_BYTES:
        return size
    step = 2 ** ((size - 1).bit_length() - 1) // _STEPS
    return -(-size // step) * step
