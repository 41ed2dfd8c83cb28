"""Inverse dynamics of manipulators as physics-informed Gaussian processes."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lipcore.fit_options import FitOptions
    from lipcore.fitting import FitCancelledError, FitProgress
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
_PLACES = {
    "FitCancelledError": "fitting",
    "FitOptions": "fit_options",
    "FitProgress": "fitting",
    "ModelFormatError": "manifest",
    "NotPositiveDefiniteError": "linalg",
    "Samples": "samples",
    "TorqueModel": "model",
    "TorquePrediction": "model",
    "copy_model": "persistence",
    "load": "persistence",
    "save": "persistence",
    "train": "model",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: numerics take seconds to load, which who only names things (clients) does without."""
    if name not in _PLACES:
        raise AttributeError(f"module 'lipcore' has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(f"lipcore.{_PLACES[name]}"), name)
    return found
