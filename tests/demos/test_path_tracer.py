"""The path tracer against golden images, which demos/benchmarks/path_tracer.py --golden made by Mitsuba 3.9.1."""

from dataclasses import replace

import numpy as np

import warpshadow as ws
from demos.benchmarks.path_tracer import corner_scene


def test_paths_bring_what_mitsuba_found(golden_data):
    """A ball in a corner under a sky with a sun; Mitsuba's noise is 0.4%, ours some 3%, in common directions of light.

    Of what bounced there is a quarter.
    """
    golden = np.load(golden_data / "golden_paths.npz")
    scene = replace(corner_scene(), visibility=ws.Visibility(method="ray-traced", samples=4096))
    images = {bounces: ws.render(replace(scene, bounces=bounces)) for bounces in (0, 3)}
    covered = images[0][..., 3] == 1
    found = {bounces: image[covered, :3] for bounces, image in images.items()}
    truth = {bounces: golden[f"bounces_{bounces}"][covered] for bounces in (0, 3)}
    for bounces, colors in found.items():
        assert np.linalg.norm(colors - truth[bounces]) < 0.05 * np.linalg.norm(truth[bounces])
    ours, theirs = ((each[3] - each[0]).mean(axis=0) for each in (found, truth))
    assert (theirs > 0.1 * truth[0].mean(axis=0)).all()
    np.testing.assert_allclose(ours, theirs, rtol=0.02)
