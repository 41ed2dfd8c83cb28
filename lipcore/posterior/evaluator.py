"""The compiled evaluator of a compact posterior. Once built, it needs only NumPy and Numba (baselines: PyTorch)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.base import LinearKernel, PairKernel, Params
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.answer import COVARIANCE, MEAN, MISFIT_ROWS, ROWS, STD, WIDTH, answer, answer_one
from lipcore.kernels.fast.play import POSITIONS
from lipcore.kernels.payload import PayloadKernel
from lipcore.kernels.residual import ResidualKernel
from lipcore.posterior.gravity import Gravity, at_rest
from lipcore.posterior.layout import check_factors, feature_factors, pack_factors, prior_variances, weights_of_joints
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.threads import run_parts

QUERIES = 16
"""Queries computed together. Each panel of the root is then read once for many queries, and they still fit the
cache."""


class _Scratch(threading.local):
    """One thread's memory for a number of queries. It is created at the thread's first query."""

    def __init__(self, queries: int, samples: int, anchors: int, linear: int, n: int) -> None:
        self._sizes = queries, samples, anchors, linear, n
        groups = -(-n // WIDTH)
        self.motions = np.zeros((queries, POSITIONS, n))
        self.deflected = np.zeros((queries, POSITIONS + 2 * len(ELEMENTS), n))
        self.blocks = np.zeros((queries, samples + 1, n, n))
        self.features = np.zeros((queries, linear, n))
        self.prior = np.zeros((2, queries, n))
        self.memory = np.zeros(groups * WIDTH * (queries * anchors + ROWS))
        self.std = np.zeros((queries, n))
        self.covariance = np.zeros((queries, n, n))
        self.share = np.zeros((queries, n))
        # slicing would cost one query as much as the arithmetic
        self.work = self.blocks, self.features, self.prior, self.memory

    def __reduce__(self) -> tuple[type[_Scratch], tuple[int, ...]]:
        """Pickle the sizes alone."""
        return _Scratch, self._sizes


class Evaluator:
    """Posterior torques of a robot with n joints from M = m + P anchors: m inducing outputs, then all linear weights.

    g(x) is the covariance of the anchors with the torques at x, (M, n). The mean is E f(x) + gᵀ weights. The covariance
    is std_factor² (k₁(x, x) − (Q₁ g)ᵀ (Q₁ g) + (Q₂ g)ᵀ (Q₂ g)), with k₁ of the nonlinear term and Q₁ the first m rows
    of Q. The misfit is added to its diagonal, which is then raised to at least `floor`.

    term: the kernel's nonlinear term, None if it has none. params: hyperparameters of all terms. inducing: S samples,
    None without `term`. outputs: (m,), the chosen torques, as sample · n + joint. linear: the linear terms in the order
    of the anchors. weights: (M,). root: Q, (M, M) lower triangular. std_factor: calibration. floor: (n,) (N·m)².
    floor, misfit: None for none. usual: mean and variance of the torque in
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
        misfit: Misfit | None = None,
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
        check_factors(self._outputs, samples * n, weights, root, len(prior_variances(linear, params)))
        regressors = [each.regressor() for each in linear]
        self._fills, self._fills_many, self._residual = [], [], None
        self._payload = slice(0, 0)
        first = 0
        for kernel, regressor in zip(linear, regressors, strict=True):
            last = first + regressor.size
            if isinstance(kernel, ResidualKernel):
                self._residual = first, kernel
            else:
                self._fills.append((first, last, regressor.fill))
                self._fills_many.append((first, regressor.fill_many, isinstance(kernel, DriveKernel | PayloadKernel)))
            if isinstance(kernel, PayloadKernel):
                self._payload = slice(first, last)
            first = last
        if self._residual is not None and term is not None:
            raise ValueError("linear has a residual beside a nonlinear term, expected one of them")
        self._gravity = Gravity(linear, regressors)
        parts = weights_of_joints(linear) if term is None else []
        self._counts = np.array([len(each) for each in parts], np.int64)
        self._places = np.zeros((len(parts), self._counts.max(initial=0)), np.int64)
        for row, each in zip(self._places, parts, strict=True):
            row[: len(each)] = each
        self._fixed = pack_factors(*feature_factors(linear, params, weights, root), len(self._outputs), parts)
        self._std_factor = float(std_factor)
        self._floor = np.zeros(n) if floor is None else np.array(floor, np.float64)
        if self._floor.shape != (n,):
            raise ValueError(f"floor has shape {self._floor.shape}, expected ({n},)")
        misfit = Misfit.none(n) if misfit is None else misfit
        self._misfit, self._arms = misfit.packed(), misfit.arms
        rows = MISFIT_ROWS, MISFIT_ROWS + 2 * len(ELEMENTS)
        if self._misfit.shape not in [(count, n) for count in rows]:
            raise ValueError(f"misfit has shape {self._misfit.shape}, expected ({rows[0]} or {rows[1]}, {n})")
        self._falls_back = usual is not None
        self._usual_mean: Array = np.zeros(n) if usual is None else usual[0]
        self._usual: Array = np.full(n, np.inf) if usual is None else usual[1]
        self._stood = np.zeros(n, np.bool_) if stood is None else stood
        sizes = samples, len(weights), first, n
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
        (blocks, features, prior, _), between = scratch.work, scratch.covariance
        if covariance is not None:
            between, what = covariance, COVARIANCE
        query = scratch.deflected if len(motion) > POSITIONS else scratch.motions
        query[0] = motion
        if self._cross is not None:
            self._cross.fill_many(query, blocks)
        if self._residual is not None:
            self._residual[1].fill_all(query, features, self._residual[0], prior[0], prior[1])
        for first, last, fill in self._fills:
            fill(query[0], features[0, first:last])
        tau = np.empty((1, self.n_joints))
        deviation = np.empty((1, self.n_joints)) if std else scratch.std
        doubtful = self._solve(answer_one, what, query, scratch.work, tau, deviation, between, scratch.share)
        fallback = scratch.share[0].copy() if doubtful else None
        if reduced is not None:
            self._gravity.subtract_one(query[0], features[0])
            outputs = reduced[:1], reduced[1:], scratch.covariance, scratch.share
            self._solve(answer_one, STD, query, scratch.work, *outputs)
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
            known = None if deflections is None else deflections[part]
            for rows, motions in _groups(Motion(q[part], dq[part], ddq[part], known).arrays(), part.start):
                between = None if covariances is None else covariances[rows]
                doubtful.append(self._answer(motions, motions, tau[rows], std[rows], share[rows], between))

        run_parts(size, answer_part)
        return tau, std, covariances, share if any(doubtful) else None

    def without_gravity(self, motions: Array) -> tuple[Array, Array]:
        """Return the torques minus gravity at N queries, and the standard deviations of the differences, (N, n) each.

        Gravity is the torque of bodies and payload at rest in the same posture, with their gains. The features of a
        difference are the difference of the features. Misfit and variance beyond a residual count in full: their share
        in gravity is unknown. Only without a nonlinear term. motions: as of `Motion.arrays`.
        """
        tau, std = np.empty_like(motions[:, 0]), np.empty_like(motions[:, 0])
        for rows, moving in _groups(motions):
            share = self._many.share[: len(moving)]
            self._answer(moving, moving, tau[rows], std[rows], share, with_gravity=False)
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
        for rows, moving in _groups(motions):
            still, static, count = at_rest(moving), harmless[rows], len(moving)
            std, own = scratch.std[:count], scratch.share[:count]
            gravity, without = np.zeros_like(static), np.ones_like(static)
            if self._stood.any():
                self._answer(still, still, static, std, own)
                gravity[:, self._stood], without[:, self._stood] = static[:, self._stood], own[:, self._stood]
            self._answer(still, moving, static, std, own)
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
        motions: Array,
        moving: Array,
        tau: Array,
        std: Array,
        share: Array,
        covariance: Array | None = None,
        with_gravity: bool = True,
    ) -> bool:
        """Compute at most QUERIES queries. moving: their motion for friction and payload."""
        scratch, count = self._many, len(motions)
        blocks, features, prior = scratch.blocks[:count], scratch.features[:count], scratch.prior[:, :count]
        if self._cross is not None:
            self._cross.fill_many(motions, blocks)
        if self._residual is not None:
            self._residual[1].fill_all(motions, features, self._residual[0], prior[0], prior[1])
        for first, fill_many, moves in self._fills_many:
            fill_many(moving if moves else motions, features, first)
        if not with_gravity:
            self._gravity.subtract(motions, features)
        what = STD if covariance is None else COVARIANCE
        between = scratch.covariance[:count] if covariance is None else covariance
        work = blocks, features, prior, scratch.memory
        return self._solve(answer, what, motions, work, tau, std, between, share)

    def _solve(
        self,
        solve: Callable[..., bool],
        what: int,
        motions: Array,
        work: tuple[Array, Array, Array, Array],
        tau: Array,
        std: Array,
        covariance: Array,
        share: Array,
    ) -> bool:
        """Compute torques from features; see `answer`. work: of `_Scratch`."""
        blocks, features, prior, memory = work
        doubtful = solve(
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
            self._arms,
            SIGN_WIDTH,
            self._usual,
            motions,
            what,
            memory,
            tau,
            std,
            covariance,
            share,
        )
        if self._residual is not None:
            tau += prior[0]
        return doubtful


def _groups(motions: Array, first: int = 0) -> Iterator[tuple[slice, Array]]:
    """Return at most QUERIES motions at a time, with their rows. first: row of the first motion."""
    for start in range(0, len(motions), QUERIES):
        group = np.ascontiguousarray(motions[start : start + QUERIES])
        yield slice(first + start, first + start + len(group)), group
