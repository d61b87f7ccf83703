"""The step of Newton's method for a quadratic model, linear in the number of steps.

Backward, the value of every node is a quadratic function of its small numbers z and of the changes nu of the
goal's multipliers; at the first node, what is free and nu follow from one small system; forward, so do all
entering coefficients. The quadratic parts are `factored` once and serve any number of linear ones. Conditions
of the goal that nothing can change, because others imply them or because no input reaches them, are found by
the eigenvalues of the small system and left out.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.control.iterate import Model
from natcoord_jax.xla.one_kernel import scan_in_one_kernel

REACH = (1e-8, 1e-3)
"""Eigenvalues of the goal's compliance below this fraction of the largest count as zero: of a motion that
obeys its equations, and of one that does not by far."""
SINGULAR = 1e-12
"""Pivots below this part of the diagonal are none."""
TOO_MANY = 1_000_000
"""More negative eigenvalues than any problem has conditions."""
FELT = 1e-5
"""Conditions of the goal that inputs move less than this, relative to the others, count as out of reach."""


class Weighted(NamedTuple):
    """Bounds in the quadratic model: the diagonal that slacks add, and their linear terms."""

    path: Float[Array, "steps h"]
    path_slope: Float[Array, "steps h"]
    end: Float[Array, " e"]
    end_slope: Float[Array, " e"]


class Right(NamedTuple):
    """Linear terms of the model.

    Attributes:
        gradient: of the steps, in [z, w] (steps, z + m).
        last: gradient in the last node (z,).
        first: gradient in what is free and in leading coefficients (f,).
        missing: residual of the goal.
    """

    gradient: Float[Array, "steps zm"]
    last: Float[Array, " z"]
    first: Float[Array, " f"]
    missing: Float[Array, " c"]


class Factors(eqx.Module):
    """Quadratic parts of all nodes' values, z P z / 2 + nu S z - nu T nu / 2, and what follows from them.

    Attributes:
        forward: z_k+1 from [z_k, w_k] (steps, z, z + m).
        softness: inverses of the curvature in w (steps, m, m).
        gain: feedback of w on z (steps, m, z).
        by_goal: w per nu (steps, m, c).
        start: z_0 per what is free (z, f).
        start_stiffness: curvature in what is free, on the diagonal (f,).
        start_softness: its inverse (f, f).
        start_by_goal: what is free per nu (f, c).
        compliance: the goal's compliance T: its residual per multiplier (c, c).
        goal_scale: units in which T is decomposed; 0 for conditions that nothing moves (c,).
        goal_vectors: eigenvectors of T in these units (c, c).
        goal_inverse: inverses of its eigenvalues; 0 for those that count as zero (c,).
        added: curvature added to that in entering coefficients, to that in what is free (f,), and to that in
            the unknowns of the steps.
        penalty: weight of the goal's square in the model.
        convex: whether the model is convex along all changes that keep to the goal.
    """

    forward: Float[Array, "steps z zm"]
    softness: Float[Array, "steps m m"]
    gain: Float[Array, "steps m z"]
    by_goal: Float[Array, "steps m c"]
    start: Float[Array, "z f"]
    start_stiffness: Float[Array, " f"]
    start_softness: Float[Array, "f f"]
    start_by_goal: Float[Array, "f c"]
    compliance: Float[Array, "c c"]
    goal_scale: Float[Array, " c"]
    goal_vectors: Float[Array, "c c"]
    goal_inverse: Float[Array, " c"]
    added: tuple[Float[Array, ""], Float[Array, " f"], Float[Array, ""]]
    penalty: Float[Array, " c"]
    convex: Bool[Array, ""]


class Move(eqx.Module):
    """A solution of the quadratic model.

    Attributes:
        w: changes of entering coefficients (steps, m).
        first: changes of what is free and of leading coefficients.
        goal: changes of the goal's multipliers.
        z: changes of all nodes in small numbers (steps + 1, z).
    """

    w: Float[Array, "steps m"]
    first: Float[Array, " f"]
    goal: Float[Array, " c"]
    z: Float[Array, "k z"]


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)


def _inverse(matrix: Array, negative: Array) -> tuple[Array, Array]:
    """Inverse of a symmetric matrix, and the number of its negative eigenvalues, added to that before.

    By elimination without pivoting, X A X^T = D; a pivot that vanishes counts as too many.
    """
    size = matrix.shape[0]
    if not size:
        return matrix, negative
    number, diagonal = jnp.arange(size), jnp.abs(jnp.diagonal(matrix))

    def eliminate(k: Array, both: Array) -> Array:
        row = both[k] / both[k, k]
        column = jnp.where(number > k, both[:, k], 0.0)
        return both - column[:, None] * row[None, :]

    both = jnp.concatenate([matrix, jnp.eye(size, dtype=matrix.dtype)], axis=1)
    both = jax.lax.fori_loop(0, size, eliminate, both)
    pivots, root = jnp.diagonal(both), both[:, size:]
    regular = jnp.all(jnp.abs(pivots) > SINGULAR * diagonal) & jnp.all(jnp.isfinite(both))
    inverse = root.T @ (root / jnp.where(regular, pivots, 1.0)[:, None])
    found = jnp.where(regular, negative + jnp.sum(pivots < 0), TOO_MANY)
    return jnp.where(regular, inverse, jnp.eye(size, dtype=matrix.dtype)), found


def factored(
    model: Model,
    bounds: Weighted,
    idle: Float[Array, "steps m"],
    shift: Float[Array, ""],
    penalty: Float[Array, " c"],
    softness: Float[Array, " c"],
    reach: Float[Array, ""],
    unit: Float[Array, ""],
    held: Float[Array, " f"],
    sway: Float[Array, ""],
) -> Factors:
    """Factors of the quadratic model.

    Args:
        model: the model.
        bounds: what slacks add.
        idle: 1 for coefficients that do not enter in a step, else 0.
        shift: relative increase of the curvature in the coefficients.
        penalty: weight of the goal's squared residual in the model; changes no solution that reaches it.
        softness: compliance that the goal has itself, see `Iterate`.
        reach: eigenvalues of the goal's compliance below it count as zero, see `REACH`.
        unit: of the cost.
        held: curvature added to that of the cost in what is free.
        sway: part of the increase that the unknowns of the steps get.
    """
    goal, last = model.goal, model.last_excess
    size = model.forward.shape[1]
    P = model.last_hessian + last.T @ (bounds.end[:, None] * last) + goal.T @ (penalty[:, None] * goal)
    begun = (_symmetric(P), goal.T, jnp.diag(softness), jnp.array(0))
    own = jnp.diagonal(model.hessian, axis1=1, axis2=2)[:, -idle.shape[1] :]
    steep = model.excess[:, :, -idle.shape[1] :]
    # Half of the coefficients that enter are stiffer, by their cost and their bounds.
    stiff = jnp.abs(own) + jnp.einsum("kh,khm->km", bounds.path, steep**2)
    typical = jnp.nanmedian(jnp.where(idle > 0, jnp.nan, stiff))
    typical = jnp.maximum(jnp.where(typical > 0, typical, jnp.max(stiff)), 1e-12)
    added = shift * jnp.where(jnp.isfinite(typical), typical, 1.0)

    def backward(value: tuple, given: tuple) -> tuple[tuple, tuple]:
        P, S, T, negative = value
        forward, hessian, excess, weight, extra, y = given
        hessian = hessian + added * sway * y.T @ y
        whole = _symmetric(hessian + forward.T @ P @ forward + excess.T @ (weight[:, None] * excess))
        mixed = forward.T @ S
        softness, negative = _inverse(whole[size:, size:] + jnp.diag(extra), negative)
        found = -softness @ jnp.concatenate([whole[size:, :size], mixed[size:]], axis=1)
        gain, by_goal = found[:, :size], found[:, size:]
        before = (
            _symmetric(whole[:size, :size] + whole[:size, size:] @ gain),
            mixed[:size] + whole[:size, size:] @ by_goal,
            T - mixed[size:].T @ by_goal,
            negative,
        )
        return before, (softness, gain, by_goal)

    given = (model.forward, model.hessian, model.excess, bounds.path, idle + added, model.y)
    # Products of whole matrices: the library's are quicker than one kernel.
    (P, S, T, negative), (softness, gain, by_goal) = jax.lax.scan(backward, begun, given, reverse=True)
    E = model.first
    quadratic = _symmetric(E.T @ P @ E + model.first_hessian)
    start_added = shift * (unit + jnp.abs(jnp.diagonal(quadratic))) + held
    stiffness = quadratic + jnp.diag(start_added)
    start_softness, negative = _inverse(stiffness, negative)
    start_by_goal = -start_softness @ (E.T @ S)
    T = T - (E.T @ S).T @ start_by_goal
    scale, vectors, inverse = _decomposed(_symmetric(T), reach)
    # Sylvester's law of inertia: what the curvature has negative, the goal has to forbid.
    convex = negative == jnp.sum(inverse < 0)
    return Factors(
        model.forward,
        softness,
        gain,
        by_goal,
        E,
        jnp.diagonal(stiffness),
        start_softness,
        start_by_goal,
        T,
        scale,
        vectors,
        inverse,
        (added, start_added, added * sway),
        penalty,
        convex,
    )


def _decomposed(T: Array, reach: Array) -> tuple[Array, Array, Array]:
    """Units, eigenvectors and inverse eigenvalues of the goal's compliance, without what is out of reach."""
    if not T.size:
        return T[0] if T.shape[0] else jnp.zeros(0, T.dtype), T, jnp.zeros(0, T.dtype)
    scale = jnp.sqrt(jnp.maximum(jnp.abs(jnp.diagonal(T)), 1e-300))
    scale = jnp.where(scale > FELT * jnp.max(scale), 1.0 / scale, 0.0)
    values, vectors = jnp.linalg.eigh(scale[:, None] * T * scale)
    reached = jnp.abs(values) > reach
    return scale, vectors, jnp.where(reached, 1.0 / jnp.where(reached, values, 1.0), 0.0)


