"""The torque prior of the drive: friction and gain of each joint, linear in independent coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.arrays import constant, on_diagonal, reordered
from lipcore.kernels.base import LinearKernel, Params, Regressor, State
from lipcore.kernels.combined import PartialKernel
from lipcore.kernels.drive.play import deflections_of
from lipcore.kernels.drive.terms import (
    SHAPE_SPEEDS,
    SIGN_WIDTH,
    STRIBECK_SPEED,
    check_kinds,
    drive_features,
    drive_terms,
)
from lipcore.kernels.fast.drive import drive_queries, drive_query, drive_size, linear_features
from lipcore.kernels.fast.views import Memory
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.newton_euler import rigid_body_torque
from lipcore.vocabulary import DRIVE_KINDS, DriveKind


@dataclass(frozen=True)
class Bodies:
    """The bodies that the kinds `load` and `gain` need."""

    geometry: Geometry
    """Geometry, base to tip."""
    parameters: Array
    """Inertial parameters, (n, 10), base to tip."""
    order: Indices
    """The data's joint at each place of the chain, (n,)."""


@dataclass(frozen=True)
class Elements:
    """The elements that the kind `play` needs."""

    widths: Array
    """Widths, (K, n) rad (m)."""
    acceleration: Array
    """Usual acceleration of the joints, (n,) rad/s² (m/s²)."""


@dataclass(frozen=True)
class Drive:
    """Friction of n joints: its kinds, and what their terms depend on. Raise ValueError if that is missing."""

    n_joints: int
    kinds: tuple[DriveKind, ...] = ()
    """Kinds beyond viscous, Coulomb and offset, in their usual order."""
    bodies: Bodies | None = None
    elements: Elements | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kinds", check_kinds(self.kinds))
        for kind, needs, given in (
            ("load", "bodies", self.bodies),
            ("gain", "bodies", self.bodies),
            ("play", "elements", self.elements),
        ):
            if kind in self.kinds and given is None:
                raise ValueError(f"drive kind {kind!r} needs {needs}")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of a joint's terms, (f,)."""
        return drive_terms(self.kinds)

    @property
    def needs_bodies(self) -> bool:
        """Whether terms depend on the torque that the bodies need."""
        return not {"load", "gain"}.isdisjoint(self.kinds)

    @cached_property
    def regressor(self) -> DriveRegressor:
        """The regressor that computes the terms."""
        return DriveRegressor(self)

    def formula(self, x: Motion, load: Array | None = None) -> Array:
        """Return each joint's terms at N queries, (f, N, n), in the array API. The arrays of x are of any library.

        load: (N, n) N·m (N), the torque that the bodies need, if it is known already.
        """
        known = None
        if self.needs_bodies and load is None:
            assert self.bodies is not None
            geometry, order = self.bodies.geometry, self.bodies.order
            chain = rigid_body_torque(geometry, self.bodies.parameters, State.paired(x).ordered(order))
            load = reordered(chain, np.argsort(order)).T
        if "play" in self.kinds:
            assert self.elements is not None
            widths = self.elements.widths
            known = deflections_of(x, widths, self.elements.acceleration)[:, : len(widths)]
        return drive_features(x.dq, self.kinds, x.q, load, known)

    def by_joint(self, motions: Array) -> Array:
        """Return each joint's terms, (N, n, f). motions: as of `Motion.arrays`."""
        return self.regressor.linear(motions)[:, :, 1:]

    def features(self, motions: Array) -> Array:
        """Return the features P of N motions, joint by joint, (N, n, f n) (section 5 of docs/method.md)."""
        return self.regressor.features(motions)


