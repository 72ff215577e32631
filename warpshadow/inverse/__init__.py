"""Inverse rendering: explain images by what a scene leaves free.

A :class:`Problem` says what is seen (targets), what is free and what counts as alike (the loss); :func:`fit` descends
to a :class:`Result`, whose scene can be rendered, relit and written. Needs torch.
"""

from warpshadow.inverse.checkpoint import CheckpointError
from warpshadow.inverse.descent import FitWarning, Result, fit, short_adam
from warpshadow.inverse.free import Albedo, CameraPose, Deformation, Exposure, Free, Light, Pose, Radii, Texture
from warpshadow.inverse.loss import Loss
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.report import write_result
from warpshadow.inverse.schedule import Stage, deformation_stages, pose_stages
from warpshadow.inverse.target import Target

__all__ = [
    "Albedo",
    "CameraPose",
    "CheckpointError",
    "Deformation",
    "Exposure",
    "FitWarning",
    "Free",
    "Light",
    "Loss",
    "Pose",
    "Problem",
    "Radii",
    "Result",
    "Stage",
    "Target",
    "Texture",
    "deformation_stages",
    "fit",
    "pose_stages",
    "short_adam",
    "write_result",
]
