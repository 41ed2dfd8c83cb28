"""What is compiled ahead is all that a first training and its answers take."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from lipcore import FitOptions, train
from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.model.functionals import kinetic_energy
from lipcore.warm_up import COMPILED, warm_up


def signatures() -> set[tuple[str, str]]:
    """Every compiled function of ours with what it was compiled for."""
    gc.unfreeze()  # a service that ran in this process has frozen what it imported
    # not `isinstance`, which would wake what others load lazily
    dispatchers = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]
    ours = [each for each in dispatchers if each.py_func.__module__.startswith("lipcore.")]
    return {(each.py_func.__qualname__, str(one)) for each in ours for one in each.signatures}


@pytest.mark.parametrize("name", COMPILED)
def test_a_first_training_compiles_nothing_more(name: str) -> None:
    """On a robot of other joints and another number of them."""
    warm_up(name)
    compiled = signatures()
    assert compiled
    rng = np.random.default_rng(0)
    q, dq, ddq, noise = rng.uniform(-1, 1, (4, 90, 3))
    tau = 2 * np.sin(q) + ddq + 0.01 * noise
    samples = Samples(("a", "b", "c"), np.arange(90) / 10, np.zeros(90, np.int64), q, dq, ddq, tau)
    options = FitOptions(hyperparameter_samples=30, posterior_samples=60, max_iterations=4, search_seconds=0.1)
    model = train(samples, ("revolute", "prismatic", "revolute"), name, options)
    model.predict(q, dq, ddq, covariance=True)
    model.evaluator.one(np.ascontiguousarray(np.stack([q[0], dq[0], ddq[0]])))
    energies = [term for term in model.estimator.terms.values() if not hasattr(term, "stribeck")]
    kinetic_energy(model.posterior, energies, Motion.from_arrays(q[:2], dq[:2], ddq[:2]))
    assert signatures() <= compiled


def test_only_what_there_is_can_be_named() -> None:
    with pytest.raises(ValueError, match=r"expected names out of lip, lip-chain, rigid-body, rigid-body\+lip-chain"):
        warm_up("lip", "gpu")
