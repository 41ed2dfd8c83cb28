"""Inverse dynamics of manipulators as physics-informed Gaussian processes: the method of docs/method.md.

The floors, from the top; what stands higher imports what stands lower, never the other way (import-linter, in
pyproject.toml, checks it):

    warm_up                                 above all: trains one of each, so that all is compiled
    training, export, online, excitation    on one floor; none of them knows another:
        training     samples in, a model out; `auto` chooses the estimator
        export       a model that leaves: URDF, C
        online       learning from a live stream: gates, records, changes, payloads, what is learnt and taken back
        excitation   the motion that tells a model most
    files        a model on disk: manifest, tensors, checked when read
    arm          the rigid arm learnt from torque alone: geometry, masses, friction (sections 6 and 7)
    model        a trained model: torque, dynamics, energies, parameters, warnings (section 9)
    estimators   what an estimator is made of: prior, hyperparameters, noise, options, what a training is given
    posterior    exact and compact posteriors, what answers queries, sums over samples, linear algebra (section 8)
    kernels      the torque priors as formulas, and their compiled loops in `fast` (sections 2 to 5)
    profiles     robots by name: limits, and what their effort field means
    preparation  from recordings to samples: filters, rates, derivatives
    robots       URDFs, Pinocchio models, simulated recordings
    data         samples of motion and torque, splits, metrics
    extras       what may be missing is imported there; on the floor of vocabulary
    vocabulary   the names that things go by
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
    from lipcore.model.torque_model import TorqueModel, TorquePrediction
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
    "TorquePrediction": "model.torque_model",
    "copy_model": "files.persistence",
    "load": "files.persistence",
    "save": "files.persistence",
    "train": "training.train",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: numerics take seconds to load, which who only names things (clients) does without."""
    if name not in _PLACES:
        raise AttributeError(f"module 'lipcore' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"lipcore.{_PLACES[name]}"), name)
    return value
