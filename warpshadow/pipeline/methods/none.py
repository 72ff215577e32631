"""The method "none": no shadows, in harmonics as by log-SH; light of a shell by its cells."""

import functools

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis
from warpshadow.assets.known_light import KnownLight
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.methods.log_sh import LogSH, ProjectedBands
from warpshadow.pipeline.node import Input
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.shading.found_visibility import HarmonicVisibility
from warpshadow.pipeline.shading.scene_blockers import SceneBlockers
from warpshadow.pipeline.shading.shell_cells import SHELL_BASIS, ShellCells, project_on_shell

_NO_CELLS = np.empty((0, 3))


class NoShadows(LogSH):
    """Light without visibility; no body has spheres."""

    why_no_shadows = "the method is to have no shadows"

    def __init__(self, merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False):
        super().__init__(merged_scene, basis, progress=progress)
        if self.shell is not None:
            self.native_basis, self.basis = SHELL_BASIS, SHELL_BASIS if basis is None else basis
            self.free_basis = self.free_basis_of_shell(self.shell)

    @functools.cached_property
    def scene_blockers(self) -> SceneBlockers:
        """Bodies that block nothing."""
        return SceneBlockers(self.merged_scene, traces_self_visibility=False)

    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> ProjectedBands:
        """The bands that the light has, or its cells of a shell."""
        if shell is None:
            return super().project_light(light)
        shell_cells, radiance = project_on_shell(light, shell)
        return ProjectedBands(0, radiance, shell_cells)

    def free_basis_of_shell(self, shell: wp.array) -> ProjectedBands:
        """The basis of free light of a shell. Differentiable: shell."""
        return ProjectedBands(0, shell_cells=ShellCells(shell))

    def coefficient_count(self, light: Input | None) -> int:
        """Number of coefficients that take part."""
        return super().coefficient_count(light) if self.shell is None else SHELL_BASIS.size

    def find_transfer(self, visibility: HarmonicVisibility, group: Group, projected_light: ProjectedBands) -> wp.array:
        """Transfer vectors, float32 of shape [batch, receiver, coefficient]."""
        if projected_light.shell_cells is None:
            return super().find_transfer(visibility, group, projected_light)
        return projected_light.shell_cells.find_transfer(group.points, group.normals, None, _NO_CELLS)


METHOD = NoShadows
