"""The scaling demo: exponents, memory, and that what it times is what it says, at sizes that take no time."""

import sys

import numpy as np
import pytest
import torch

import warpshadow as ws
from demos.benchmarks import scaling


def test_exponents_are_those_of_a_power_law_and_the_last_one_of_the_last_two_points():
    points = [scaling.Point(n, 3 * n**1.5, 0) for n in (10, 100, 1000)]
    assert scaling.exponents(points) == pytest.approx((1.5, 1.5))
    points[-1] = points[-1]._replace(milliseconds=10 * points[-2].milliseconds)
    whole, last = scaling.exponents(points)
    assert last == pytest.approx(1.0)
    assert 1.0 < whole < 1.5
    assert np.isnan(scaling.exponents(points[:1])).all()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the peak of a call")
def test_memory_is_what_a_call_takes_at_most_though_it_gives_it_back():
    held = np.ones(2**22)  # 32 MiB that are no part of the call
    assert scaling.added_mebibytes(lambda: np.ones(2**23).sum()) == pytest.approx(64, abs=4)
    assert scaling.added_mebibytes(lambda: held.sum()) == pytest.approx(0, abs=4)


def test_half_of_the_vertices_of_a_ball_scene_lie_on_the_ground():
    for subdivisions in (2, 4):
        ball, ground = (body.mesh.vertex_count for body in scaling.ball_scene(subdivisions, 16, 32).bodies)
        assert ground == pytest.approx(ball, rel=0.1)


def test_a_crowd_stands_on_the_ground_without_touching():
    *balls, ground = scaling.crowded_scene(3).bodies
    assert len(balls) == 9
    lows, highs = np.array([body.world_mesh().bounds for body in balls]).swapaxes(0, 1)
    assert lows[:, 1] == pytest.approx(0, abs=1e-5)
    assert np.abs(np.stack([lows, highs])[..., [0, 2]]).max() < ground.mesh.bounds[1][0]
    for one in range(9):
        gaps = np.maximum(lows - highs[one], lows[one] - highs).max(axis=1)
        assert (np.delete(gaps, one) > 0).all()


@pytest.mark.slow
def test_curves_are_measured_printed_and_drawn(tmp_path, monkeypatch, capsys):
    prepared = []

    def prepare(size):
        prepared.append(size)
        scene = scaling.ball_scene(1, size, 16)
        return scaling.shading(scene) | scaling.image(scene) | scaling.iteration(scene, 2)

    monkeypatch.setitem(scaling.CURVES, "spheres", scaling.Curve((16, 32, 1024), prepare))
    scaling.main(["spheres"], most=32, runs=1, output=tmp_path)
    assert prepared == [16, 16, 32]  # the first also to compile
    printed = capsys.readouterr().out
    for what in ("visibility and shading", "… and back", "image", "iteration"):
        assert f"{what} by spheres" in printed
    assert printed.count("exponent") == 4
    assert "nan" not in printed or sys.platform != "linux"
    assert np.ptp(ws.read_image(tmp_path / "scaling.png")[..., :3]) > 0.5


def test_all_curves_have_sizes_that_grow_and_can_be_prepared(monkeypatch):
    monkeypatch.setattr(scaling, "bunny_spheres", lambda count: ws.Spheres(np.zeros((count, 3)), np.ones(count)))
    monkeypatch.setattr(scaling, "bunny_with", lambda spheres, size=256: scaling.ball_scene(1, 16, size))
    for name, curve in scaling.CURVES.items():
        assert list(curve.sizes) == sorted(set(curve.sizes)), name
        assert all(map(callable, curve.prepare(curve.sizes[0]).values())), name


def test_a_pose_iteration_of_a_batch_has_gradients():
    (iterate,) = scaling.iteration(scaling.ball_scene(1, 16, 16), 3).values()
    iterate()
    gradients = [
        cell.cell_contents.grad for cell in iterate.__closure__ if isinstance(cell.cell_contents, torch.Tensor)
    ]
    assert [gradient.shape for gradient in gradients if gradient is not None] == [(3, 2, 3)]


def test_the_run_of_a_million_vertices_says_its_size_and_peak(capsys):
    scaling.million(1, 10, 16, 16)
    printed = capsys.readouterr().out
    assert "163 vertices, 16 spheres, 16 × 16 pixels" in printed
    assert printed.count("GiB") == 2
    assert "shaded were the" in printed
