"""Adam for spheres: steps of centers, and of the logarithms of radii."""

import numpy as np

RADIUS_RATE = 10.0  # step of the logarithm of a radius for a step of 1 of a center [1 / diagonals of the bounding box]


class Adam:
    """Gradient descent that does not depend on the gradient's scale."""

    def __init__(self, count: int):
        self.mean, self.square, self.age = np.zeros((count, 4)), np.zeros((count, 4)), 0

    def step(self, spheres: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Move spheres [sphere, 4] in place, against the gradient by centers and logarithms of radii."""
        self.age += 1
        self.mean += 0.1 * (gradient - self.mean)
        self.square += 0.01 * (gradient**2 - self.square)
        update = self.mean / (1 - 0.9**self.age) / (np.sqrt(self.square / (1 - 0.99**self.age)) + 1e-12)
        spheres[:, :3] -= rate * update[:, :3]
        spheres[:, 3] *= np.exp(-RADIUS_RATE * rate * update[:, 3])
