"""Sums over warps: threads of a GPU that add to one number at the same time sum first, and one of them adds.

Thousands of receivers add to the gradients of a few dozen spheres, and an atomic for each would queue up at a few
addresses. The 32 threads of a warp reach a sphere together, so they need one atomic (``warp_lanes.py`` among
the demos' tools counts them). On a CPU, whose threads have sums of their own, a sum is the value itself.
"""

import warp as wp

SUM_OF_PEERS = """
    const unsigned peers = __match_any_sync(__activemask(), index);
    const int lane = threadIdx.x & 31;
    int rank = __popc(peers & ((1u << lane) - 1u));
    const bool is_first = rank == 0;
    unsigned after = peers & (0xfffffffeu << lane);
    while (__any_sync(peers, after != 0u)) {
        const int next = __ffs((int)after);
        for (int k = 0; k < COUNT; ++k) {
            const float others = __shfl_sync(peers, sums[k], next ? next - 1 : lane);
            if (next)
                sums[k] += others;
        }
        after &= ~__ballot_sync(peers, rank & 1);
        rank >>= 1;
    }
    for (int k = 0; k < COUNT; ++k)
        sums[k] = is_first ? sums[k] : 0.0f;
"""
"""CUDA: sums[COUNT] of the active threads with the same index, on the first of them, and 0 on the others.

Active threads with one index, *peers*, halve their number in each step: peers of odd rank have given their sums to the
one before and are left out.
"""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int COUNT = 1;
    float sums[COUNT] = {{value}};
    {SUM_OF_PEERS}
    return sums[0];
#else
    return value;
#endif
""")
def sum_over_warp(value: float, index: int) -> float:  # type: ignore[empty-body]
    """Sum of the values of a warp's active threads with the same index, on one of them; on the others 0."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int COUNT = 4;
    float sums[COUNT] = {{values[0], values[1], values[2], values[3]}};
    {SUM_OF_PEERS}
    return wp::vec_t<4, wp::float32>(sums[0], sums[1], sums[2], sums[3]);
#else
    return values;
#endif
""")
def sums_over_warp(values: wp.vec4, index: int) -> wp.vec4:
    """:func:`sum_over_warp` of four values."""
    ...
