"""The paper's kernel, docs/method.md section 3: Gram matrix, its derivative, and the covariances of a query.

Of the E kernels of positions the last is the potential's. The others are those of the links, or one for all links.
"""

from __future__ import annotations

from typing import NamedTuple

from lipcore.kernels.fast import pairs
from lipcore.kernels.fast.compile import compiled, inlined
from lipcore.kernels.fast.joints import Array, Flags, base_adjoint, base_kernels, row
from lipcore.kernels.fast.lip_kinetic import (
    Terms,
    TermsBack,
    add_block,
    block_adjoint,
    lay_terms,
    lay_terms_back,
    link_terms,
    square,
    square_adjoint,
)
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.fast.products import (
    ProductBack,
    Products,
    lay_back,
    lay_products,
    mixed_derivatives,
    potential_adjoint,
    prefixes,
    product_adjoint,
)
from lipcore.kernels.fast.views import lay, numbers


class Work(NamedTuple):
    """Work memory for LANES pairs, in Lanes except for `one`."""

    total: Array  # (n, n) block of the Gram matrix, or the derivatives by it
    base: Array  # (n, 4) base kernels
    power: Array  # (n, 4) their squares
    products: Products
    terms: Terms
    one: Array  # (n,) scales of a product over a link's joints: one for its last, else zero


class Back(NamedTuple):
    """Derivatives by `Work`."""

    base: Array
    products: ProductBack
    terms: TermsBack


@inlined
def _lay_work(m: Array, at: int, n: int) -> tuple[Work, int]:
    (total, base, power), at = lay(m, at, ((n, n), (n, 4), (n, 4)))
    position, at = lay_products(m, at, n)
    terms, at = lay_terms(m, at, n)
    return Work(total, base, power, position, terms, numbers(m, at, (n,))), at + n


@inlined
def _lay_back(m: Array, at: int, n: int) -> tuple[Back, int]:
    (base,), at = lay(m, at, ((n, 4),))
    position, at = lay_back(m, at, n)
    terms, at = lay_terms_back(m, at, n)
    return Back(base, position, terms), at


@compiled
def lip_size(n: int) -> int:
    """Return the number of elements to work in; see `pairs.work_size`."""
    return pairs.work_size(_lay_work, _lay_back, n)


@inlined
def _potential(hyper: Hyper, x: Array, y: Array, s: Work) -> None:
    """Compute H of the potential energy's kernel, the covariance of its torques (3)."""
    n = x.shape[1]
    base_kernels(hyper.shares[-1], x, y, s.base)
    prefixes(s.base, n, s.products)
    mixed_derivatives(s.base, hyper.scales, n, s.products)


@inlined
def _kinetic(hyper: Hyper, link: int, x: Array, y: Array, s: Work) -> None:
    """Compute the terms of a link's block. Links must be called from the last to the first."""
    last, n, m = hyper.shares.shape[0] - 2, x.shape[1], link + 1
    if link == n - 1 or last > 0:
        base_kernels(hyper.shares[min(link, last)], x, y, s.base)
        square(s.base, s.power)
        prefixes(s.power, m, s.products)
    s.one[m % n], s.one[link] = 0.0, 1.0
    mixed_derivatives(s.power, s.one, m, s.products)
    link_terms(hyper.weights[link], x, y, m, s.products, s.terms)


@inlined
def _covariance(hyper: Hyper, x: Array, y: Array, s: Work) -> None:
    """Compute the block of the Gram matrix for one row sample and LANES columns."""
    n = x.shape[1]
    _potential(hyper, x, y, s)
    for i in range(n):
        for j in range(n):
            s.total[i, j] = s.products.mixed[i, j]
    for link in range(n - 1, -1, -1):
        _kinetic(hyper, link, x, y, s)
        add_block(hyper.weights[link], x, y, link + 1, s.products, s.terms, s.total)


@inlined
def _adjoint(hyper: Hyper, x: Array, y: Array, s: Work, d: Back, dhyper: Hyper) -> None:
    """Add the derivatives by the hyperparameters, given the derivatives by the block."""
    last, n = hyper.shares.shape[0] - 2, x.shape[1]
    _potential(hyper, x, y, s)
    potential_adjoint(s.base, hyper.scales, s.products, s.total, d.products, d.base, dhyper.scales)
    for b in range(n):
        base_adjoint(x, y, b, row(d.base, b), dhyper.shares[-1])
    for link in range(n - 1, -1, -1):
        m = link + 1
        _kinetic(hyper, link, x, y, s)
        given = block_adjoint(hyper.weights[link], x, y, m, s.products, s.terms, s.total, d.terms, dhyper.weights[link])
        product_adjoint(s.power, s.one, m, s.products, given, d.products, d.base)
        for b in range(m):
            by_base = square_adjoint(s.base, b, row(d.base, b))
            base_adjoint(x, y, b, by_base, dhyper.shares[min(link, last)])


@compiled
def lip_gram(m: Array, kernels: int, x: Array, symmetric: bool, out: Array) -> None:
    """Write the Gram matrix; see `pairs.gram`."""
    pairs.gram(_lay_work, _covariance, m, kernels, x, symmetric, out)


@compiled
def lip_gradient(m: Array, kernels: int, x: Array, weight: Array, sums: Array) -> None:
    """Add the derivatives by the hyperparameters; see `pairs.gradient`."""
    pairs.gradient(_lay_work, _lay_back, _adjoint, m, kernels, x, weight, sums)


@compiled
def lip_cross(m: Array, kernels: int, prismatic: Flags, motions: Array, out: Array) -> None:
    """Write the covariances of queries; see `pairs.cross`."""
    pairs.cross(_lay_work, _covariance, m, kernels, prismatic, motions, out)