class DriveKernel(LinearKernel):
    """Friction and gain tau_i = Σ_k f_ik φ_k with the terms φ of `lipcore.kernels.drive.terms`.

    The load τ is the torque that the bodies need, `newton_euler.rigid_body_torque`: a function of the query, not of
    the weights.

    Weights: (f n,), joint by joint; `drive.terms` contains the names of a joint's f. Hyperparameter:
    `friction.log_std` (n, f).
    """

    def __init__(self, drive: Drive) -> None:
        self.n_joints, self.drive = drive.n_joints, drive

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (f n, n, N), see `LinearKernel.formula`."""
        xp, terms = array_namespace(x.dq), self.drive.formula(x)
        of_joints = on_diagonal(xp.permute_dims(terms, (2, 0, 1)))
        return xp.permute_dims(of_joints, (1, 2, 0, 3)).reshape(-1, self.n_joints, x.q.shape[0])

    def weighted(self, weights: Array, x: Motion) -> Array:
        """Return Φ w of N queries, (n, N), without the features; see `LinearKernel.weighted`."""
        terms = self.drive.formula(x)
        return (terms * constant(weights.reshape(self.n_joints, -1).T[:, None], terms)).sum(0).T

    def regressor(self) -> Regressor:
        """Return the regressor that computes the terms of single queries."""
        return self.drive.regressor

    def of_joint(self, joint: int) -> NDArray[np.int64]:
        """Return the places of a joint's weights."""
        count = len(self.drive.terms)
        return joint * count + np.arange(count)

    def friction(self) -> PartialKernel:
        """Return the part that is friction."""
        return PartialKernel(self, ~self.gains)

    def gain(self) -> PartialKernel:
        """Return the part by which torque reads too high or too low."""
        return PartialKernel(self, self.gains)

    @property
    def gains(self) -> NDArray[np.bool_]:
        """Mask of the weights of the gain, (f n,)."""
        return np.tile([term == "gain" for term in self.drive.terms], self.n_joints)

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (f n,)."""
        log_std = params["friction.log_std"]
        return array_namespace(log_std).exp(2 * log_std).reshape(-1)

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Return the derivatives by the logarithms of the standard deviations, given those by the variances, (f n,)."""
        log_std = params["friction.log_std"]
        return {"friction.log_std": 2 * np.exp(2 * log_std) * slopes.reshape(log_std.shape)}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start every term with a tenth of each joint's torque at the term's usual size: log std (n, f)."""
        usual = 0.1 * np.sqrt(np.square(tau).mean(0)).clip(1e-6)
        size = np.sqrt(np.square(self.drive.by_joint(motion.arrays())).mean(axis=0)).clip(1e-3)  # (n, f)
        size[:, 1:3] = 1.0  # the sign and the offset, whatever the motion
        return {"friction.log_std": np.log(usual[:, None] / size)}


class DriveRegressor(Regressor):
    """Terms of a drive for single queries, compiled."""

    def __init__(self, drive: Drive) -> None:
        self.n_joints = n = drive.n_joints
        self._terms = len(drive.terms)
        self.size = self._terms * n
        bodies, elements = drive.bodies if drive.needs_bodies else None, drive.elements
        self._order = np.arange(n) if bodies is None else bodies.order.astype(np.int64)
        self._kinds = np.array([int(kind in drive.kinds) for kind in DRIVE_KINDS])
        self._constants = np.array([SIGN_WIDTH, STRIBECK_SPEED, *SHAPE_SPEEDS])
        self._elements = np.zeros((1, n))
        if elements is not None:
            self._elements = np.concatenate([elements.widths, elements.acceleration[None]])
        fixed = () if bodies is None else (bodies.geometry.constants, bodies.geometry.gravity, bodies.parameters)
        self._memory = Memory(fixed, n if bodies is None else drive_size(n))

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (f n, n)."""
        drive_query(self._memory.flat, self._order, self._kinds, self._constants, self._elements, motion, out)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        drive_queries(
            self._memory.flat,
            self._order,
            self._kinds,
            self._constants,
            self._elements,
            motions,
            out,
            first,
            first + self.size,
        )

    def linear(self, motions: Array) -> Array:
        """Return ddq and each joint's terms at N queries, (N, n, 1 + f). motions: as of `Motion.arrays`."""
        out = np.empty((len(motions), self.n_joints, 1 + self._terms))
        linear_features(self._memory.flat, self._order, self._kinds, self._constants, self._elements, motions, out)
        return out
