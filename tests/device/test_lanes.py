"""Lanes and the compiler's flags follow the CPU, and nothing but speed depends on them."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.device import lanes
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.light.transfer import sh_transfer
from warpshadow.stages.visibility import directional, log_sh
from warpshadow.stages.visibility.exponential import exponentiate

OPAQUE = 1e-4  # relative L2: where less than this passes, a block of receivers looks no further, and others may
ROUNDING = 2e-6  # relative L2: sums over the lanes, in another order
NATIVE = "-march=native"
OWN = f"{NATIVE} -mllvm=-inline-threshold=9000"


@pytest.fixture
def cpu(monkeypatch):
    """A function that pretends a CPU and a compiler that refuses some flags; it returns what that was tried with."""

    def pretend(*features, refuses=(), own=OWN):
        tried = []

        def builds(flags):
            tried.append(flags)
            return not set(flags.split()) & set(refuses)

        lanes._accepted_flags.cache_clear()
        monkeypatch.setattr(lanes, "_cpu_features", lambda: frozenset(features))
        monkeypatch.setattr(lanes, "_builds", builds)
        monkeypatch.setattr(wp.config, "cpu_compiler_flags", own)
        return tried

    yield pretend
    lanes._accepted_flags.cache_clear()


@pytest.mark.parametrize(
    ("features", "count", "bits", "is_whole"),
    [
        (("sse2", "avx", "avx2", "fma", "avx512f"), 16, 512, True),
        (("sse2", "avx", "avx2", "fma"), 8, 256, True),
        (("sse2", "avx"), 8, 256, True),
        (("sse2",), 4, 128, False),
        (("neon", "sve"), 4, 128, False),
        ((), 4, 128, False),  # it cannot be asked
    ],
)
def test_there_are_as_many_lanes_as_registers_have_floats_and_the_width_is_said(features, count, bits, is_whole, cpu):
    cpu(*features)
    assert lanes.lane_count("cpu") == count
    flags = lanes.compiler_flags(count).split()
    assert f"-mprefer-vector-width={bits}" in flags
    assert NATIVE in flags
    assert ("-fno-unroll-loops" in flags) == is_whole
    assert is_whole or set(OWN.split()) < set(flags)  # what unrolls them is Warp's own


def test_the_cpu_at_hand_can_be_asked(capsys):
    lanes._diagnostics.cache_clear()
    assert {"sse2", "neon"} & lanes._cpu_features()
    assert lanes.cpu_name() not in ("", "unknown")
    assert not capsys.readouterr().out


def test_where_warp_does_not_tell_nothing_fails(monkeypatch):
    monkeypatch.delattr(wp, "print_diagnostics")
    lanes._diagnostics.cache_clear()
    assert lanes.lane_count("cpu") == 4
    assert NATIVE in lanes.compiler_flags(4)
    lanes._diagnostics.cache_clear()


def test_loops_of_more_than_a_register_are_unrolled(cpu):
    cpu("avx2", "avx")
    assert "-fno-unroll-loops" not in lanes.compiler_flags(16)


def test_a_portable_build_stays_portable(cpu):
    cpu("avx512f", own="")
    assert lanes.lane_count("cpu") == 4
    assert lanes.compiler_flags(4) == ""


def test_flags_that_the_compiler_refuses_are_left_out_with_one_warning(cpu):
    tried = cpu("avx512f", refuses=["-mprefer-vector-width=512", "-fno-slp-vectorize"])
    with pytest.warns(UserWarning, match="refuses -fno-slp-vectorize -mprefer-vector-width=512") as warned:
        flags = {lanes.compiler_flags(16) for _ in range(3)}
    assert flags == {f"{NATIVE} -fno-unroll-loops"}
    assert len(warned) == 1
    assert len(tried) == 4  # all together, then each


def test_the_compiler_itself_says_what_it_refuses():
    assert lanes._builds(f"{NATIVE} -mprefer-vector-width=128")
    assert not lanes._builds(f"{NATIVE} -fno-such-flag")


@pytest.mark.parametrize("name, text", [(lanes.LANES_VARIABLE, "3"), (lanes.BITS_VARIABLE, "wide")])
def test_what_the_environment_says_is_checked(name, text, monkeypatch):
    monkeypatch.setenv(name, text)
    with pytest.raises(ValueError, match=f"{name}: got '{text}', expected one of"):
        lanes.lane_count("cpu")
    if name == lanes.BITS_VARIABLE:
        monkeypatch.setenv(name, "256")
        assert lanes.lane_count("cpu") == 8


# ---------------------------------------------------------------------------------------------- results


def with_gradients(function, arrays, dtypes, cotangent):
    """The value of a function of Warp arrays on the CPU, and its gradients where the value's is a cotangent."""
    variables = [
        wp.array(array[None], dtype=dtype, device="cpu", requires_grad=True)
        for array, dtype in zip(arrays, dtypes, strict=True)
    ]
    with wp.Tape() as tape:
        result = function(*variables)
    weights = wp.array(cotangent(result.shape).astype(np.float32), device="cpu")
    tape.backward(grads={result: weights})
    return [result.numpy(), *(variable.grad.numpy() for variable in variables)]


def directional_part(cotangent):
    # horizons only cull, what is below them may be anything: so receivers see all around
    scene = np.delete(np.array(twins.random_scene(11, vertex_count=37), dtype=object), 1)
    dtypes = (wp.vec3, wp.vec3, wp.float32)
    directions = fibonacci(64)
    return with_gradients(
        lambda points, *spheres: directional.transmittance(points, None, *spheres, directions), scene, dtypes, cotangent
    )


def log_sh_part(cotangent):
    scene = twins.random_scene(12, vertex_count=37)
    dtypes = (wp.vec3, wp.vec3, wp.vec3, wp.float32)

    def shade(points, normals, centers, radii):
        log = log_sh.accumulate(points, normals, centers, radii, order=4)
        return sh_transfer(exponentiate(log), normals, order=4)

    return with_gradients(shade, scene, dtypes, cotangent)


@pytest.mark.parametrize("part, tolerance", [(directional_part, OPAQUE), (log_sh_part, ROUNDING)])
def test_results_and_gradients_do_not_depend_on_the_number_of_lanes(part, tolerance, monkeypatch):
    """37 receivers: no multiple of any number of lanes but 1."""

    def values(count):
        monkeypatch.setenv(lanes.LANES_VARIABLE, str(count))
        rng = np.random.default_rng(0)
        return part(lambda shape: rng.normal(size=shape))

    expected = values(16)
    for count in (1, 8):  # each compiles for ten seconds
        for got, same in zip(values(count), expected, strict=True):
            assert np.linalg.norm(got - same) <= tolerance * np.linalg.norm(same), count
