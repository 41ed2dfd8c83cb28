"""FIGAROH on the URDF's arm: `pip install figaroh ipython`, version 1.

It is told the URDF and the recording with accelerations. It finds base parameters by QR decomposition: of bodies, rotor
inertias, viscous and Coulomb friction and offsets, by least squares weighted joint by joint. It offers the standard
deviation of base parameters, none of a torque: here a joint's is that of its residual.
"""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.real.peers import Peer
from benchmarks.real.rivals import Forecast, Intervals
from benchmarks.real.splits import thinned
from lipcore.data.samples import Array, Samples
from lipcore.robots.urdf import RigidBody

MAX_ROWS = 500
"""Max training rows; more are thinned evenly, as FIGAROH's weights are a dense matrix of all torques."""
CONFIG = {"has_friction": True, "has_actuator_inertia": True, "has_joint_offset": True, "is_joint_torques": True}


def is_installed() -> bool:
    """Return whether FIGAROH and what its identification imports are installed."""
    return all(find_spec(name) is not None for name in ("figaroh", "numdifftools", "pandas", "IPython"))


def predict_figaroh(body: RigidBody, train: Samples, test: Samples) -> Forecast:
    """Predict torque with base parameters that FIGAROH finds."""
    from figaroh.identification import identification_tools as tools  # noqa: PLC0415 - not a dependency
    from figaroh.tools import qrdecomposition as qr  # noqa: PLC0415 - as above
    from figaroh.tools import regressor  # noqa: PLC0415 - as above

    rows = thinned(train, MAX_ROWS)
    chain, robot = np.argsort(body.order), SimpleNamespace(model=body.model, data=body.model.createData())
    config: dict[str, Any] = CONFIG | {"act_idxv": list(range(body.n_joints))}

    def build(samples: Samples) -> Array:
        motion = (each[:, chain] for each in (samples.q, samples.dq, samples.ddq))
        return np.asarray(regressor.build_regressor_basic(robot, *motion, config))

    full, tau = build(rows), rows.tau[:, chain].T.ravel()  # joint by joint
    names = {f"parameter{number}": 0.0 for number in range(full.shape[1])}
    gone, kept = regressor.get_index_eliminate(full, names)
    reduced = regressor.build_regressor_reduced(full, gone)
    base, _, places = qr.get_baseParams(reduced, kept)
    weights = np.linalg.lstsq(base, tau)[0]
    stops = len(rows) * np.arange(1, body.n_joints + 1)
    weights = tools.weigthed_least_squares(robot, weights, base, tau, base @ weights, {"idx_tau_stop": stops})
    asked = regressor.build_regressor_reduced(build(test), gone)[:, list(places)]
    mean, std = np.empty_like(test.tau), np.empty(body.n_joints)
    mean[:, chain] = (asked @ weights).reshape(body.n_joints, -1).T
    std[chain] = np.sqrt(np.square(tau - base @ weights).reshape(body.n_joints, -1).mean(axis=1))
    spread = tools.relative_stdev(base, weights, tau)
    return Forecast(mean, np.broadcast_to(std, mean.shape), Intervals(len(weights), int(np.sum(~np.isfinite(spread)))))


PEER = Peer(
    needs="URDF, accelerations, joint order; units are those of the URDF",
    friction="viscous, Coulomb",
    parameters="standard deviations of base parameters, which are sums of masses and inertias",
    torque="none",
    code=(predict_figaroh,),
)
