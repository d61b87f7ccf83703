"""The end of a variational step: half of its forces take hold there, constraints keep the velocity tangent.

The mid-point rule as a discrete variational principle (Marsden & West 2001, 1.5 and 3.4; with constraints in
the null space Leyendecker, Marsden & Ortiz 2008): with the mean velocity V = (q_1 - q_0)/h of a step and the
impulses of its potentials on either end,

    start    P(q_0)^T [2 M (V - v_0) - h F_0] = 0,    g(q_1) = 0,
    end      P(q_1)^T [2 M (v_1 - V) - h F_1] = 0,    v_1 = P(q_1) w_1,

F_0 and F_1 being the forces of one step with their levers at q_0 and at q_1. The first line is solved by
Newton's iteration, the second is linear. `TangentSpace` knows P, the constraints of loops and what drives
prescribe.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import definite_solution
from natcoord_jax.maths.impact_law import semidefinite_solution
from natcoord_jax.mechanics.equations_of_motion import EquationsOfMotion, relations_of
from natcoord_jax.mechanics.kick import Ends, end_of, rotor_rates
from natcoord_jax.mechanics.momentum import momentum_balance
from natcoord_jax.mechanics.response import Evaluation, no_multipliers
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity, prescribing
from natcoord_jax.model.model import Model


def released(equations: Any, found: Evaluation, turning: Float[Array, "1 coordinates"]) -> Ends:
    """Velocity at the end of a variational step, and the work of drives that is booked there.

    Args:
        equations: of the step.
        found: their solution.
        turning: mean rates of all joint coordinates.
    """
    space = TangentSpace.at(equations.system, end_of(equations, found.at))
    impulse = _impulse(space, equations, found)
    rotors = rotor_rates(equations, found.at)[0]
    if rotors.shape[0]:
        impulse = impulse + space.turning @ (space.inertias * rotors)
    v = space.with_momentum(impulse)
    lost = impulse - space.pulled(space.impulse(v))
    assert space.admissible.lift is not None
    missed = -space.admissible.lift.T @ lost
    return Ends(v, _work(equations, found, turning[0], missed), jnp.array(True))


def obeying(system: Model, end: State) -> Ends:
    """The velocity at the end of a step that goes on as drives prescribe, and the work that this takes.

    Collocation moves what is driven by what drives ask for, and reflects its velocity at the mean one of the
    step: where the rate jumps, it would alternate about what is prescribed for good. What changes is
    orthogonal to all that is admitted, so that it is nothing to the motion.
    """
    balances, drives = EquationsOfMotion.at(system, end), prescribing(system)
    gains = balances.columns()
    space, mass = TangentSpace.without_frame(balances, gains)
    v, matrix = Velocity(end.row_rates, end.rates), gains.constraints.T
    found = definite_solution(
        0.5 * (mass + mass.T), jnp.column_stack([matrix.T, space.pulled(space.impulse(v))])
    )
    answers, w = found[:, :-1], found[:, -1]
    missing = jnp.where(drives, -balances.rates(w).constraints, 0.0)
    impulses = semidefinite_solution(matrix @ answers, missing)
    change, rates = space.spread(answers @ impulses), matrix @ w
    work = jnp.where(drives, impulses * (rates + 0.5 * missing), 0.0)
    # Loops that velocities do not obey quite have a share in it.
    work = work + drives * (impulses @ (rates + 0.5 * missing) - jnp.sum(work)) / np.sum(drives)
    return Ends(v + change, work, jnp.array(True))


def _impulse(space: TangentSpace, equations: Any, found: Evaluation) -> Float[Array, " u"]:
    """P(q_1)^T [M V + h/2 F_1], without rotors."""
    at, (situations, _), h, tableau = found.at, found.given, equations.h, equations.tableau
    force_rows = at.start + h * at.rates[0]
    acting = [
        (group, where)
        for group, where in zip(equations.groups, situations)
        if not group.multipliers and not group.effect.rotors
    ]
    missing = momentum_balance(
        equations.system,
        [group for group, _ in acting],
        [where for _, where in acting],
        replace_fields(at, force_rows=force_rows[None]),
        2.0 * at.rates[0, :-1],
        [no_multipliers(group, tableau, force_rows.dtype) for group, _ in acting],
        h,
        tableau,
    )
    return -0.5 * space.generalised(missing.force[0], missing.torque[0])


def _work(
    equations: Any, found: Evaluation, turning: Float[Array, " coordinates"], impulses: Float[Array, " c"]
) -> Float[Array, " relations"]:
    """Of relations: half of what the step has booked is done at its end instead, by the impulses there."""
    if not relations_of(equations.system):
        return jnp.zeros(0, turning.dtype)

    def mean(effect, index):
        return effect.coefficients() @ turning[index]

    done, position = [], 0
    for group, power in zip(equations.groups, found.power):
        if group.holds and group.source != "joint":
            size = group.count * group.multipliers
            here, position = impulses[position : position + size], position + size
            if group.source == "coordinates":
                done.append(
                    here * jax.vmap(mean)(group.effect, np.asarray(group.coordinates)) - 0.5 * power[:, 0]
                )
            else:
                done.append(jnp.zeros_like(here))
    return jnp.concatenate(done)
