"""Define the estimate of a payload, and the evidence of its rows without one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.model.payload import Carrier, LinearisedCarrier, PayloadPosterior
from lipcore.online.payload.bodies import CONTACT_SCALES, PayloadPrior, body, evidence, inverse, typical_torque
from lipcore.online.payload.errors import whiten
from lipcore.robots.urdf import PARAMETERS

if TYPE_CHECKING:
    from lipcore.online.payload.draws import Draw

Instants = tuple[Motion, tuple[Array, Array]]
"""Motions, and the torque of all terms other than the arm there."""


@dataclass(frozen=True)
class Estimate:
    """An estimate of a payload from rows."""

    eta: Array
    """Most likely η, (10,)."""
    covariance: Array
    """Covariance of η, (10, 10)."""
    load: PayloadPosterior
    """The payload together with the arm's variables."""
    gain: float
    """Nats by which it explains the rows better than the arm without a payload."""
    contact: float
    """Nats by which a contact does so."""
    draws: tuple[Draw, ...] = ()
    """Draws from the posterior, if that is not linear."""
    doubt: float = 1.0
    """Factor of its standard deviations over those of the linear posterior."""
    misfit: float = 1.0
    """Mean square of the whitened errors of the rows."""

    @property
    def mass(self) -> tuple[float, float]:
        """Return mean and standard deviation of the mass, kg."""
        return float(np.exp(self.eta[0])), float(np.exp(self.eta[0]) * np.sqrt(self.covariance[0, 0]))


def estimate_from_prior(carrier: Carrier, prior: PayloadPrior) -> Estimate:
    """Return the estimate without rows."""
    payload, slope = body(prior.centre)
    spread = inverse(prior.precision)
    return Estimate(prior.centre, spread, carrier.known(payload, slope @ spread @ slope.T), 0.0, 0.0)


def rows_of(around: LinearisedCarrier, motion: Motion, rest: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the features of (w, π) at N instants, (M + 10, N, n), and the torque of the load's mean, (N, n) N·m."""
    features, base = around.rows(motion, rest)
    return features, base + np.tensordot(around.load.mean, features, axes=1)


def explain_unloaded(
    carrier: Carrier, free: Instants | None, loaded: Instants, tau: Array, roots: Array
) -> tuple[float, float, float]:
    """Return what the rows show about the linear arm without a payload, in nats.

    It is the energy of the rows, the volume of their information, and the evidence of a contact of constant torque on
    the loaded rows. tau: of both parts, (N, n) N·m; roots: of their errors.
    """
    nothing = LinearisedCarrier(carrier, carrier.known(np.zeros(PARAMETERS)))
    parts = [rows_of(nothing, *each) for each in (free, loaded) if each is not None]
    features, torque = (np.concatenate(each, axis=-2) for each in zip(*parts, strict=True))
    (count, n), size = torque.shape, len(carrier.mean)
    touched = np.zeros((n, count, n))
    touched[:, count - len(loaded[0]) :] = np.eye(n)[:, None]
    typical = typical_torque(features[size:, -1])
    features, off = whiten(roots, np.concatenate([features[:size], touched]), torque - tau)
    along, contact = features[:size].T @ carrier.covariance_root, features[size:].T
    # the smaller of both sizes
    inner = along @ along.T if len(along) < size else along.T @ along
    inner[np.diag_indices(len(inner))] += 1.0
    sought = np.column_stack([off, contact])
    if len(along) < size:
        within = np.linalg.solve(inner, sought)
        products = sought.T @ within
    else:
        products = sought.T @ sought - (along.T @ sought).T @ np.linalg.solve(inner, along.T @ sought)
    gained = evidence(
        products[None, 1:, 1:], -products[None, 1:, 0], [np.full(n, each * typical) for each in CONTACT_SCALES]
    )
    return 0.5 * float(products[0, 0]), float(np.linalg.slogdet(inner)[1]), float(gained[0])
