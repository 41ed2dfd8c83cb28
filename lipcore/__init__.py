"""Inverse dynamics of manipulators as physics-informed Gaussian processes: the method of docs/method.md.

The layers, from the top. A module imports lower layers only; import-linter checks this (pyproject.toml):

    warm_up                                 the top: trains one model of each kind to compile all code
    training, export, online, excitation    one layer; none of them imports another:
        training     from samples to a model; `auto` chooses the estimator
        export       a model as URDF and as C
        online       learning from a live stream: gates, records, changes, payloads, undo
        excitation   the motion with the most information for a model
    files        a model on disk: manifest, tensors, checks on reading
    arm          the rigid arm learnt from torque alone: geometry, masses, friction (sections 6 and 7)
    model        a trained model: torque, dynamics, energies, parameters, warnings (section 9)
    estimators   parts of an estimator: prior, hyperparameters, noise, options, the task of a training
    posterior    exact and compact posteriors, prediction, sums over samples, linear algebra (section 8)
    kernels      the torque priors as formulas, and their compiled loops in `fast` (sections 2 to 5)
    profiles     robots by name: limits, and the meaning of their effort field
    preparation  from recordings to samples: filters, rates, derivatives
    robots       URDFs, Pinocchio models, simulated recordings
    data         samples of motion and torque, splits, metrics
    extras       imports of optional dependencies; in the layer of vocabulary
    vocabulary   the names of estimators, joint types and conventions
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lipcore.data.samples import Samples
    from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress
    from lipcore.estimators.options import FitOptions
    from lipcore.files.manifest import ModelFormatError
    from lipcore.files.persistence import copy_model, load, save
    from lipcore.model.prediction import TorquePrediction
    from lipcore.model.torque_model import TorqueModel
    from lipcore.posterior.linalg import NotPositiveDefiniteError
    from lipcore.training.train import train

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
    "FitCancelledError": "estimators.hyperparameters",
    "FitOptions": "estimators.options",
    "FitProgress": "estimators.hyperparameters",
    "ModelFormatError": "files.manifest",
    "NotPositiveDefiniteError": "posterior.linalg",
    "Samples": "data.samples",
    "TorqueModel": "model.torque_model",
    "TorquePrediction": "model.prediction",
    "copy_model": "files.persistence",
    "load": "files.persistence",
    "save": "files.persistence",
    "train": "training.train",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is used: numerics take seconds to load, and clients that only need names do without."""
    if name not in _PLACES:
        raise AttributeError(f"module 'lipcore' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"lipcore.{_PLACES[name]}"), name)
    return value
