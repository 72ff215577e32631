"""Spare memory: blocks that arrays are done with, for the next arrays of about their size.

An iteration frees memory that the next one takes again. The C library gives large blocks back to the system at once,
and every page of a new one stops the kernel that first writes to it: a fifth of an iteration of a pose. Small ones it
keeps itself, but a call of it takes ten times as long as that of a list.
"""

import contextlib
import functools
import threading
from collections.abc import Callable

_MIN_BYTES = 2**8  # of a block
_SMALL_BYTES = 2**16  # up to which blocks are small: of each size as many are kept as take ``_MAX_SMALL``
_MAX_SMALL = 2**20
_MAX_BYTES = 2**30  # of a block; larger ones are not kept
_STEPS = 4  # sizes for each power of two: a block is less than a fourth larger than asked for


class SpareMemory:
    """Allocates blocks of memory and caches freed blocks, up to a limit.

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
        self._blocks: dict[int, list[int]] = {size: [] for size in steps if size <= _MAX_BYTES}
        self._lock = threading.RLock()
        self.cached_bytes = 0  # of freed blocks that are not small

    def take(self, size: int) -> int:
        """Take a block of at least ``size`` bytes; returns its address, 0 where there is no memory."""
        size = _rounded(size)
        if size <= _SMALL_BYTES:
            try:
                return self._blocks[size].pop()
            except IndexError:
                pass
        else:
            with self._lock:
                if self._blocks.get(size):
                    self.cached_bytes -= size
                    return self._blocks[size].pop()
        block = self._take(size)
        if not block:
            self.clear()
            block = self._take(size)
        return block

    def give_back(self, block: int, size: int) -> None:
        """Give back a block that was taken for ``size`` bytes."""
        size = _rounded(size)
        blocks = self._blocks.get(size)
        if blocks is None or size <= _SMALL_BYTES and len(blocks) * size >= _MAX_SMALL:
            self._give_back(block)
        elif size <= _SMALL_BYTES:
            blocks.append(block)
        else:
            with self._lock:
                blocks.append(block)
                self.cached_bytes += size
            if self.cached_bytes > self._limit:
                self.clear()

    def clear(self) -> None:
        """Give all that is kept back to the system."""
        with self._lock:
            for blocks in self._blocks.values():
                with contextlib.suppress(IndexError):  # other threads take small ones meanwhile
                    while True:
                        self._give_back(blocks.pop())
            self.cached_bytes = 0


@functools.lru_cache(maxsize=4096)
def _rounded(size: int) -> int:
    """Bytes of a block for ``size`` bytes: in four sizes for each power of two, if it is to be kept."""
    if size > _MAX_BYTES:
        return size
    size = max(size, _MIN_BYTES)
    step = 2 ** ((size - 1).bit_length() - 1) // _STEPS
    return -(-size // step) * step
