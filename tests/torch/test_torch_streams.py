"""Streams of torch: what Warp launches on them, waits for, and hands over. Nothing here needs a GPU."""

from types import SimpleNamespace

import pytest
import torch
import warp as wp

from warpshadow.torch import autograd


@pytest.mark.parametrize("captures", [False, True])
def test_warps_stream_waits_for_torchs_before_it_frees_what_was_used(captures, monkeypatch):
    """While torch captures, its stream must wait for no other and no other for it."""
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: "torch's stream")
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: captures)
    monkeypatch.setattr(wp, "stream_from_torch", lambda stream: SimpleNamespace(device="cpu", of=stream))
    scope = autograd.current_stream(torch.device("cuda"))
    assert scope.stream.of == "torch's stream"
    assert scope.sync_enter == scope.sync_exit == (not captures)


@pytest.mark.parametrize("is_on_side_stream", [False, True])
def test_a_result_on_a_side_stream_is_torchs_own_memory(is_on_side_stream, monkeypatch):
    monkeypatch.setattr(autograd, "_is_on_side_stream", lambda device: is_on_side_stream)
    results = []

    def double(values):
        result = wp.empty_like(values, requires_grad=values.requires_grad)
        wp.launch(_double, values.size, inputs=[values], outputs=[result])
        results.append(result)
        return result

    values = torch.arange(3.0).requires_grad_()
    doubled = autograd.apply(double, values, dtypes=[wp.float32])
    assert doubled.tolist() == [0, 2, 4]
    assert (doubled.data_ptr() != results[0].ptr) == is_on_side_stream
    doubled.sum().backward()
    assert values.grad.tolist() == [2, 2, 2]


def test_only_streams_beside_the_default_one_are_side_streams(monkeypatch):
    assert not autograd._is_on_side_stream(torch.device("cpu"))
    monkeypatch.setattr(torch.cuda, "default_stream", lambda device: "default")
    for stream in ("default", "other"):
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device, stream=stream: stream)
        assert autograd._is_on_side_stream(torch.device("cuda")) == (stream == "other")


@wp.kernel
def _double(
    # in
    values: wp.array(dtype=float),
    # out
    doubled: wp.array(dtype=float),
):
    """A thread owns a number."""
    thread = wp.tid()
    doubled[thread] = 2.0 * values[thread]