def taken_back(factors: Factors, goal: Float[Array, " c"]) -> Float[Array, " c"]:
    """Changes of the goal's multipliers that leave none to what cannot be changed: they have no say."""
    scale, vectors = factors.goal_scale, factors.goal_vectors
    present = vectors.T @ jnp.where(scale > 0, goal / jnp.where(scale > 0, scale, 1.0), 0.0)
    return -scale * (vectors @ jnp.where(factors.goal_inverse != 0, 0.0, present))


def out_of_reach(factors: Factors, missing: Float[Array, " c"]) -> Float[Array, " c"]:
    """The part of the goal's residual that nothing can change."""
    scale, vectors = factors.goal_scale, factors.goal_vectors
    reached = jnp.where(factors.goal_inverse != 0, vectors.T @ (scale * missing), 0.0)
    return missing - jnp.where(scale > 0, (vectors @ reached) / jnp.where(scale > 0, scale, 1.0), 0.0)


def solve(factors: Factors, right: Right) -> Move:
    """Minimise the quadratic model with given linear terms."""
    size = factors.forward.shape[1]

    def backward(value: tuple, given: tuple) -> tuple[tuple, Array]:
        p, t = value
        gradient, forward, softness, gain, by_goal = given
        linear = gradient + forward.T @ p
        own = linear[size:]
        return (linear[:size] + gain.T @ own, t + by_goal.T @ own), -softness @ own

    f = factors
    given = (right.gradient, f.forward, f.softness, f.gain, f.by_goal)
    (p, t), step = scan_in_one_kernel(backward, (right.last, right.missing), given, reverse=True)
    linear = f.start.T @ p + right.first
    t = t + f.start_by_goal.T @ linear
    nu = f.goal_scale * (f.goal_vectors @ (f.goal_inverse * (f.goal_vectors.T @ (f.goal_scale * t))))
    first = f.start_by_goal @ nu - f.start_softness @ linear

    def forth(z: Array, given: tuple) -> tuple[Array, tuple]:
        forward, gain, step, by_goal = given
        w = gain @ z + step + by_goal @ nu
        return forward @ jnp.concatenate([z, w]), (z, w)

    last, (z, w) = scan_in_one_kernel(forth, f.start @ first, (f.forward, f.gain, step, f.by_goal))
    return Move(w, first, nu, jnp.concatenate([z, last[None]]))
