"""A rigid body that an arm carries, in the usual terms of a robot controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array


@dataclass(frozen=True)
class Body:
    """A rigid body in the frame of an arm's last link. Raise ValueError for a body that cannot exist."""

    mass: float
    """Mass, kg, above zero."""
    com: Array
    """Centre of mass, (3,) m."""
    inertia: Array | None = None
    """Inertia about the centre of mass, along the axes of the link, (3, 3) kg·m². None: a point mass."""

    def __post_init__(self) -> None:
        if not 0 < self.mass < np.inf:
            raise ValueError(f"mass is {self.mass!r}, expected a positive number of kg")
        if self.com.shape != (3,) or not np.isfinite(self.com).all():
            raise ValueError(f"com is {self.com.tolist()}, expected three finite numbers, m")
        if self.inertia is None:
            return
        if self.inertia.shape != (3, 3) or not np.isfinite(self.inertia).all():
            raise ValueError(f"inertia is {self.inertia.tolist()}, expected a matrix of 3 × 3 finite numbers, kg·m²")
        size = np.abs(self.inertia).max()
        if not np.allclose(self.inertia, self.inertia.T, atol=1e-6 * size):
            raise ValueError(f"inertia is {self.inertia.tolist()}, expected a symmetric matrix")
        spread = 0.5 * np.trace(self.inertia) * np.eye(3) - self.inertia
        if np.linalg.eigvalsh(spread)[0] < -1e-9 * size:
            raise ValueError(
                f"inertia is {self.inertia.tolist()}, which no body has: expected no principal moment above the sum of "
                "the other two"
            )

    @property
    def parameters(self) -> Array:
        """Mass, first moment and inertia xx, xy, yy, xz, yz, zz about the link's frame, (10,)."""
        own = np.zeros((3, 3)) if self.inertia is None else self.inertia
        about = own + self.mass * (self.com @ self.com * np.eye(3) - np.outer(self.com, self.com))
        return np.concatenate([[self.mass], self.mass * self.com, about[LOWER_TRIANGLE]])

    @classmethod
    def of(cls, parameters: Array) -> Body:
        """Return the body of ten parameters. Raise ValueError if no body has them.

        It is a point mass if its inertia about the centre of mass is zero to rounding.
        """
        mass = float(parameters[0])
        if not mass > 0:
            raise ValueError(f"parameters are {parameters.tolist()}, expected a mass above zero")
        com = parameters[1:4] / mass
        about = np.zeros((3, 3))
        about[LOWER_TRIANGLE] = parameters[4:]
        about = about + np.tril(about, -1).T
        own = about - mass * (com @ com * np.eye(3) - np.outer(com, com))
        rounding = 1e-12 * np.abs(about).max()
        return cls(mass, com, None if np.abs(own).max() <= rounding else own)


LOWER_TRIANGLE = np.tril_indices(3)
"""Indices of xx, xy, yy, xz, yz and zz in a matrix."""
