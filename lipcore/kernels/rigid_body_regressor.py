"""The rigid body's features of one query, straight from Pinocchio."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.regressor import Array, Regressor
from lipcore.robots import pinocchio
from lipcore.urdf import PARAMETERS


class _Workspace(threading.local):
    """One thread's Pinocchio data, and memory for a configuration, velocity and acceleration."""

    def __init__(self, model: Any) -> None:
        self.data = model.createData()
        self.configuration = np.zeros(model.nq)
        self.velocity, self.acceleration = np.zeros(model.nv), np.zeros(model.nv)


class RigidBodyRegressor(Regressor):
    """Joint-torque regressor, rows and bodies in the order of the data's joints.

    model: Pinocchio's; order: (n,), the place in the chain of each of the data's joints.
    """

    def __init__(self, model: Any, order: NDArray[np.int64]) -> None:
        self.n_joints, self.size = len(order), len(order) * PARAMETERS
        self._model, self._workspace = model, _Workspace(model)
        self._compute = pinocchio().computeJointTorqueRegressor
        self._chain = np.argsort(order)  # the data's joint at each place of the chain
        joints = [model.joints[index] for index in range(1, model.njoints)]
        self._first = np.array([joint.idx_q for joint in joints])
        # joints without limits take (cos, sin) for their angle
        self._unbounded = [(joint.idx_q, self._chain[k]) for k, joint in enumerate(joints) if joint.nq == 2]
        bodies = (order[:, None] * PARAMETERS + np.arange(PARAMETERS)).reshape(-1)
        self._elements = order[None, :] * self.size + bodies[:, None]  # of the flat regressor, at those of Φᵀ

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (10 n, n)."""
        work = self._workspace
        work.configuration[self._first] = motion[0][self._chain]
        for at, joint in self._unbounded:
            work.configuration[at : at + 2] = math.cos(motion[0, joint]), math.sin(motion[0, joint])
        work.velocity[:] = motion[1][self._chain]
        work.acceleration[:] = motion[2][self._chain]
        regressor = self._compute(self._model, work.data, work.configuration, work.velocity, work.acceleration)
        regressor.take(self._elements, out=out, mode="clip")  # never clips, but spares NumPy a buffer
