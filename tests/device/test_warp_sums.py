"""Sums over warps: CUDA's source, run by 32 threads of the CPU that stand in for a warp's."""

import shutil
import subprocess

import numpy as np
import pytest
import warp as wp

from warpshadow.device.warp_sums import SUM_OF_PEERS, sum_over_warp, sums_over_warp

EMULATION = """
#include <barrier>
#include <cstdio>
#include <cstring>
#include <map>
#include <mutex>
#include <strings.h>
#include <thread>
#include <vector>

// a warp's threads that are in one call meet twice, once to write and once to have read
struct Group { std::barrier<> meeting; unsigned bits[32]; Group(int count) : meeting(count) {} };
std::map<unsigned, Group*> groups;
std::mutex guard;
unsigned active;
thread_local struct { int x; } threadIdx;

Group* group(unsigned mask) {
    std::lock_guard<std::mutex> lock(guard);
    auto& found = groups[mask];
    return found ? found : found = new Group(__builtin_popcount(mask));
}
template <class F> auto exchange(unsigned mask, unsigned own, F read) {
    Group* g = group(mask);
    g->bits[threadIdx.x] = own;
    g->meeting.arrive_and_wait();
    auto result = read(g->bits);
    g->meeting.arrive_and_wait();
    return result;
}
unsigned __activemask() { return active; }
int __popc(unsigned x) { return __builtin_popcount(x); }
int __ffs(int x) { return ffs(x); }
unsigned __ballot_sync(unsigned mask, int is) {
    return exchange(mask, is != 0, [&](unsigned* bits) {
        unsigned all = 0;
        for (int k = 0; k < 32; ++k) if (mask >> k & 1) all |= bits[k] << k;
        return all;
    });
}
int __any_sync(unsigned mask, int is) { return __ballot_sync(mask, is) != 0; }
unsigned __match_any_sync(unsigned mask, int place) {
    return exchange(mask, (unsigned)place, [&](unsigned* bits) {
        unsigned same = 0;
        for (int k = 0; k < 32; ++k) if ((mask >> k & 1) && bits[k] == (unsigned)place) same |= 1u << k;
        return same;
    });
}
float __shfl_sync(unsigned mask, float value, int source) {
    unsigned own; std::memcpy(&own, &value, 4);
    unsigned there = exchange(mask, own, [&](unsigned* bits) { return bits[source]; });
    float result; std::memcpy(&result, &there, 4);
    return result;
}

const int COUNT = 2;
void sum_of_peers(float* sums, int index) { BODY }

int main() {
    int places[32]; float values[32][COUNT];
    while (std::scanf("%u", &active) == 1) {
        for (int k = 0; k < 32; ++k)
            if (std::scanf("%d %f %f", &places[k], &values[k][0], &values[k][1]) != 3) return 1;
        std::vector<std::thread> threads;
        for (int k = 0; k < 32; ++k)
            if (active >> k & 1)
                threads.emplace_back([&, k] { threadIdx.x = k; sum_of_peers(values[k], places[k]); });
        for (auto& thread : threads) thread.join();
        for (auto& value : values) std::printf("%.9g %.9g ", value[0], value[1]);
        std::printf("\\n");
    }
}
"""


@pytest.mark.slow
def test_the_first_of_a_warps_threads_at_a_place_has_their_sum(tmp_path):
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("needs a C++ compiler")
    source = tmp_path / "warp.cpp"
    source.write_text(EMULATION.replace("BODY", SUM_OF_PEERS))
    command = [compiler, "-std=c++20", "-O1", "-pthread", source, "-o", tmp_path / "warp"]
    subprocess.run(command, check=True, capture_output=True)
    random = np.random.default_rng(0)
    masks = [0xFFFFFFFF, 1, 1 << 31, 0x80000001, *(int(mask) for mask in random.integers(1, 1 << 32, 12))]
    cases = [(mask, random.integers(0, kinds, 32)) for mask in masks for kinds in (1, 3, 32)]
    values = random.integers(-99, 99, (len(cases), 32, 2)).astype(float)  # whose sums are exact in any order
    lines = [
        f"{mask} " + " ".join(f"{place} {a} {b}" for place, (a, b) in zip(places, value, strict=True))
        for (mask, places), value in zip(cases, values, strict=True)
    ]
    run = subprocess.run([tmp_path / "warp"], input="\n".join(lines), capture_output=True, text=True, check=True)
    results = np.array([line.split() for line in run.stdout.splitlines()], float).reshape(len(cases), 32, 2)
    for (mask, places), value, result in zip(cases, values, results, strict=True):
        is_active = mask >> np.arange(32) & 1 == 1
        expected = np.zeros((32, 2))
        for place in set(places[is_active]):
            peers = np.flatnonzero(is_active & (places == place))
            expected[peers[0]] = value[peers].sum(axis=0)
        np.testing.assert_array_equal(result[is_active], expected[is_active])


@wp.kernel(enable_backward=False)
def _sum(
    # in
    values: wp.array(dtype=wp.vec4),
    # out
    sums: wp.array(dtype=wp.vec4),
    firsts: wp.array(dtype=float),
):
    """A thread owns four values."""
    thread = wp.tid()
    sums[thread] = sums_over_warp(values[thread], thread // 40)
    firsts[thread] = sum_over_warp(values[thread][0], thread // 40)


def test_what_threads_of_a_place_have_adds_up_to_their_sum(device):
    values = np.random.default_rng(0).integers(-99, 99, (80, 4))
    sums, firsts = wp.empty(80, dtype=wp.vec4, device=device), wp.empty(80, dtype=float, device=device)
    wp.launch(_sum, 80, inputs=[wp.array(values, dtype=wp.vec4, device=device)], outputs=[sums, firsts], device=device)
    for half in (slice(0, 40), slice(40, 80)):
        np.testing.assert_array_equal(sums.numpy()[half].sum(axis=0), values[half].sum(axis=0))
        assert firsts.numpy()[half].sum() == values[half, 0].sum()
