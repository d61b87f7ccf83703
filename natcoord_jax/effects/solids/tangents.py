"""Derivatives of the forces of elements of solids, in formulas, for Newton's iteration."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.closed_tangents import HALF, by_twists
from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.together import instances_last, place_together
from natcoord_jax.effects.hyperelastic import tensors_of
from natcoord_jax.maths.symmetric import PAIRS, full


def solid_tangents(
    element: Any, place: Float[Array, "n k 4"], motion: Motion, now: StepContext, *, turning: bool
) -> Float[Array, "n k 1 r k 1 r"]:
    """Derivatives of the wrenches of elements by the twists of their nodes, for one stage.

    With strains that change by B_m D x along a step and by B_1 d(D x) at its end, forces are -B_m^T S w and

        -d f = B_m^T (w dS/dE B_1 + dS/dp w dp) d(D x) + 1/2 (grad N_a . S grad N_b) w d(D x).

    A projected pressure p depends on all points of its element, by as many functions as it is projected on.

    Args:
        element: elements with stacked numbers.
        place: weights of the rows of the bodies in the nodes.
        motion: of the bodies.
        now: of the step.
        turning: whether bodies turn.
    """
    last, weights, start = instances_last((element, place, motion.start))
    rows, rates = instances_last((motion.rows[0], motion.rates[0]))
    begun, middle, moved = (place_together(weights, x) for x in (start, rows, now.h * rates))
    strain = last.by_point(last.invariants(begun))
    step = last.by_point(jax.jvp(last.invariants, (middle,), (moved,))[1])
    pressure = last.mean_pressure(strain, step)

    def stress(step: Array, pressure: Array | None = pressure) -> Array:
        return last.material.mean_stress(strain, step, pressure)

    units = jnp.broadcast_to(jnp.eye(6)[:, :, None, None], (6, *step.shape))
    found, by_strain = jax.vmap(lambda unit: jax.jvp(stress, (step,), (unit,)), out_axes=(None, 0))(units)
    # Elements first: the products are of matrices.
    across, along = (_strain_rates(last.gradients, x) for x in (middle, begun + moved))
    law = jnp.transpose(last.volumes * by_strain, (3, 2, 1, 0))
    count, points, _, size = along.shape
    whole = across.reshape(count, -1, size).swapaxes(1, 2) @ (law @ along).reshape(count, -1, size)
    if pressure is not None:
        whole = whole + _by_pressure(last, strain, step, stress, across, along)
    gradients = jnp.moveaxis(last.gradients, -1, 0)
    pulled = jnp.transpose(full(last.volumes * found), (3, 2, 0, 1))
    pulled = jnp.moveaxis(gradients @ pulled, 1, 2).reshape(count, size // 3, -1)
    geometric = HALF * pulled @ jnp.moveaxis(gradients, 1, 2).reshape(count, size // 3, -1).swapaxes(1, 2)
    whole = whole + (geometric[:, :, None, :, None] * jnp.eye(3)[:, None, :]).reshape(count, size, size)
    forces = -jax.vmap(last.pulled_back)(middle[None], (last.volumes * found).reshape(1, -1, count))[0]
    on_nodes = jnp.moveaxis(forces, -1, 0)[:, :, None]
    return by_twists(whole, on_nodes, place[:, :, None], motion, now.h, turning)


def _strain_rates(gradients: Float[Array, "g k 3 n"], x: Float[Array, "k 3 n"]) -> Float[Array, "n g 6 u"]:
    """Changes of the strains by those of the components of the nodes."""
    f = jnp.sum(gradients[:, :, :, None] * x[None, :, None], axis=1)
    found = []
    for i, j in PAIRS:
        one = gradients[:, :, i, None] * f[:, None, j]
        found.append(one if i == j else one + gradients[:, :, j, None] * f[:, None, i])
    whole = jnp.stack(found)
    return jnp.moveaxis(whole.reshape(6, len(gradients), -1, x.shape[-1]), (3, 1, 0), (0, 1, 2))


def _by_pressure(
    last: Any, strain: Array, step: Array, stress: Any, across: Array, along: Array
) -> Float[Array, "n u u"]:
    """What the pressure of an element adds, which depends on the volumes of all its points."""
    begun, ended = tensors_of(strain), tensors_of(strain + step)
    before, after = jnp.sqrt(begun.c), jnp.sqrt(ended.c)
    ones = jnp.ones_like(after)
    slope = jax.jvp(
        lambda J: last.material.pressure(last.project(before), J), (last.project(after),), (ones,)
    )[1]
    pull = jax.jvp(lambda p: stress(step, p), (jnp.zeros_like(ones),), (ones,))[1]
    # dJ = G : dC / (2 J), in which shears are there twice.
    volume = ended.G / after
    modes, volumes = last.modes, last.volumes
    shares = jnp.einsum("gin,gn,gjn->nij", modes, volumes * slope, modes)
    left = jnp.einsum("ngcu,cgn,gin->niu", across, volumes * pull, modes)
    right = jnp.einsum("ngcu,cgn,gin->niu", along, volumes * volume, modes)
    return jnp.swapaxes(left, 1, 2) @ (shares @ right)
