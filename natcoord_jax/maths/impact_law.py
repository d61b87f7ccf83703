"""The impulses of impacts at any number of contacts at once.

Contacts that close at the rates gamma, with W = G M^-1 G^T of their gaps, take impulses L >= 0. Plastic ones
end all closing, L_P = -W^+ gamma. Elastic ones give every contact the work s_i that it has taken before,

    L_i (gamma + 1/2 W L)_i = s_i,    L = argmin 1/4 L.W L + gamma.L - sum_i s_i ln L_i,

one convex problem, whatever the rank of W, without an order of the contacts. With a restitution e it is
L_P + e (L_E - L_P): of a single contact e sqrt(gamma^2 + 2 W s) is left, and of equal ones exactly
(1 - e^2) of the difference between the plastic and the elastic energies is lost.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.maths.elimination import definite_inverse, definite_solution
from natcoord_jax.maths.vectors import safe_sqrt

SHIFT = 1e-8
"""Added to the diagonal of W, in units of it; what it does is taken back by refinement."""

REFINEMENTS = 3
"""Of solutions by the shifted matrix."""

MOST = 60
"""Iterations of Newton's method for elastic impulses; ten are the most seen."""

NEGLIGIBLE = 1e-12
"""Rate of closing in terms of the largest that asks for no impulse."""

WITHIN = 0.95
"""Part of the way to where an impulse vanishes that one iteration may go."""


@jax.custom_jvp
def semidefinite_solution(matrix: Float[Array, "c c"], right: Float[Array, " c"]) -> Float[Array, " c"]:
    """Solution of equations that have one, with a symmetric matrix that need not be regular."""
    diagonal = jnp.diagonal(matrix)
    shift = SHIFT * jnp.where(diagonal > 0, diagonal, 1.0)
    inverse = definite_inverse(matrix + jnp.diag(shift))
    found = inverse @ right
    for _ in range(REFINEMENTS):
        found = found + inverse @ (right - matrix @ found)
    return found


@semidefinite_solution.defjvp
def _semidefinite_solution_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (matrix, right), (matrix_dot, right_dot) = primals, tangents
    found = semidefinite_solution(matrix, right)
    return found, semidefinite_solution(matrix, right_dot - matrix_dot @ found)


def held_alone(matrix: Float[Array, "c c"], on: Bool[Array, " c"]) -> Float[Array, "c c"]:
    """The matrix of those contacts alone, one on the diagonal of the others."""
    both = on[:, None] & on[None, :]
    return jnp.where(both, matrix, jnp.diag(jnp.where(on, 0.0, 1.0).astype(matrix.dtype)))


