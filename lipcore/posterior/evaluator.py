"""The compiled evaluator of a compact posterior. Once built, it needs only NumPy and Numba (baselines: PyTorch)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.kernels.base import LinearKernel, PairKernel, Params
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.answer import (
    COVARIANCE,
    MEAN,
    MISFIT_ROWS,
    ROWS,
    STD,
    WIDTH,
    answer,
    answer_one,
    pack,
    pack_joints,
)
from lipcore.kernels.fast.play import POSITIONS
from lipcore.kernels.mixture import MixtureKernel
from lipcore.kernels.payload import PayloadKernel
from lipcore.kernels.residual import ResidualKernel
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.threads import run_parts

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

QUERIES = 16
"""Queries computed together. Each panel of the root is then read once for many queries, and they still fit the
cache."""


class _Scratch(threading.local):
    """One thread's memory for a number of queries. It is created at the thread's first query."""

    def __init__(self, queries: int, samples: int, anchors: int, linear: int, n: int) -> None:
        groups = -(-n // WIDTH)
        self.motions = np.zeros((queries, POSITIONS, n))
        self.deflected = np.zeros((queries, POSITIONS + 2 * len(ELEMENTS), n))
        self.blocks = np.zeros((queries, samples + 1, n, n))
        self.features = np.zeros((queries, linear, n))
        self.still = np.zeros((queries, POSITIONS, n))
        self.gravity = np.zeros((queries, linear, n))
        self.memory = np.zeros(groups * WIDTH * (queries * anchors + ROWS))
        self.std = np.zeros((queries, n))
        self.covariance = np.zeros((queries, n, n))
        self.share = np.zeros((queries, n))
        self.prior = np.zeros((2, queries, n))
        self.of_one = (
            self.motions,
            self.deflected,
            self.blocks,
            self.features,
            self.prior,
            self.covariance,
            self.memory,
            self.std,
            self.share,
        )


class _GravityTerm(NamedTuple):
    """A linear term with gravity: places of its features with gravity, all of its features, and what fills them."""

    places: slice | Indices
    first: int
    last: int
    fill: Callable[[Array, Array], None]
    fill_many: Callable[[Array, Array, int], None]


class Evaluator:
    """Posterior torques of a robot with n joints from M = m + P anchors: m inducing outputs, then all linear weights.

    g(x) is the covariance of the anchors with the torques at x, (M, n). The mean is E f(x) + gᵀ weights. The covariance
    is std_factor² (k₁(x, x) − (Q₁ g)ᵀ (Q₁ g) + (Q₂ g)ᵀ (Q₂ g)), with k₁ of the nonlinear term and Q₁ the first m rows
    of Q. The misfit is added to its diagonal, which is then raised to at least `floor`.

    term: the kernel's nonlinear term, None if it has none. params: hyperparameters of all terms. inducing: S samples,
    None without `term`. outputs: (m,), the chosen torques, as sample · n + joint. linear: the linear terms in the order
    of the anchors. weights: (M,). root: Q, (M, M) lower triangular. std_factor: calibration. floor: (n,) (N·m)²;
    misfit: see `Misfit.packed`; None for no floor or misfit. usual: mean and variance of the torque in
    training, (n,) each, if predictions may fall back; stood: joints that stood still there, (n,).

    Without a nonlinear term, torques and standard deviations are computed joint by joint, each from the weights that it
    depends on; covariances need them all. The prior mean of a residual among the linear terms is added to the mean, the
    variance beyond its features to the misfit.

    `one` and `many` return the mean of the posterior, which learning and external torque need. They also return the
    share of the fallback in the torque to send, which `fall_back` computes.

    The evaluator is thread-safe: each thread has its own memory. `many` computes without the GIL, in parallel with
    other threads. `one` keeps the GIL, except for a nonlinear term. Raise ValueError with the name of an argument that
    does not match.
    """

    def __init__(
        self,
        term: PairKernel | None,
        params: Params,
        inducing: Motion | None,
        outputs: Indices,
        linear: Sequence[LinearKernel],
        weights: Array,
        root: Array,
        std_factor: float = 1.0,
        floor: Array | None = None,
        misfit: Array | None = None,
        usual: tuple[Array, Array] | None = None,
        stood: NDArray[np.bool_] | None = None,
    ) -> None:
        if (term is None) != (inducing is None):
            raise ValueError("expected both term and inducing, or neither")
        if term is None and not linear:
            raise ValueError("term is None and linear is empty, expected at least one term")
        self.n_joints = n = linear[0].n_joints if term is None else term.n_joints
        self._cross = None if term is None or inducing is None else term.cross(params, inducing)
        samples = 0 if self._cross is None else self._cross.size
        self._outputs = np.array(outputs, dtype=np.int64)
        means, variances = _linear_prior(linear, params)
        _check(self._outputs, samples * n, weights, root, len(means))
        self._fills, self._fills_many, self._residual = [], [], None
        self._payload = slice(0, 0)
        self._gravity: list[_GravityTerm] = []
        first = 0
        for kernel in linear:
            regressor = kernel.regressor()
            last = first + regressor.size
            if isinstance(kernel, ResidualKernel):
                self._residual = first, kernel
            else:
                self._fills.append((first, last, regressor.fill))
                self._fills_many.append((first, regressor.fill_many, isinstance(kernel, DriveKernel | PayloadKernel)))
            if isinstance(kernel, PayloadKernel):
                self._payload = slice(first, last)
            if (places := _gravity_places(kernel, first, last)) is not None:
                self._gravity.append(_GravityTerm(places, first, last, regressor.fill, regressor.fill_many))
            first = last
        if self._residual is not None and term is not None:
            raise ValueError("linear has a residual beside a nonlinear term, expected one of them")
        parts = _of_joints(linear) if term is None else []
        self._counts = np.array([len(each) for each in parts], np.int64)
        self._places = np.zeros((len(parts), self._counts.max(initial=0)), np.int64)
        for row, each in zip(self._places, parts, strict=True):
            row[: len(each)] = each
        self._fixed = _lay_out(weights, root, means, variances, parts)
        self._std_factor = float(std_factor)
        self._floor = np.zeros(n) if floor is None else np.array(floor, np.float64)
        if self._floor.shape != (n,):
            raise ValueError(f"floor has shape {self._floor.shape}, expected ({n},)")
        self._misfit = Misfit.none(n).packed() if misfit is None else np.array(misfit, np.float64)
        rows = MISFIT_ROWS, MISFIT_ROWS + 2 * len(ELEMENTS)
        if self._misfit.shape not in [(count, n) for count in rows]:
            raise ValueError(f"misfit has shape {self._misfit.shape}, expected ({rows[0]} or {rows[1]}, {n})")
        self._falls_back = usual is not None
        self._usual_mean: Array = np.zeros(n) if usual is None else usual[0]
        self._usual: Array = np.full(n, np.inf) if usual is None else usual[1]
        self._stood = np.zeros(n, np.bool_) if stood is None else stood
        sizes = samples, len(self._outputs) + len(means), len(means), n
        self._one, self._many = _Scratch(1, *sizes), _Scratch(QUERIES, *sizes)

    @property
    def packed(self) -> Array:
        """The part that depends on weights and root, laid out for compiled code; argument of `revised`."""
        return self._fixed

    def revised(self, packed: Array, floor: Array, falls_back: bool = True) -> Evaluator:
        """Return an evaluator with other weights, root and floor, from `packed` of an evaluator with the same anchors.

        falls_back: whether its predictions may fall back, if those of this one may. Compiled code and the memory of
        threads are shared with this one: a prediction uses one of the two at a time.
        """
        if packed.shape != self._fixed.shape or floor.shape != self._floor.shape:
            raise ValueError(f"packed has shape {packed.shape}, expected {self._fixed.shape}")
        other = copy(self)
        other._fixed, other._floor = packed, floor
        if not falls_back:
            other._falls_back, other._usual = False, np.full_like(self._usual, np.inf)
        return other

    def fast(self) -> Evaluator:
        """Return the evaluator with fewer centres of a residual, see `ResidualKernel.fast`; this one without any."""
        if self._residual is None:
            return self
        other, (first, kernel) = copy(self), self._residual
        other._residual = first, kernel.fast
        return other

    @property
    def separates_gravity(self) -> bool:
        """Whether it computes torques without gravity: it has no nonlinear term."""
        return self._cross is None

    def one(
        self, motion: Array, std: bool = True, covariance: Array | None = None, reduced: Array | None = None
    ) -> tuple[Array, Array | None, Array | None]:
        """Return the torque, (n,), at one query, and its standard deviation, (n,), if `std`.

        motion: q, dq and ddq, (3, n), then the deflections if they are known, see `Motion.arrays`.

        Third, return the share of the fallback, (n,), or None if it is zero for all joints. covariance: (1, n, n),
        receives the covariance between the joints if given, with std. reduced: (2, n), receives the torque without
        gravity and its standard deviation, see `without_gravity`. Neither shape nor finiteness is checked. The numbers
        are those of `many`, to the last bit.
        """
        scratch, what = self._one, STD if std or self._falls_back else MEAN
        # slicing would cost as much as the arithmetic
        query, deflected, blocks, features, prior, work, memory, own, share = scratch.of_one
        if covariance is not None:
            work, what = covariance, COVARIANCE
        if len(motion) > POSITIONS:
            query = deflected
        query[0] = motion
        if self._cross is not None:
            self._cross.fill_many(query, blocks)
        if self._residual is not None:
            self._residual[1].fill_all(query, features, self._residual[0], prior[0], prior[1])
        for first, last, fill in self._fills:
            fill(query[0], features[0, first:last])
        tau = np.empty((1, self.n_joints))
        deviation = np.empty((1, self.n_joints)) if std else own
        doubtful = answer_one(
            self._fixed,
            self._outputs,
            self._places,
            self._counts,
            blocks,
            features,
            prior[1],
            self._std_factor,
            self._floor,
            self._misfit,
            SIGN_WIDTH,
            self._usual,
            query,
            what,
            memory,
            tau,
            deviation,
            work,
            share,
        )
        if self._residual is not None:
            tau += prior[0]
        fallback = share[0].copy() if doubtful else None
        if reduced is not None:
            scratch.still[0, 0] = motion[0]
            for each in self._gravity:
                each.fill(scratch.still[0], scratch.gravity[0, each.first : each.last])
                features[0, each.places] -= scratch.gravity[0, each.places]
            answer_one(
                self._fixed,
                self._outputs,
                self._places,
                self._counts,
                blocks,
                features,
                prior[1],
                self._std_factor,
                self._floor,
                self._misfit,
                SIGN_WIDTH,
                self._usual,
                query,
                STD,
                memory,
                reduced[:1],
                reduced[1:],
                scratch.covariance,
                share,
            )
            if self._residual is not None:
                reduced[0] += prior[0, 0]
        return tau[0], deviation[0] if std else None, fallback

    def many(
        self, q: Array, dq: Array, ddq: Array, covariance: bool = False, deflections: Array | None = None
    ) -> tuple[Array, Array, Array | None, Array | None]:
        """Return torques (N, n), their standard deviations (N, n) and, if requested, covariances (N, n, n).

        Fourth, return the shares of the fallback, (N, n), or None if all are zero. q, dq, ddq: (N, n); deflections: as
        in `Motion`; neither shapes nor finiteness are checked. Large batches use all processors.
        """
        size, n = q.shape
        tau, std, share = np.empty((size, n)), np.empty((size, n)), np.empty((size, n))
        covariances = np.empty((size, n, n)) if covariance else None
        doubtful = list[bool]()

        def answer_part(part: slice) -> None:
            scratch, doubtful_part = self._many, False
            for start in range(part.start, part.stop, QUERIES):
                rows = slice(start, min(start + QUERIES, part.stop))
                count = rows.stop - start
                motions = (scratch.motions if deflections is None else scratch.deflected)[:count]
                for place, values in enumerate((q, dq, ddq)):
                    motions[:, place] = values[rows]
                if deflections is not None:
                    motions[:, POSITIONS:] = deflections[rows]
                work = scratch.covariance[:count] if covariances is None else covariances[rows]
                what = STD if covariances is None else COVARIANCE
                doubtful_part |= self._answer(scratch, motions, motions, what, tau[rows], std[rows], work, share[rows])
            doubtful.append(doubtful_part)

        run_parts(size, answer_part)
        return tau, std, covariances, share if any(doubtful) else None

    def without_gravity(self, motions: Array) -> tuple[Array, Array]:
        """Return the torques minus gravity at N queries, and the standard deviations of the differences, (N, n) each.

        Gravity is the torque of bodies and payload at rest in the same posture, with their gains. The features of a
        difference are the difference of the features. Misfit and variance beyond a residual count in full: their share
        in gravity is unknown. Only without a nonlinear term. motions: as of `Motion.arrays`.
        """
        scratch, (size, _, n) = self._many, motions.shape
        tau, std = np.empty((size, n)), np.empty((size, n))
        for start in range(0, size, QUERIES):
            moving = np.ascontiguousarray(motions[start : start + QUERIES])
            rows, count = slice(start, start + len(moving)), len(moving)
            still = scratch.still[:count]
            still[:, 0] = moving[:, 0]
            outputs = STD, tau[rows], std[rows], scratch.covariance[:count], scratch.share[:count]
            self._answer(scratch, moving, moving, *outputs, still)
        return tau, std

    def fall_back(self, motions: Array, tau: Array, share: Array) -> Array:
        """Return the torques to send at N queries, given tau and share of `many`, (N, n) each (eq. 26).

        They are (1 − share) tau + share h, with the fallback h = (1 − share_s) s + share_s r. s is the posterior mean
        at rest in the same posture, but with friction and payload in motion, and share_s its own share. r = t + p, the
        mean torque in training and that of the payload. For joints that stood still in training, which shows no
        friction, r = (1 − share_g) g + share_g (t + p) with g at rest. motions: as of `Motion.arrays`.
        """
        scratch, harmless = self._many, np.empty_like(tau)
        slopes = self._slopes[self._payload]
        for start in range(0, len(tau), QUERIES):
            moving = np.ascontiguousarray(motions[start : start + QUERIES])
            rows, count = slice(start, start + len(moving)), len(moving)
            still = scratch.motions[:count]
            still[:, 0], still[:, 1:] = moving[:, 0], 0.0
            static, own = harmless[rows], scratch.share[:count]
            outputs = STD, static, scratch.std[:count], scratch.covariance[:count], own
            gravity, without = np.zeros_like(static), np.ones_like(static)
            if self._stood.any():
                self._answer(scratch, still, still, *outputs)
                gravity[:, self._stood], without[:, self._stood] = static[:, self._stood], own[:, self._stood]
            self._answer(scratch, still, moving, *outputs)
            payload = np.einsum("p,kpj->kj", slopes, scratch.features[:count, self._payload])
            rest = (1.0 - without) * gravity + without * (self._usual_mean + payload)
            static[:] = (1.0 - own) * static + own * rest
        return np.asarray((1.0 - share) * tau + share * harmless)

    def warm_up(self) -> None:
        """Compile all code that a prediction needs, or load it from Numba's cache."""
        zeros = np.zeros((1, self.n_joints))
        self.many(zeros, zeros, zeros, covariance=True)
        self.one(np.zeros((3, self.n_joints)))

    @property
    def _slopes(self) -> Array:
        """Factors of the linear terms' features in the mean, (P,)."""
        size = len(self._outputs) + self._one.features.shape[1]
        return self._fixed[: ROWS * size : ROWS][len(self._outputs) :]

    def _answer(
        self,
        scratch: _Scratch,
        motions: Array,
        moving: Array,
        what: int,
        tau: Array,
        std: Array,
        covariance: Array,
        share: Array,
        still: Array | None = None,
    ) -> bool:
        """Compute N queries. moving: their motion for friction and payload; still: motion to subtract gravity of."""
        count = len(motions)
        blocks, features, prior = scratch.blocks[:count], scratch.features[:count], scratch.prior[:, :count]
        if self._cross is not None:
            self._cross.fill_many(motions, blocks)
        if self._residual is not None:
            self._residual[1].fill_all(motions, features, self._residual[0], prior[0], prior[1])
        for first, fill_many, moves in self._fills_many:
            fill_many(moving if moves else motions, features, first)
        if still is not None:
            for each in self._gravity:
                each.fill_many(still, scratch.gravity[:count], each.first)
                features[:, each.places] -= scratch.gravity[:count, each.places]
        doubtful = answer(
            self._fixed,
            self._outputs,
            self._places,
            self._counts,
            blocks,
            features,
            prior[1],
            self._std_factor,
            self._floor,
            self._misfit,
            SIGN_WIDTH,
            self._usual,
            motions,
            what,
            scratch.memory,
            tau,
            std,
            covariance,
            share,
        )
        if self._residual is not None:
            tau += prior[0]
        return doubtful


