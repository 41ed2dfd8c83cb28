"""Inverse dynamics of manipulators as physics-informed Gaussian processes."""

from lipcore.fitting import FitCancelledError, FitOptions, FitProgress
from lipcore.linalg import NotPositiveDefiniteError
from lipcore.manifest import ModelFormatError
from lipcore.model import TorqueModel, TorquePrediction, train
from lipcore.persistence import copy_model, load, save
from lipcore.samples import Samples

__all__ = [
    "FitCancelledError",
    "FitOptions",
    "FitProgress",
    "ModelFormatError",
    "NotPositiveDefiniteError",
    "Samples",
    "TorqueModel",
    "TorquePrediction",
    "copy_model",
    "load",
    "save",
    "train",
]
