"""Loads that do unit work on the rate of a joint coordinate."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.gradient import averaged_gradient
from natcoord_jax.core.joint import Frame
from natcoord_jax.maths.collocation import gauss


class PairMotion(eqx.Module):
    """Motion of the two frames of a joint over a step: frames at the start, at the stages, rates, spins."""

    parent_start: Frame
    child_start: Frame
    parent: Frame
    child: Frame
    parent_rate: Frame
    child_rate: Frame
    parent_spin: Float[Array, "s 3"]
    child_spin: Float[Array, "s 3"]


class UnitLoad(eqx.Module):
    """Rate of a coordinate and the load that does unit work on it, at the stages.

    Attributes:
        rate: [rad/s or m/s], with h sum b_i rate_i the exact increment.
        forces: on (point, axis 1, 2, 3) of parent and child, per unit of generalised force.
        torques: on parent and child, per unit of generalised force.
    """

    rate: Float[Array, " s"]
    forces: Float[Array, "s 2 4 3"] | None
    torques: Float[Array, "s 2 3"] | None


def unit_load_of(
    invariants: Callable[[Frame, Frame], Float[Array, " p"]],
    function: Callable[[Float[Array, " p"]], Float[Array, ""]],
    pair: PairMotion,
    h: Float[Array, ""],
) -> UnitLoad:
    """Unit load of a coordinate that is a function of quadratic invariants of its two frames, for any stages.

    The averaged gradients S_i of the function along the collocated path of the invariants give the rates
    S_i . Pi'_i, whose sum is the exact increment, and the loads D pi(Q_i)^T S_i.
    """
    tableau = gauss(pair.parent_spin.shape[0])
    now, moving = (pair.parent, pair.child), (pair.parent_rate, pair.child_rate)
    rates = jax.vmap(lambda x, dx: jax.jvp(invariants, x, dx)[1])(now, moving)
    start = invariants(pair.parent_start, pair.child_start)
    resting = h == 0
    step = jnp.where(resting, 1.0, h)
    steps = jnp.where(resting, 0.0, step * rates)
    gradients = averaged_gradient(function, start, steps, tableau, None)
    loads = jax.vmap(lambda x, g: jax.vjp(invariants, *x)[1](g))(now, gradients)
    forces = [jnp.concatenate([x.point[:, None], x.axes], axis=1) for x in loads]
    return UnitLoad(jnp.sum(gradients * rates, axis=-1), jnp.stack(forces, axis=1), None)
