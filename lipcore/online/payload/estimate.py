"""A payload as rows have it, and what they say without one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.model.payload import Carrier, Linearised, Load
from lipcore.online.payload.bodies import CONTACTS, Known, body, evidence, inverse, usual
from lipcore.online.payload.errors import whitened
from lipcore.robots.urdf import PARAMETERS

if TYPE_CHECKING:
    from lipcore.online.payload.draws import Draw

Seen = tuple[Motion, tuple[Array, Array]]
"""Instants, and what terms other than the arm make there."""


@dataclass(frozen=True)
class Estimate:
    """A payload as rows have it. eta, (10,): most likely; covariance: (10, 10) of it; load: with the arm's variables;
    gain, contact: nats by which it explains the rows better than the arm without a payload, and a contact does; draws:
    from the posterior, where it is not linear; doubt: how many times a linear posterior's its deviations are."""

    eta: Array
    covariance: Array
    load: Load
    gain: float
    contact: float
    draws: tuple[Draw, ...] = ()
    doubt: float = 1.0

    @property
    def mass(self) -> tuple[float, float]:
        """Mean and standard deviation of the mass, kg."""
        return float(np.exp(self.eta[0])), float(np.exp(self.eta[0]) * np.sqrt(self.covariance[0, 0]))


def known(carrier: Carrier, prior: Known) -> Estimate:
    """A payload of which no more is known than beforehand."""
    payload, slope = body(prior.centre)
    spread = inverse(prior.precision)
    return Estimate(prior.centre, spread, carrier.known(payload, slope @ spread @ slope.T), 0.0, 0.0)


def rows_of(around: Linearised, motion: Motion, rest: tuple[Array, Array]) -> tuple[Array, Array]:
    """Features of (w, π) at N instants, (M + 10, N, n), and the torque of the load's mean, (N, n) N·m."""
    features, base = around.rows(motion, rest)
    return features, base + np.tensordot(around.load.mean, features, axes=1)


def alone(carrier: Carrier, free: Seen | None, loaded: Seen, tau: Array, roots: Array) -> tuple[float, float, float]:
    """Of the arm without a payload, linear: the rows' energy and the volume of what they teach, nats, and the evidence
    that a contact of constant torque gains on the loaded ones. tau: of both, (N, n) N·m; roots: of their errors."""
    nothing = Linearised(carrier, carrier.known(np.zeros(PARAMETERS)))
    parts = [rows_of(nothing, *each) for each in (free, loaded) if each is not None]
    features, torque = (np.concatenate(each, axis=-2) for each in zip(*parts, strict=True))
    (count, n), size = torque.shape, len(carrier.mean)
    touched = np.zeros((n, count, n))
    touched[:, count - len(loaded[0]) :] = np.eye(n)[:, None]
    typical = usual(features[size:, -1])
    features, off = whitened(roots, np.concatenate([features[:size], touched]), torque - tau)
    along, contact = features[:size].T @ carrier.covariance_root, features[size:].T
    # of as many rows as of variables at most
    inner = along @ along.T if len(along) < size else along.T @ along
    inner[np.diag_indices(len(inner))] += 1.0
    sought = np.column_stack([off, contact])
    if len(along) < size:
        within = np.linalg.solve(inner, sought)
        products = sought.T @ within
    else:
        products = sought.T @ sought - (along.T @ sought).T @ np.linalg.solve(inner, along.T @ sought)
    gained = evidence(products[None, 1:, 1:], -products[None, 1:, 0], [np.full(n, each * typical) for each in CONTACTS])
    return 0.5 * float(products[0, 0]), float(np.linalg.slogdet(inner)[1]), float(gained[0])