@jax.custom_jvp
def elastic_impulses(
    matrix: Float[Array, "c c"], rates: Float[Array, " c"], work: Float[Array, " c"], on: Bool[Array, " c"]
) -> Float[Array, " c"]:
    """L_E of the contacts that are on, zero of the others; derivatives by the implicit rule.

    Args:
        matrix: W [1/kg].
        rates: gamma [m/s].
        work: s [J], not negative; where it is zero, the rate is negative.
        on: contacts that take part.
    """
    matrix, rates, work = held_alone(matrix, on), jnp.where(on, rates, 0.0), jnp.where(on, work, 0.0)
    own = jnp.diagonal(matrix)
    alone = (jnp.sqrt(rates**2 + 2 * own * work) - rates) / own
    start = jnp.where(on, jnp.maximum(alone, 1e-9 * jnp.max(alone)), 0.0)

    def trip(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        found, count, _ = carry
        safe = jnp.where(on, found, 1.0)
        missing = jnp.where(on, 0.5 * matrix @ found + rates - work / safe, 0.0)
        change = -definite_solution(0.5 * matrix + jnp.diag(_stiffness(own, work, safe)), missing)
        shrinking = on & (change < 0)
        reach = jnp.where(shrinking, -found / jnp.where(shrinking, change, 1.0), jnp.inf)
        length = jnp.minimum(1.0, WITHIN * jnp.min(reach))
        size = jnp.max(jnp.abs(change)) / jnp.maximum(jnp.max(found), jnp.finfo(found.dtype).tiny)
        return found + length * change, count + 1, size

    begun = start, jnp.array(0), jnp.full((), jnp.inf, start.dtype)
    return jax.lax.while_loop(lambda c: (c[2] > 1e-15) & (c[1] < MOST) & jnp.any(on), trip, begun)[0]


def _stiffness(own: Array, work: Array, impulse: Array) -> Array:
    """S / L^2, and what keeps a singular W from showing."""
    return work / impulse**2 + 1e-12 * own


@elastic_impulses.defjvp
def _elastic_impulses_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    matrix, rates, work, on = primals
    matrix_dot, rates_dot, work_dot, _ = tangents
    found = elastic_impulses(matrix, rates, work, on)
    safe = jnp.where(on, found, 1.0)
    own = held_alone(matrix, on)
    missing = 0.5 * matrix_dot @ found + rates_dot - work_dot / safe
    stiff = 0.5 * own + jnp.diag(jnp.where(on, _stiffness(jnp.diagonal(own), work, safe), 0.0))
    return found, -definite_solution(stiff, jnp.where(on, missing, 0.0))


def impact_impulses(
    matrix: Float[Array, "c c"],
    rates: Float[Array, " c"],
    work: Float[Array, " c"],
    restitution: Float[Array, " c"],
    active: Bool[Array, " c"],
    met: Bool[Array, " c"],
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Impulses of the contacts at the end of a step [N s]: plastic ones, and all of them.

    Args:
        matrix: W [1/kg].
        rates: gamma [m/s].
        work: s that each of them has taken in the step [J].
        restitution: e [-] of each.
        active: contacts that have pushed.
        met: those among them that were open before. The others lose speed across the contact alone.
    """
    held = held_alone(matrix, active)
    plastic = -semidefinite_solution(held, jnp.where(active, rates, 0.0))
    elastic = elastic_impulses(matrix, rates, work, met & ((work > 0) | (rates < 0)))
    change = jnp.where(active, restitution * (elastic - plastic), 0.0)
    # Of different restitutions the mixture may give energy: then it is that much nearer to the plastic one.
    room = jnp.sum(jnp.where(active, work - plastic * (rates + 0.5 * held @ plastic), 0.0))
    needed = 0.5 * change @ (held @ change)
    excess = needed > room
    part = jnp.where(excess, safe_sqrt(room / jnp.where(excess, needed, 1.0)), 1.0)
    plastic = jnp.where(active, plastic, 0.0)
    return plastic, plastic + part * change


def pressing_impulses(
    matrix: Float[Array, "c c"], rates: Float[Array, " c"], on: Bool[Array, " c"]
) -> Float[Array, " c"]:
    """Impulses that end the closing of contacts and pull at none: L >= 0, gamma + W L >= 0, one of them 0.

    Which contacts push is found by changing all at once that are on the wrong side; derivatives hold it.

    Args:
        matrix: W [1/kg].
        rates: gamma [m/s].
        on: contacts that may push.
    """
    own = jnp.where(on, jnp.diagonal(matrix), 1.0)
    fixed, given = jax.lax.stop_gradient((held_alone(matrix, on), jnp.where(on, rates, 0.0)))

    def trip(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        pushing, count, _ = carry
        found = semidefinite_solution(held_alone(fixed, pushing), jnp.where(pushing, -given, 0.0))
        left = (given + fixed @ found) / own
        after = on & jnp.where(pushing, found > 0, left < -NEGLIGIBLE * jnp.max(jnp.abs(given / own)))
        return after, count + 1, jnp.any(after != pushing)

    start = on & (rates < 0), jnp.array(0), jnp.array(True)
    pushing = jax.lax.while_loop(lambda c: c[2] & (c[1] < MOST), trip, start)[0]
    return semidefinite_solution(held_alone(matrix, pushing), jnp.where(pushing, -rates, 0.0))


def collision_impulses(
    matrix: Float[Array, "c c"],
    rates: Float[Array, " c"],
    restitution: Float[Array, " c"],
    on: Bool[Array, " c"],
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Impulses of contacts that touch, at the instant at which some of them meet [N s]: plastic ones, all.

    With no work taken before, L_E = 2 L_P: every contact that pushes separates at the part e of the speed at
    which it has closed, and (1 - e^2) of the energy of a plastic impact is lost.

    Args:
        matrix: W [1/kg].
        rates: gamma [m/s].
        restitution: e [-] of each.
        on: contacts that touch.
    """
    plastic = pressing_impulses(matrix, rates, on)
    change = restitution * plastic
    room, needed = plastic @ (matrix @ plastic), change @ (matrix @ change)
    excess = needed > room
    part = jnp.where(excess, safe_sqrt(room / jnp.where(excess, needed, 1.0)), 1.0)
    return plastic, plastic + part * change
