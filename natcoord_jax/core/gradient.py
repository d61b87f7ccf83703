"""The discrete gradient of an energy of invariants, by averaging along their collocated path.

For V(q) = E(pi(q)) with invariants pi at most quadratic, the invariants move along the polynomial that
the stages give them, and the force is that of the gradient averaged along it. For one stage the average
runs along the straight line pi_0 + tau (pi_1 - pi_0). Where the quadrature is exact, so is the energy
balance; what remains for other energies is removed along the increment, as in Gonzalez' quotient but in
proportion to what each component of the gradient changes by, and only while it exceeds round-off: there is
no quotient near rest, hence no wrong second derivative.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.collocation import Tableau, invariant_quadrature
from natcoord_jax.maths.vectors import largest, safe_divide

LEAST = 1e-9
"""Relative change of the invariants below which nothing can be missing but round-off."""

SPREAD = 64
"""Rounding errors of a slope by which it must change along the step for the change to tell anything."""

SHARE = 1e-4
"""Relative change of an invariant that shows the stiffness: small, its square far above rounding."""


def averaged_gradient(
    energy: Callable[[Float[Array, "p *n"]], Float[Array, "*n"]],
    start: Float[Array, "p *n"],
    steps: Float[Array, "s p *n"],
    tableau: Tableau,
    degree: int | None,
    points: int | None = None,
    slope: Callable[[Float[Array, "p *n"]], Float[Array, "p *n"]] | None = None,
    units: tuple[int, ...] | None = None,
) -> Float[Array, "s p *n"]:
    """Gradients S_i [J per unit of invariant] with sum_i b_i S_i . steps_i = E(end) - E(start).

    For the variational mid-point rule the gradient at the mean of the invariants, whose work is the change of
    energy up to terms of third order in the steps.

    Args:
        energy: function of the invariants, shape (p,) to scalar [J]; of many instances at once (last axis)
            if start and steps have such an axis.
        start: invariants at the start of the step.
        steps: h times their rates at the stages.
        tableau: the collocation method.
        degree: polynomial degree of `energy`, or None if it is no polynomial.
        points: of the quadrature if it is no polynomial; default two more than twice the stages.
        slope: gradient of `energy`; None: by reverse mode.
        units: numbers of consecutive invariants that have the same unit; None: all have.
    """
    if tableau.variational:
        return jax.grad(energy)(start + 0.5 * steps[0])[None]
    if degree is not None:
        points = max(tableau.stages, -(-degree * tableau.stages // 2))
    elif points is None:
        points = 2 + 2 * tableau.stages
    integrals, averages = invariant_quadrature(tableau.stages, points)
    path = start + _mixed(integrals, steps)
    slopes = jax.vmap(slope or partial(gradient_of, energy))(path)
    gradient = _mixed(averages, slopes)
    if degree is not None:
        return gradient
    weights = np.reshape(tableau.b, (-1, *(1,) * start.ndim))
    increment = jnp.sum(weights * steps, axis=0)
    before, after = energy(start), energy(start + increment)
    captured = jnp.sum(weights * gradient * steps, axis=(0, 1))
    missing = (after - before) - captured
    # In proportion to what each gradient changes by: what is soft stays soft, and hardly moved, unmoved.
    # A change within rounding, by a step that is itself nothing but rounding, would be any stiffness.
    epsilon = jnp.finfo(start.dtype).eps
    moved = largest(jnp.abs(steps))
    changed = largest(slopes) + largest(-slopes)
    changed = jnp.where(changed > SPREAD * epsilon * largest(jnp.abs(slopes)), changed, 0.0)
    # A kink can hide between the points: then in proportion to the steps, beside the largest invariant of the
    # same unit; where one is zero, as in a straight beam, it is rounded as that is.
    scale = jnp.abs(start) + jnp.abs(increment)
    beside = _largest(scale, units or (scale.shape[0],))
    inverse = safe_divide(jnp.ones_like(beside), beside)
    relative = steps * inverse
    # Near its minimum an energy is less certain than its digits say: invariants are rounded before it.
    rounded = largest(jnp.sum(jnp.abs(gradient) * scale, axis=1))
    sizes = jnp.abs(before) + jnp.abs(after) + jnp.abs(captured) + rounded
    noise = 16 * epsilon * sizes
    # An energy that is not a number, whatever its slope is, is no rounding and makes the step fail.
    rounding = jnp.abs(missing) <= noise
    irrelevant = rounding | (jnp.sum(weights * relative**2, axis=(0, 1)) <= LEAST**2)
    # What is irrelevant must not reach a quotient: its derivatives need not be finite. Nor is any energy or
    # stiffness squared, of which laws that decay exponentially have 1e-260.
    # A step that is rounding of its invariant tells no stiffness either.
    still = irrelevant | (moved <= SPREAD * epsilon * beside)
    stiffness = jnp.where(still, 0.0, safe_divide(changed, jnp.where(still, 1.0, moved)))
    stiff = stiffness * steps
    enough = jnp.sum(weights * stiff * steps, axis=(0, 1)) > jnp.abs(missing)
    share = jnp.where(enough, stiff, jnp.where(irrelevant, 0.0, relative * inverse))
    measure = jnp.sum(weights * share * steps, axis=(0, 1))
    factor = safe_divide(jnp.where(rounding, 0.0, missing), jnp.where(irrelevant, 1.0, measure))
    return gradient + factor * share


def cancelling_energy(
    energy: Callable[[Float[Array, " p"]], Float[Array, ""]],
    invariants: Float[Array, " p"],
    units: tuple[int, ...] | None = None,
) -> Float[Array, ""]:
    """What the terms that cancel in the gradient of an energy would do along the whole of the invariants [J].

    At rest a stiff part has no gradient at all, but it is a difference: of stiffness times invariants, and of
    the same where it is unstressed. By these it is rounded. On both sides, since stops are stiff on one.

    Args:
        energy: of the invariants.
        invariants: at which.
        units: as in `averaged_gradient`.
    """
    count = invariants.shape[0]
    scale = _largest(jnp.abs(invariants), units or (count,))
    changes = SHARE * scale * jnp.eye(count, dtype=scale.dtype)
    found = jax.vmap(energy)(invariants + jnp.concatenate([changes, -changes, jnp.zeros_like(changes[:1])]))
    ahead, behind = found[:count], found[count:-1]
    work = jnp.abs(ahead - behind) / (2 * SHARE) + jnp.abs(ahead - 2 * found[-1] + behind) / SHARE**2
    return jnp.sum(jnp.where(jnp.isfinite(work), work, 0.0))


def _largest(scale: Float[Array, "p *n"], units: tuple[int, ...]) -> Float[Array, "p *n"]:
    """The largest of the sizes that have the same unit, for each."""
    ends = np.cumsum(units)
    parts = [largest(scale[end - count : end]) for count, end in zip(units, ends)]
    return jnp.stack([part for part, count in zip(parts, units) for _ in range(count)])


def gradient_of(
    energy: Callable[[Float[Array, "p *n"]], Float[Array, "*n"]], invariants: Float[Array, "p *n"]
) -> Float[Array, "p *n"]:
    """Gradient of a function of the invariants, of one instance or of many at once (last axis)."""
    value, pulled = jax.vjp(energy, invariants)
    if jnp.shape(value) != invariants.shape[1:]:
        owner = getattr(energy, "__self__", None)
        whose = "an energy" if owner is None else f"{type(owner).__name__}.energy"
        raise ValueError(f"{whose} has shape {value.shape}; make it a number, as `invariants[0]` is")
    return pulled(jnp.ones_like(value))[0]


def _mixed(weights: np.ndarray, x: Float[Array, "s *rest"]) -> Float[Array, "r *rest"]:
    """Sums over the first axis, of any size without a call into a library."""
    return jnp.sum(weights.reshape(*weights.shape, *(1,) * (x.ndim - 1)) * x, axis=1)


def averaged_coupling(stages: int) -> np.ndarray:
    """How averaged gradients of an energy of constant curvature H follow the steps: H (coupling steps)."""
    integrals, averages = invariant_quadrature(stages, 2 * stages)
    return averages @ integrals
