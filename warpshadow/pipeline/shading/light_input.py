"""Light as an input of the pipeline: known or free, from infinitely far away or from a shell."""

import warp as wp

from warpshadow.assets.known_light import KnownLight
from warpshadow.pipeline.node import Input


class LightInput(Input):
    """Light as an input: known light, or free coefficients.

    Args:
        value: The light.
        shell: Center and radius of the sphere that sends this light, vec4 of shape [batch]; None for the scene's, if it
            has one.
        why_new: As for :class:`Input`.
    """

    def __init__(self, value: KnownLight | wp.array, shell: Input | None = None, *, why_new: str = ""):
        super().__init__("light", value, why_new=why_new)
        self.shell = shell

    @property
    def is_free(self) -> bool:
        """Whether it is free light, an array, and not known light."""
        return isinstance(self.value(), wp.array)

    @property
    def shell_count(self) -> int:
        """Number of given shells, one or one for each image; 0 for the scene's shell, or none."""
        return 0 if self.shell is None else len(self.shell.value())

    @property
    def visibility_key(self) -> Input | None:
        """The input on which visibility depends besides points and blockers.

        It depends on known light, since cells look to where that comes from. Of free light, whose cells are even, it
        depends on the shell alone.
        """
        return self.shell if self.is_free else self
