"""Patches that flat bodies cover: against float64 NumPy, and differences of it."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.bounces.overlays import overlaid_radiosity
from warpshadow.stages.sparse import SparseMatrix

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

BEFORE = np.array([[0, 0, 0.3, 0.7], [0, 0, 1.0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
DISTANCES = np.float32([0.5, 1.0, 0, 0])
CENTERS = np.array([[0.1, -0.4, 0.2], [0.5, -0.9, 0.6], [0.2, 0.3, 0.1], [0.0, 0.2, 0.3]])
STEP = 1e-6


def twin(radiosity, centers):
    gaps = np.linalg.norm(centers - BEFORE @ centers, axis=1)
    u = np.clip(2 - gaps / np.where(DISTANCES > 0, DISTANCES, 1), 0, 1)
    parts = np.where(DISTANCES > 0, u * u * (3 - 2 * u), 0)[:, None]
    return radiosity + parts * (BEFORE @ radiosity - radiosity)


def test_what_covered_patches_send_and_its_gradient_are_those_of_the_twin(device):
    rng = np.random.default_rng(0)
    values = [rng.random((4, 3)), CENTERS]
    put = {"dtype": wp.vec3, "device": device, "requires_grad": True}
    arrays = [wp.array(each[None], **put) for each in values]
    before = SparseMatrix.from_matrix(BEFORE, device=device)
    with wp.Tape() as tape:
        sent = overlaid_radiosity(*arrays, before, DISTANCES)
    expected = twin(*values)
    np.testing.assert_allclose(sent.numpy()[0], expected, atol=1e-6)
    assert np.abs(expected - values[0])[:2].max(axis=1).min() > 0.1  # both are covered, at least in part
    weights = rng.normal(size=(4, 3))
    sent.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    for number, array in enumerate(arrays):
        wanted = np.zeros((4, 3))
        for index in np.ndindex(4, 3):
            ends = []
            for step in (STEP, -STEP):
                moved = [each.copy() for each in values]
                moved[number][index] += step
                ends.append(np.sum(weights * twin(*moved)))
            wanted[index] = (ends[0] - ends[1]) / (2 * STEP)
        assert np.linalg.norm(array.grad.numpy()[0] - wanted) < 1e-5 * np.linalg.norm(wanted)
