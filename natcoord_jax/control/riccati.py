"""The step of Newton's method for a quadratic model, linear in the number of steps.

Backward, the value of every node is a quadratic function of its small numbers z and of the changes nu of the
goal's multipliers; at the first node, what is free and nu follow from one small system; forward, so do all
entering coefficients. Conditions of the goal that nothing can change, because others imply them or because
no input reaches them, are found by the eigenvalues of the small system and left out.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.control.iterate import Model

REACH = (1e-8, 1e-3)
"""Eigenvalues of the goal's compliance below this fraction of the largest count as zero: of a motion that
obeys its equations, and of one that does not by far."""


FELT = 1e-5
"""Conditions of the goal that inputs move less than this, relative to the others, count as out of reach."""


class Weighted(NamedTuple):
    """Bounds in the quadratic model: the diagonal that slacks add, and their linear terms."""

    path: Float[Array, "steps h"]
    path_slope: Float[Array, "steps h"]
    end: Float[Array, " e"]
    end_slope: Float[Array, " e"]


class Move(eqx.Module):
    """The solution of the quadratic model.

    Attributes:
        w: changes of entering coefficients (steps, m).
        first: changes of what is free and of leading coefficients.
        goal: changes of the goal's multipliers.
        z: changes of all nodes in small numbers (steps + 1, z).
        gain: feedback of w on z (steps, m, z).
        convex: whether the model is convex where it has to be.
        unreachable: part of the goal's residual that nothing can change.
        compliance: the goal's compliance: its residual per multiplier.
    """

    w: Float[Array, "steps m"]
    first: Float[Array, " f"]
    goal: Float[Array, " c"]
    z: Float[Array, "k z"]
    gain: Float[Array, "steps m z"]
    convex: Bool[Array, ""]
    unreachable: Float[Array, " c"]
    compliance: Float[Array, "c c"]


class _Value(NamedTuple):
    """z P z / 2 + (p + S nu) z - nu T nu / 2 + t nu."""

    P: Array
    p: Array
    S: Array
    T: Array
    t: Array
    convex: Array


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)


def _terminal(model: Model, missing: Array, bounds: Weighted, penalty: Array) -> _Value:
    """Value of the last node; the penalty on the goal changes no solution that reaches it."""
    goal, excess = model.goal, model.last_excess
    hessian = model.last_hessian + excess.T @ (bounds.end[:, None] * excess)
    hessian = hessian + goal.T @ (penalty[:, None] * goal)
    slope = excess.T @ bounds.end_slope + goal.T @ (penalty * missing)
    count = goal.shape[0]
    return _Value(_symmetric(hessian), slope, goal.T, jnp.zeros((count, count)), missing, jnp.array(True))


def _backward(value: _Value, given: tuple) -> tuple[_Value, tuple]:
    """Value of a node from that of the next, and the feedback of its step."""
    forward, offset, hessian, gradient, excess, excess_offset, weight, slope, extra = given
    size = value.p.shape[0]
    whole = hessian + forward.T @ value.P @ forward + excess.T @ (weight[:, None] * excess)
    whole = _symmetric(whole)
    linear = gradient + forward.T @ (value.P @ offset + value.p)
    linear = linear + excess.T @ (slope + weight * excess_offset)
    mixed = forward.T @ value.S
    quadratic = whole[size:, size:] + jnp.diag(extra)
    lower = jnp.linalg.cholesky(quadratic)
    convex = value.convex & jnp.all(jnp.isfinite(lower))
    lower = jnp.where(convex, jnp.nan_to_num(lower), jnp.eye(lower.shape[0]))
    right = jnp.concatenate([whole[size:, :size], linear[size:, None], mixed[size:]], axis=1)
    found = -jax.scipy.linalg.cho_solve((lower, True), right)
    gain, step, by_goal = found[:, :size], found[:, size], found[:, size + 1 :]
    P = _symmetric(whole[:size, :size] + whole[:size, size:] @ gain)
    p = linear[:size] + whole[:size, size:] @ step
    S = mixed[:size] + whole[:size, size:] @ by_goal
    T = value.T - mixed[size:].T @ by_goal
    t = value.t + value.S.T @ offset + mixed[size:].T @ step
    return _Value(P, p, S, T, t, convex), (gain, step, by_goal)


def _first(
    model: Model, value: _Value, shift: Array, goal: Array, reach: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """What is free at the first node, and the changes of the goal's multipliers."""
    E = model.first
    quadratic = _symmetric(E.T @ value.P @ E + model.first_hessian)
    quadratic = quadratic + shift * jnp.diag(1.0 + jnp.abs(jnp.diagonal(quadratic)))
    linear, mixed = E.T @ value.p + model.first_gradient, E.T @ value.S
    convex, T, t = value.convex, value.T, value.t
    if E.shape[1]:
        lower = jnp.linalg.cholesky(quadratic)
        convex = convex & jnp.all(jnp.isfinite(lower))
        lower = jnp.where(convex, jnp.nan_to_num(lower), jnp.eye(lower.shape[0]))
        found = -jax.scipy.linalg.cho_solve((lower, True), jnp.concatenate([linear[:, None], mixed], axis=1))
        step, by_goal = found[:, 0], found[:, 1:]
        T, t = T - mixed.T @ by_goal, t + mixed.T @ step
    else:
        step, by_goal = linear, mixed
    if not T.size:
        return step, t, convex, t, T
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(T), 1e-300))
    scale = jnp.where(scale > FELT * jnp.max(scale), 1.0 / scale, 0.0)
    values, vectors = jnp.linalg.eigh(scale[:, None] * _symmetric(T) * scale)
    reached = values > reach
    inverse = jnp.where(reached, 1.0 / jnp.where(reached, values, 1.0), 0.0)
    solved = inverse * (vectors.T @ (scale * t))
    # Multipliers of what cannot be changed have no say; those found earlier are taken back.
    left = jnp.where(
        reached, 0.0, vectors.T @ jnp.where(scale > 0, goal / jnp.where(scale > 0, scale, 1.0), 0.0)
    )
    nu = scale * (vectors @ solved)
    return step + by_goal @ nu, nu - scale * (vectors @ left), convex, t - T @ nu, T


