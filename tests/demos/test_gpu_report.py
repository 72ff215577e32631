"""The report of a GPU, tried on a CPU that plays its part."""

import json

import numpy as np
import pytest
import warp as wp

from demos.benchmarks import benchmark, gpu_report

REPORT = {
    "device": "a device",
    "alias": "cuda:0",
    "agreement": [("none, vertex receivers", "image", 1e-6), ("none, vertex receivers", "light", 2e-6)],
    "sanitizer": "clean",
    "kernels": [gpu_report.KernelTimes("iteration of a pose fit in torch", [("forward kernel a", 2, 0.75)])],
    "captured": {"image": (2.0, 1.0)},
    "batches": {1: (2.0, 4.0)},
    "benchmark": {"cpu": {"image": 10.0}, "cuda:0": {"image": 1.0}},
    "tests": {"passed": 3, "failed": [], "skipped": 1, "not reached": 0},
}


def test_a_device_is_compared_in_its_image_and_every_gradient(monkeypatch):
    monkeypatch.setattr(gpu_report, "CASES", [("directional", "vertex"), ("ray-traced", "vertex")])
    errors = {(case, name): error for case, name, error in gpu_report.agreement("cpu")}
    fixed = ["image", "light", "albedo", "texture"]
    moving = ["turns", "translations", "scales", "positions", "centers", "radii", "clip matrix"]
    assert [name for case, name in errors if case.startswith("directional")] == fixed + [
        "turns",
        "translations",
        "scales",
        "positions",
        "clip matrix",
        "centers",
        "radii",
    ]
    assert len(errors) == 2 * len(fixed) + len(moving)
    assert set(errors.values()) == {0.0}  # the CPU, twice


def test_every_gradient_that_is_compared_is_one(monkeypatch):
    results = gpu_report.image_and_gradients(gpu_report.small_scene("directional", "vertex"), "cpu")
    assert all(np.isfinite(value).all() and np.abs(value).max() > 0 for value in results.values())


def test_kernels_and_graphs_of_pose_iterations_are_timed():
    """A CPU has no events, and its graphs are plain calls."""
    assert gpu_report.kernel_times("cpu") == []
    assert gpu_report.POSE_ITERATION in benchmark.iterations(benchmark.small_scene(), "cpu")
    assert list(gpu_report.batches("cpu", size=8)) == [1, 8, 64]
    times = gpu_report.captured("cpu", runs=1)
    assert [label for label in times if label.startswith("pose iteration")]
    assert all(milliseconds > 0 for pair in times.values() for milliseconds in pair)


def test_what_is_not_finite_agrees_with_nothing():
    one = np.ones(3, np.float32)
    assert gpu_report.relative(one, one) == 0
    assert gpu_report.relative(1.5 * one, one) == 0.5
    assert gpu_report.relative(one * np.nan, one) == np.inf


@pytest.mark.parametrize(
    "change, fault",
    [
        (
            {"agreement": [("none, vertex receivers", "image", 1e-3)]},
            "none, vertex receivers: image differs by 1.0e-03",
        ),
        ({"sanitizer": "failed (9): Invalid __global__ read"}, "sanitizer: failed (9): Invalid __global__ read"),
        ({"tests": {"passed": 3, "failed": ["test_sh.test_it"], "skipped": 0, "not reached": 0}}, "test_sh.test_it"),
        ({"tests": {"passed": 3, "failed": [], "skipped": 0, "not reached": 2}}, "tests: 2 were not reached"),
        ({"benchmark": {"error": "RuntimeError: out of memory"}}, "benchmark: RuntimeError: out of memory"),
    ],
)
def test_whatever_is_wrong_is_a_fault_and_stands_in_the_table(change, fault):
    assert not gpu_report.faults(REPORT)
    assert gpu_report.faults(REPORT | change) == [fault]
    assert f"**wrong:** {fault}" in gpu_report.table(REPORT | change)


def test_the_report_is_written_as_table_and_json_and_its_parts_fail_alone(monkeypatch, tmp_path, capsys):
    values = {"sanitize": "clean", "agreement": [], "run_tests": REPORT["tests"], "kernel_times": [], "batches": {}}
    for part, value in values.items():
        monkeypatch.setattr(gpu_report, part, lambda *_, value=value: value)
    monkeypatch.setattr(gpu_report.benchmark, "measure", lambda device, seconds: {"image": 2.0})
    monkeypatch.setattr(gpu_report, "captured", lambda device: 1 / 0)
    assert gpu_report.main(["cpu"], tmp_path) == 1
    (result,) = json.loads((tmp_path / "report.json").read_text())
    assert result["benchmark"] == {"cpu": {"image": 2.0}}
    assert result["captured"] == {"error": "ZeroDivisionError: division by zero"}
    text = (tmp_path / "report.md").read_text()
    assert "| image | 2.00 |" in text
    assert "3 passed, 0 failed, 1 skipped, 0 not reached" in text
    assert text in capsys.readouterr().out


def test_without_a_gpu_it_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    assert gpu_report.main([], tmp_path) == 1
    assert "--devices cpu" in capsys.readouterr().out


@pytest.mark.slow
def test_only_tests_that_take_a_device_run_and_those_not_reached_are_counted(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTEST_ADDOPTS", "tests/stages/image/test_film.py tests/maths/test_directions.py")  # of all
    tests = gpu_report.run_tests("cpu", 0, tmp_path)
    assert tests["passed"] + len(tests["failed"]) + tests["skipped"] == 1  # the first one ends the time
    assert 5 < tests["not reached"] < 30  # those of films; directions take no device
