"""Whether a motion that misses its goal is as near to it as inputs can come: a certificate to first order."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.control.guess import input_ranges
from natcoord_jax.control.iterate import Iterate
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.control.proposal import formed
from natcoord_jax.control.transcription import enters_in
from natcoord_jax.core.compiled import compiled


def unreached(problem: OptimalControl, iterate: Iterate, scale: Float[Array, " c"]) -> float:
    """Part of what is missing to the goal that inputs within all bounds leave, to first order.

    A linear program for the least sum of what is missing: bounds hold to first order along the changed
    motion, inputs change by their range at most, time and parameters by their scale.

    Args:
        problem: the problem.
        iterate: a motion.
        scale: of the conditions of the goal.
    """
    # It takes longer to import than all the rest.
    from scipy.optimize import linprog

    missed = np.asarray(iterate.path.end.missing / scale)
    missing, along, last, far = (np.asarray(x, float) for x in _slopes(problem, iterate))
    used, count = far > 0, missed.size
    missing, bounds = missing[:, used] / np.asarray(scale)[:, None], np.concatenate([along, last])[:, used]
    excess = np.concatenate([np.ravel(x) for x in (iterate.path.stages.excess, iterate.path.end.excess)])
    left, none, free = np.eye(count), np.zeros((excess.size, count)), int(np.count_nonzero(used))
    rows = np.block([[missing, -left], [-missing, -left], [bounds, none]])
    sides = np.concatenate([-missed, missed, np.maximum(-excess, 0.0)])
    limits = [(-x, x) for x in far[used]] + [(0, None)] * count
    found = linprog(np.concatenate([np.zeros(free), np.ones(count)]), rows, sides, bounds=limits)
    return float(found.fun / np.sum(np.abs(missed))) if found.status == 0 else 0.0


@compiled
def _slopes(problem: OptimalControl, iterate: Iterate) -> tuple[Array, Array, Array, Array]:
    """Goal and excesses per what is free and per entering coefficient, and how far each of these may go."""
    found = formed(problem, iterate)
    flat, unflat = ravel_pytree((iterate.derivatives.by_first, iterate.derivatives.by_w))

    def change(unit: Array) -> tuple[Array, Array, Array]:
        first, w = unflat(unit)

        def forth(z: Array, given: tuple) -> tuple[Array, Array]:
            forward, excess, w = given
            both = jnp.concatenate([z, w])
            return forward @ both, excess @ both

        last, excess = jax.lax.scan(forth, found.first @ first, (found.forward, found.excess, w))
        return found.goal @ last, excess.reshape(-1), found.last_excess @ last

    columns = jax.vmap(change, out_axes=1)(jnp.eye(flat.size))
    enters = enters_in(problem)
    whole = 2.0 * input_ranges(problem, iterate.unknowns)
    leading = jnp.broadcast_to(whole, (problem.inputs.degree, problem.channels)).reshape(-1)
    first = jnp.concatenate([jnp.ones(iterate.unknowns.free.size), leading])
    far, _ = ravel_pytree((first, jnp.where(enters, whole, 0.0)))
    return *columns, far
