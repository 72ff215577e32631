"""Inverse rendering: fit the free parameters of a scene to images.

A :class:`Problem` has targets, free parameters and a loss; :func:`fit` descends to a :class:`Result`, whose scene can
be rendered, relit and written. Needs torch.
"""

from warpshadow.inverse.checkpoint import CheckpointError
from warpshadow.inverse.descent import FitWarning, default_optimizer, fit, short_adam
from warpshadow.inverse.diagnostics import DiagnosticWarning
from warpshadow.inverse.fit_file import Fit, FitFileError, load_fit
from warpshadow.inverse.found_light import FoundLight
from warpshadow.inverse.free import (
    Albedo,
    CameraPose,
    Deformation,
    Emission,
    Exposure,
    Free,
    Lamp,
    Light,
    Metallic,
    OutlineOffset,
    Plane,
    Pose,
    Radii,
    Roughness,
    Shell,
    Sun,
    Texture,
)
from warpshadow.inverse.loss import Loss
from warpshadow.inverse.many import Ending, find_fits, fit_many
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.quasi_newton import QuasiNewton
from warpshadow.inverse.report import write_result
from warpshadow.inverse.result import Result
from warpshadow.inverse.schedule import Stage, deformation_stages, photograph_stages, pose_stages, unknown_pose_stages
from warpshadow.inverse.target import Target
from warpshadow.inverse.uncertainty import PoseUncertainty, Uncertainty
from warpshadow.viewer import FitViewer

__all__ = [
    "Albedo",
    "CameraPose",
    "CheckpointError",
    "Deformation",
    "DiagnosticWarning",
    "Emission",
    "Ending",
    "Exposure",
    "Fit",
    "FitFileError",
    "FitViewer",
    "FitWarning",
    "FoundLight",
    "Free",
    "Lamp",
    "Light",
    "Loss",
    "Metallic",
    "OutlineOffset",
    "Plane",
    "Pose",
    "PoseUncertainty",
    "Problem",
    "QuasiNewton",
    "Radii",
    "Result",
    "Roughness",
    "Shell",
    "Stage",
    "Sun",
    "Target",
    "Texture",
    "Uncertainty",
    "default_optimizer",
    "deformation_stages",
    "find_fits",
    "fit",
    "fit_many",
    "load_fit",
    "photograph_stages",
    "pose_stages",
    "short_adam",
    "unknown_pose_stages",
    "write_result",
]
