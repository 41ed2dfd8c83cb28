"""The serial-chain kernel, docs/method.md section 4: Gram matrix, its derivative, and the covariances of a query."""

from __future__ import annotations

from typing import NamedTuple

from lipcore.kernels.fast import pairs
from lipcore.kernels.fast.chain_kinetic import add_terms, couple, couple_adjoint, link_adjoint, link_terms
from lipcore.kernels.fast.chain_sums import Sums, clear, head, head_adjoint, lay_sums, tail, tail_adjoint
from lipcore.kernels.fast.compile import compiled, inlined
from lipcore.kernels.fast.jets import base_jet, base_jet_adjoint
from lipcore.kernels.fast.joints import Array, Flags, add_row, base_adjoint, base_kernels, row
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.fast.products import (
    ProductBack,
    Products,
    lay_back,
    lay_products,
    mixed_derivatives,
    potential_adjoint,
    prefixes,
)
from lipcore.kernels.fast.views import lay


class Work(NamedTuple):
    """Work memory for LANES pairs, in Lanes."""

    total: Array  # (n, n) block of the Gram matrix, or the derivatives by it
    base: Array  # (n, 4) base kernels
    products: Products
    sums: Sums
    e: Array  # (n, 4) vectors of one link's rank-one terms
    f: Array


class Back(NamedTuple):
    """Derivatives by `Work`."""

    half: Array  # (n, n) by half the kinetic block
    base: Array
    products: ProductBack
    sums: Sums


@inlined
def _lay_work(m: Array, at: int, n: int) -> tuple[Work, int]:
    (total, base, e, f), at = lay(m, at, ((n, n), (n, 4), (n, 4), (n, 4)))
    potential, at = lay_products(m, at, n)
    sums, at = lay_sums(m, at, n)
    return Work(total, base, potential, sums, e, f), at


@inlined
def _lay_back(m: Array, at: int, n: int) -> tuple[Back, int]:
    (half, base), at = lay(m, at, ((n, n), (n, 4)))
    potential, at = lay_back(m, at, n)
    sums, at = lay_sums(m, at, n)
    return Back(half, base, potential, sums), at


@compiled
def chain_size(n: int) -> int:
    """Return the number of elements to work in; see `pairs.work_size`."""
    return pairs.work_size(_lay_work, _lay_back, n)


@inlined
def _forward(hyper: Hyper, x: Array, y: Array, s: Work) -> None:
    """Compute the block of the potential and the sums of the kinetic blocks."""
    n = x.shape[1]
    base_kernels(hyper.shares[0], x, y, s.base)
    prefixes(s.base, n, s.products)
    mixed_derivatives(s.base, hyper.scales, n, s.products)
    for b in range(n):
        s.sums.p[b, 0], s.sums.p[b, 1], s.sums.p[b, 2], s.sums.p[b, 3] = base_jet(s.base, x, y, b)
    head(hyper.weights, x, y, s.sums)
    tail(hyper.weights, s.sums)


@inlined
def _covariance(hyper: Hyper, x: Array, y: Array, s: Work) -> None:
    """Compute the block of the Gram matrix for one row sample and LANES columns."""
    n = x.shape[1]
    _forward(hyper, x, y, s)
    couple(x, y, s.base, s.sums, s.total)
    for link in range(n):
        link_terms(link, hyper.weights, x, y, s.base, s.sums, s.e, s.f)
        add_terms(link, s.e, s.f, s.total)
    for i in range(n):
        for j in range(n):
            s.total[i, j] = 2.0 * s.total[i, j] + s.products.mixed[i, j]


@inlined
def _adjoint(hyper: Hyper, x: Array, y: Array, s: Work, d: Back, dhyper: Hyper) -> None:
    """Add the derivatives by the hyperparameters, given the derivatives by the block."""
    n = x.shape[1]
    _forward(hyper, x, y, s)
    potential_adjoint(s.base, hyper.scales, s.products, s.total, d.products, d.base, dhyper.scales)
    clear(d.sums)
    for i in range(n):
        for j in range(n):
            d.half[i, j] = 2.0 * s.total[i, j]
    couple_adjoint(x, y, s.base, s.sums, d.half, d.base, d.sums)
    for link in range(n):
        link_terms(link, hyper.weights, x, y, s.base, s.sums, s.e, s.f)
        link_adjoint(link, hyper.weights, x, y, s.base, s.sums, s.e, s.f, d.half, d.base, d.sums, dhyper.weights)
    tail_adjoint(hyper.weights, s.sums, d.sums, dhyper.weights)
    head_adjoint(hyper.weights, x, y, s.sums, d.sums, dhyper.weights)
    for b in range(n):
        add_row(d.base, b, base_jet_adjoint(row(d.sums.p, b), x, y, b))
        base_adjoint(x, y, b, row(d.base, b), dhyper.shares[0])


@compiled
def chain_gram(m: Array, kernels: int, x: Array, symmetric: bool, out: Array) -> None:
    """Write the Gram matrix; see `pairs.gram`."""
    pairs.gram(_lay_work, _covariance, m, kernels, x, symmetric, out)


@compiled
def chain_gradient(m: Array, kernels: int, x: Array, weight: Array, sums: Array) -> None:
    """Add the derivatives by the hyperparameters; see `pairs.gradient`."""
    pairs.gradient(_lay_work, _lay_back, _adjoint, m, kernels, x, weight, sums)


@compiled
def chain_cross(m: Array, kernels: int, prismatic: Flags, motions: Array, out: Array) -> None:
    """Write the covariances of queries; see `pairs.cross`."""
    pairs.cross(_lay_work, _covariance, m, kernels, prismatic, motions, out)
