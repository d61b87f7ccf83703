"""What is missing in the equations of a step shows in its energy, and steps in which it does are refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import pair, with_multipliers

import natcoord_jax as nc
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.stepping import energy_check as subject
from natcoord_jax.stepping.factors import factors_of
from natcoord_jax.stepping.newton import TOLERANCE, newton
from natcoord_jax.stepping.step import advance

FORMS = {"tree": nc.Revolute, "multipliers": with_multipliers(nc.Revolute)}


LONG = (4, "tree"), (2, "multipliers")


@pytest.fixture(
    scope="module",
    params=[(2, "tree"), (4, "multipliers"), *(pytest.param(x, marks=pytest.mark.slow) for x in LONG)],
)
def solved(request):
    """Next to the solution of a step: change of energy and work of the residual, and whether it is sound."""
    order, form = request.param
    system, state = pair(FORMS[form])
    tableau = nc.EnergyMomentum(order=order).tableau
    given = state, jnp.zeros((tableau.stages, len(system.structure.inputs))), jnp.array(0.02)
    y, code = jax.jit(lambda: newton(prepare(system, *given, tableau), TOLERANCE))()
    assert code == 0

    def near(size):
        equations = prepare(system, *given, tableau)
        noise = np.random.default_rng(3).normal(size=equations.balances)
        wrong = y.at[: equations.balances].add(size * noise)  # rates are wrong
        return equations, wrong, *advance(system, *given, wrong, tableau)[:2]

    @jax.jit
    def work(size):
        equations, wrong, residual, after = near(size)
        change = system.energy(after).total - system.energy(state).total
        return change, subject.unbalanced_work(equations, wrong, residual)

    @partial(jax.jit, static_argnums=0)
    def sound(tolerance, size, missing=1.0):
        equations, wrong, residual, after = near(size)
        factors = factors_of(equations, equations.jacobian(y))
        terms, correction = equations.evaluate(wrong).size, missing * factors.solver.solve(residual)
        correction = jnp.sqrt(jnp.sum(factors.inertias * correction**2))
        return subject.sound(equations, wrong, residual, terms, correction, after, tolerance)

    return form, work, sound


def test_energy_changes_by_the_work_of_the_residual(solved):
    """Exactly, however wrong the rates are; with multipliers the bound holds that their work is added to."""
    form, work, _ = solved
    change, found = work(1e-3)
    assert abs(change) >= 1e-5
    if form == "tree":
        np.testing.assert_allclose(found, abs(change), rtol=1e-9)
    assert found >= 0.999 * abs(change)


@pytest.mark.slow
@pytest.mark.parametrize("tolerance, allowed", [(TOLERANCE, 1e-12), (1e-8, 1e-4)])
def test_only_what_is_solved_is_sound(solved, tolerance, allowed):
    """Errors well below what is allowed pass, larger ones do not; a larger tolerance allows more."""
    *_, sound = solved
    assert sound(tolerance, 0.0)
    assert sound(tolerance, 1e-3 * allowed)
    assert not sound(tolerance, 1e3 * allowed)
    # What moves places by their rounding only is as good as numbers of their length can be.
    assert sound(tolerance, 1e3 * allowed, missing=1e-9)
