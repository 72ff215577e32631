"""Spare memory: blocks are given to one array at a time, come back for others of about their size, up to a limit."""

import gc

import pytest
import warp as wp

from warpshadow.device import memory, warp_internals
from warpshadow.device.spare_memory import SpareMemory

SIZE = 2**20


class System:
    """A system that gives blocks at rising addresses, and knows which are out and how large they are."""

    def __init__(self, capacity=2**62):
        self.blocks, self.next, self.capacity = {}, 2**12, capacity

    def take(self, size):
        if sum(self.blocks.values()) + size > self.capacity:
            return 0
        self.blocks[self.next] = size
        self.next += size
        return self.next - size

    def give_back(self, block):
        del self.blocks[block]


def spare_memory(system, limit=2**40):
    return SpareMemory(system.take, system.give_back, limit=limit)


@pytest.mark.parametrize("size", [1, 256, 257, 2**16, 2**16 + 1, 12345678, SIZE, SIZE + 1, 2**30, 2**30 + 1, 2**33])
def test_a_block_is_as_large_as_asked_for_and_little_larger(size):
    system = System()
    block = spare_memory(system).take(size)
    assert size <= system.blocks[block] < max(257, 1.25 * size)


def test_a_block_serves_the_next_of_about_its_size_and_nobody_beside_it():
    system = System()
    spare = spare_memory(system)
    first, second = spare.take(SIZE), spare.take(SIZE)
    assert first != second
    spare.give_back(first, SIZE)
    assert spare.take(2 * SIZE) != first
    assert spare.take(SIZE - 1000) == first
    assert spare.take(SIZE) not in (first, second)


def test_huge_blocks_go_back_at_once():
    system = System()
    spare = spare_memory(system)
    spare.give_back(spare.take(2**32), 2**32)
    assert not system.blocks and spare.cached_bytes == 0


def test_of_each_small_size_a_million_bytes_are_kept():
    system = System()
    spare = spare_memory(system, limit=0)
    for size in (1000, 2**16):
        blocks = [spare.take(size) for _ in range(2000)]
        for block in blocks:
            spare.give_back(block, size)
    assert sorted(set(system.blocks.values())) == [1024, 2**16]
    assert sum(system.blocks.values()) == 2 * 2**20
    out = {spare.take(1024) for _ in range(3)}
    assert len(out) == 3 and len(system.blocks) == 2**10 + 2**4  # no new ones
    spare.clear()
    assert set(system.blocks) == out


def test_beyond_the_limit_all_go_back():
    system = System()
    spare = spare_memory(system, limit=3 * SIZE)
    blocks = [spare.take(SIZE) for _ in range(4)]
    for number, block in enumerate(blocks[:3]):
        spare.give_back(block, SIZE)
        assert spare.cached_bytes == (number + 1) * SIZE
    spare.give_back(blocks[3], SIZE)
    assert not system.blocks and spare.cached_bytes == 0


def test_where_the_system_has_no_more_spare_blocks_make_place():
    system = System(capacity=4 * SIZE)
    spare = spare_memory(system)
    spare.give_back(spare.take(2 * SIZE), 2 * SIZE)
    assert spare.take(3 * SIZE)
    assert spare.take(3 * SIZE) == 0


def test_arrays_take_memory_that_others_have_left():
    gc.collect()  # what others have left must not come in between
    warp_internals._spare_memory.clear()
    array = memory.empty(12_345_678, wp.uint8, "cpu")
    pointer = array.ptr
    del array
    assert memory.empty(12_345_000, wp.uint8, "cpu").ptr == pointer
