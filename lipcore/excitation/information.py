"""How much of a model's variance a motion would take away, and how that changes with the motion.

The variance of a Gaussian process after more samples depends on where they are, not on the torques that come: it is
known before the robot moves. With k the covariance that a model's posterior (or a prior) gives to torques at two
motions, measuring the motion X with noise R leaves k(r, r) − k(r, X) (k(X, X) + R)⁻¹ k(X, r) at a reference motion r.
Nothing is approximated: X is a few hundred samples at most, of which each stands for several.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.excitation.belief import Belief
from lipcore.linalg import cholesky
from lipcore.motion import Motion

STEP = 1e-6
"""Of finite differences, rad and its rates. Covariances are smooth over far more, all but friction's sign (0.02)."""
LEAST = 1e-9
"""Share of the variance that rounding may not go below: a logarithm is taken of it."""


@dataclass(frozen=True)
class Information:
    """What a motion would tell of the torques at R reference motions of an n-joint robot.

    learnt: (M, R n), its square is what the model has learnt of the references; now: (R, n) variance there; floor: (n,)
    that a variance never falls below.
    """

    belief: Belief
    reference: Motion
    learnt: Tensor
    now: Tensor
    floor: Tensor

    @classmethod
    def about(cls, belief: Belief, reference: Motion) -> Information:
        """Of a belief about `reference`."""
        learnt = belief.root @ belief.cross(reference)
        prior = belief.kernel.variance(belief.params, reference).diagonal(dim1=1, dim2=2)
        now = torch.maximum(prior - learnt.square().sum(0).reshape(prior.shape), belief.floor)
        return cls(belief, reference, learnt, now, belief.floor)

    def left(self, motion: Motion, repeats: float = 1.0) -> Tensor:
        """Share of the variance at a reference that is left after measuring a motion of N samples, (n,).

        Geometric mean over the references. repeats: how many samples each of the N stands for.
        """
        belief = self.belief
        own = belief.kernel.symmetric_gram(belief.params, motion)
        _, told = self._told(own, self._with_reference(motion), belief.root @ belief.cross(motion), repeats)
        return self._share(self._after(told))

    def slope(self, motion: Motion, repeats: float = 1.0) -> tuple[float, Motion]:
        """Mean over joints of log `left`, and its derivatives by position, velocity and acceleration, each (N, n).

        With S = k(X, X) + R, D = k(X, r) and α = S⁻¹ D, what is told of r changes by 2 αᵀ dD − αᵀ dS α.
        """
        belief, kernel, params = self.belief, self.belief.kernel, self.belief.params
        own, other, cross = kernel.gram(params, motion, motion), self._with_reference(motion), belief.cross(motion)
        learnt = belief.root @ cross
        solved, told = self._told(own, other, learnt, repeats)
        after = self._after(told)
        moves = after == self.now - told  # a variance that has reached its floor stays there
        weight = -torch.where(moves, 1 / after, 0.0).reshape(-1) / after.numel()
        by_other = 2 * solved * weight
        by_own = -(solved * weight) @ solved.T
        by_cross = belief.root.T @ (-2 * learnt @ by_own - self.learnt @ by_other.T)
        size, n = motion.q.shape
        parts = {"q": motion.q, "dq": motion.dq, "ddq": motion.ddq}
        found = {name: torch.empty_like(part) for name, part in parts.items()}
        for name, part in parts.items():
            for joint in range(n):
                moved = part.clone()
                moved[:, joint] += STEP
                near = Motion(**{**parts, name: moved})
                # a sample moves both its row and its column
                total = 2 * (by_own * (kernel.gram(params, near, motion) - own)).sum(1)
                total += (by_other * (self._with_reference(near) - other)).sum(1)
                total += (by_cross * (belief.cross(near) - cross)).sum(0)
                found[name][:, joint] = total.reshape(size, n).sum(1) / STEP
        return float(self._share(after).log().mean()), Motion(**found)

    def _with_reference(self, motion: Motion) -> Tensor:
        """Prior covariance of the motion's torques with those at the references, (N n, R n)."""
        return self.belief.kernel.gram(self.belief.params, motion, self.reference)

    def _told(self, own: Tensor, other: Tensor, learnt: Tensor, repeats: float) -> tuple[Tensor, Tensor]:
        """S⁻¹ D, (N n, R n), and the variance that the motion would take away, (R, n), from prior covariances."""
        noise = (self.belief.noise_variance / repeats).repeat(len(own) // len(self.floor))
        factor = cholesky(own - learnt.T @ learnt + torch.diag(noise))
        whitened = factor.whiten(other - learnt.T @ self.learnt)
        solved = torch.linalg.solve_triangular(factor.lower.T, whitened, upper=True)
        return solved, whitened.square().sum(0).reshape(self.now.shape)

    def _after(self, told: Tensor) -> Tensor:
        return torch.maximum(torch.maximum(self.now - told, self.floor), LEAST * self.now)

    def _share(self, after: Tensor) -> Tensor:
        """Geometric mean over the references: what is left of the largest variances alone would tell of extremes."""
        return (after / self.now).log().mean(0).exp()
