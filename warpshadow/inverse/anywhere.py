"""Starts of a search for unknown poses: bodies turned any way, where targets differ from images without them."""

from collections.abc import Mapping

import numpy as np
import torch

from warpshadow.inverse.free import Pose
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model

_PIXELS = 4  # whose mean ray a body is on: single ones may be of its shadow, or at its edge
_DEPTH_SPREAD = 0.15  # standard deviation of the logarithm of a body's distance from the eye


def candidates_anywhere(model: Model, values: Mapping[str, Values], count: int, seed: int) -> list[dict[str, Values]]:
    """Draw poses from which to search for bodies whose pose is free; other values stay.

    Rotations are uniform among those that a pose's constraint leaves. The middle of a body is on the mean ray of four
    pixels of the first view, where the plane lets it be that the body stands on, or about as far from the eye as it is.
    A pixel is as probable as the squared difference there between the target and an image without these bodies.

    Args:
        model: Of small images.
        values: Free parameters by name, at the start.
        count: How many.
        seed: Of the random draws.
    """
    poses = model.problem.free_of(Pose)
    generator = np.random.default_rng(seed)
    with torch.no_grad():
        world = model.world(values)
        for pose in poses:
            world.move_out_of_view(pose.number, model.context)
        target, image = model.targets[0], world.images()[0]
        squares = (image[..., : target.shape[-1]] - target).square().sum(dim=-1) * model.weights[0]
    probabilities = squares.double().flatten().numpy(force=True) + 1e-12
    _, directions = model.cameras[0].rays()
    candidates = []
    for number in range(count):
        candidate = {name: {key: t.detach().clone() for key, t in parts.items()} for name, parts in values.items()}
        for pose in poses:
            pixels = generator.choice(len(probabilities), _PIXELS, p=probabilities / probabilities.sum())
            direction = directions.reshape(-1, 3)[pixels].mean(axis=0)
            direction /= np.linalg.norm(direction)
            distance = np.exp(_DEPTH_SPREAD * generator.standard_normal())
            moved = pose.somewhere(values[pose.name], model.context, number, direction, distance, generator)
            candidate[pose.name] = moved
        candidates.append(candidate)
    return candidates