def _gravity_places(kernel: LinearKernel, first: int, last: int) -> slice | Indices | None:
    """Return the places of a term's features that contain gravity, among those of all linear terms; None if none do."""
    if isinstance(kernel, DriveKernel):
        gains = first + np.flatnonzero(kernel.gains)
        return gains if len(gains) else None
    return None if isinstance(kernel, ResidualKernel | MixtureKernel) else slice(first, last)


def _linear_prior(linear: Sequence[LinearKernel], params: Params) -> tuple[Array, Array]:
    """Return the prior means and variances of all linear weights, term after term, (P,) each."""
    means, variances = [np.zeros(0)], [np.zeros(0)]
    for term in linear:
        variance, mean = term.variances(params), term.prior_weights()
        means.append(np.zeros(len(variance)) if mean is None else mean)
        variances.append(variance)
    return np.concatenate(means), np.concatenate(variances)


def _check(outputs: Indices, torques: int, weights: Array, root: Array, linear_weights: int) -> None:
    """Raise ValueError if shapes do not match, an output is not one of `torques`, or root is not lower triangular."""
    size = len(outputs) + linear_weights
    if outputs.ndim != 1 or np.any((outputs < 0) | (outputs >= torques)):
        raise ValueError(f"outputs are {outputs}, expected numbers from 0 to {torques - 1}")
    if size == 0:
        raise ValueError("there are no outputs and no linear weights, expected at least one of them")
    if weights.shape != (size,):
        raise ValueError(f"weights have shape {weights.shape}, expected ({size},)")
    if root.shape != (size, size):
        raise ValueError(f"root has shape {root.shape}, expected ({size}, {size})")
    if np.any(np.triu(root, 1)):
        raise ValueError("root has elements above the diagonal, expected a lower triangular matrix")


def _of_joints(linear: Sequence[LinearKernel]) -> list[Indices]:
    """Return the places among all linear weights of those that each joint's torque may depend on."""
    first = np.cumsum([0, *(each.regressor().size for each in linear)])
    of_term = list(zip(first, linear, strict=False))
    return [np.concatenate([at + each.of_joint(j) for at, each in of_term]) for j in range(linear[0].n_joints)]


def _lay_out(weights: Array, root: Array, means: Array, variances: Array, parts: list[Indices]) -> Array:
    """Return the `fixed` array of `answer`, for features Φᵀ instead of their covariances Λ Φᵀ."""
    scale = np.ones(len(weights))
    scale[len(scale) - len(variances) :] = variances
    slopes = weights * scale
    slopes[len(scale) - len(means) :] += means
    root, chosen = root * scale, len(weights) - len(variances)
    # rows of a panel have the same sign
    panels = [pack(root[:chosen], 0), pack(root[chosen:], chosen)]
    return np.concatenate([pack(slopes[None], len(slopes)), *panels, pack_joints(slopes, root, parts)])
