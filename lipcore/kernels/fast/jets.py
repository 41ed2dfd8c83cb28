"""Jets: a quantity, its time derivatives along the first and along the second argument, and along both.

A jet x is a tuple of four Lanes (x, ẋ, x', ẋ'). In memory it is the last axis of an array of Lanes. `times` is the
product rule; `against` is its adjoint.
"""

from __future__ import annotations

from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.joints import LEFT, MIXED, RIGHT, VALUE, A, Array, Four, V
from lipcore.kernels.fast.lanes import Lanes, spread

Jet = Four


@inlined
def constant(value: float) -> Jet:
    """Return a jet with zero derivatives."""
    return spread(value), spread(0.0), spread(0.0), spread(0.0)


@inlined
def times(x: Jet, y: Jet) -> Jet:
    """Return x y."""
    return (
        x[0] * y[0],
        x[1] * y[0] + x[0] * y[1],
        x[2] * y[0] + x[0] * y[2],
        x[3] * y[0] + x[0] * y[3] + x[1] * y[2] + x[2] * y[1],
    )


@inlined
def against(d: Jet, y: Jet) -> Jet:
    """Return the derivative of Σ d ∘ (x y) by x."""
    return (
        d[0] * y[0] + d[1] * y[1] + d[2] * y[2] + d[3] * y[3],
        d[1] * y[0] + d[3] * y[2],
        d[2] * y[0] + d[3] * y[1],
        d[3] * y[0],
    )


@inlined
def dot(x: Jet, y: Jet) -> Lanes:
    """Return Σ x ∘ y."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]


@inlined
def plus(x: Jet, y: Jet) -> Jet:
    """Return x + y."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2], x[3] + y[3]


@inlined
def scaled(factor: float, x: Jet) -> Jet:
    """Return a constant factor times x."""
    return factor * x[0], factor * x[1], factor * x[2], factor * x[3]


@inlined
def velocity(x: Array, y: Array, i: int) -> Jet:
    """Return v_i v'_i."""
    v, a = x[V, i], x[A, i]
    return v * y[V, i], a * y[V, i], v * y[A, i], a * y[A, i]


@inlined
def base_jet(base: Array, x: Array, y: Array, b: int) -> Jet:
    """Return the jet of p_b, which depends on joint b alone. base: (n, 4)."""
    v, v2 = x[V, b], y[V, b]
    return base[b, VALUE], base[b, LEFT] * v, base[b, RIGHT] * v2, base[b, MIXED] * v * v2


@inlined
def base_jet_adjoint(d: Jet, x: Array, y: Array, b: int) -> Four:
    """Return the derivatives by p_b and its derivatives, given the derivatives by its jet."""
    v, v2 = x[V, b], y[V, b]
    return d[0], d[1] * v, d[2] * v2, d[3] * v * v2


@inlined
def get(m: Array, i: int, j: int) -> Jet:
    """Return the jet at (i, j) of an array of jets, (…, …, 4)."""
    return m[i, j, 0], m[i, j, 1], m[i, j, 2], m[i, j, 3]


@inlined
def put(m: Array, i: int, j: int, x: Jet) -> None:
    """Write a jet at (i, j)."""
    m[i, j, 0], m[i, j, 1], m[i, j, 2], m[i, j, 3] = x


@inlined
def add(m: Array, i: int, j: int, x: Jet) -> None:
    """Add to the jet at (i, j)."""
    put(m, i, j, plus(get(m, i, j), x))