def solve(
    model: Model,
    missing: Float[Array, " c"],
    bounds: Weighted,
    idle: Float[Array, "steps m"],
    shift: Float[Array, ""],
    penalty: Float[Array, " c"],
    goal: Float[Array, " c"],
    reach: Float[Array, ""],
) -> Move:
    """Solve the quadratic model.

    Args:
        model: the model.
        missing: residual of the goal.
        bounds: what slacks add.
        idle: 1 for coefficients that do not enter in a step, else 0.
        shift: relative increase of the curvature in the coefficients.
        penalty: weight of the goal's squared residual in the model.
        goal: present multipliers of the goal.
        reach: eigenvalues of the goal's compliance below it count as zero, see `REACH`.
    """
    last = _terminal(model, missing, bounds, penalty)
    own = jnp.diagonal(model.hessian, axis1=1, axis2=2)[:, -idle.shape[1] :]
    typical = jnp.maximum(jnp.max(jnp.abs(own)), 1e-12)
    extra = idle + shift * jnp.where(jnp.isfinite(typical), typical, 1.0)
    given = (
        model.forward,
        model.offset,
        model.hessian,
        model.gradient,
        model.excess,
        model.excess_offset,
        bounds.path,
        bounds.path_slope,
        extra,
    )
    value, (gain, step, by_goal) = jax.lax.scan(_backward, last, given, reverse=True)
    first, nu, convex, unreachable, compliance = _first(model, value, shift, goal, reach)

    def forth(z: Array, given: tuple) -> tuple[Array, tuple]:
        forward, offset, gain, step, by_goal = given
        w = gain @ z + step + by_goal @ nu
        return forward @ jnp.concatenate([z, w]) + offset, (z, w)

    z_last, (z, w) = jax.lax.scan(
        forth, model.first @ first, (model.forward, model.offset, gain, step, by_goal)
    )
    z = jnp.concatenate([z, z_last[None]])
    finite = jnp.all(jnp.isfinite(w)) & jnp.all(jnp.isfinite(nu)) & jnp.all(jnp.isfinite(first))
    return Move(w, first, nu, z, gain, convex & finite, unreachable, compliance)
