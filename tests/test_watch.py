"""What is missing in the equations of a step shows in its energy, and steps in which it does are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import pair, with_multipliers

import natcoord_jax as nc
from natcoord_jax.assembly.equations import prepare
from natcoord_jax.stepping import watch as subject
from natcoord_jax.stepping.factors import factors_of
from natcoord_jax.stepping.newton import TOLERANCE, newton
from natcoord_jax.stepping.step import advance

FORMS = {"tree": nc.Revolute, "multipliers": with_multipliers(nc.Revolute)}


@pytest.fixture(scope="module", params=[(2, "tree"), (4, "tree"), (2, "multipliers"), (4, "multipliers")])
def solved(request):
    """Equations of a step, their solution, and what follows from unknowns next to it."""
    order, form = request.param
    system, state = pair(FORMS[form])
    tableau = nc.EnergyMomentum(order=order).tableau
    given = state, jnp.zeros((tableau.stages, len(system.structure.inputs))), jnp.array(0.02)
    equations = prepare(system, *given, tableau)
    y, code = newton(equations, TOLERANCE)
    assert code == 0
    return equations, y, jax.jit(lambda y: advance(system, *given, y, tableau))


def off(equations, y, size):
    """Unknowns next to the solution: rates are wrong."""
    noise = np.random.default_rng(3).normal(size=equations.balances)
    return y.at[: equations.balances].add(size * noise)


def test_energy_changes_by_the_work_of_the_residual(solved):
    """Exactly, however wrong the rates are; with multipliers the bound holds that their work is added to."""
    equations, y, step = solved
    wrong = off(equations, y, 1e-3)
    residual, after, _ = step(wrong)
    change = equations.system.energy(after).total - equations.system.energy(equations.state).total
    found = subject.unbalanced_work(equations, wrong, residual)
    assert abs(change) >= 1e-5
    if equations.balances == y.shape[0]:
        np.testing.assert_allclose(found, abs(change), rtol=1e-9)
    assert found >= 0.999 * abs(change)


@pytest.mark.parametrize("tolerance, allowed", [(TOLERANCE, 1e-12), (1e-8, 1e-4)])
def test_only_what_is_solved_is_sound(solved, tolerance, allowed):
    """Errors well below what is allowed pass, larger ones do not; a larger tolerance allows more."""
    equations, y, step = solved

    factors = factors_of(equations, equations.jacobian(y))

    def sound(size, missing=1.0):
        wrong = off(equations, y, size)
        residual, after, _ = step(wrong)
        terms, correction = equations.evaluate(wrong).size, missing * factors.solver.solve(residual)
        correction = jnp.sqrt(jnp.sum(factors.inertias * correction**2))
        return bool(subject.sound(equations, wrong, residual, terms, correction, after, tolerance))

    assert sound(0.0)
    assert sound(1e-3 * allowed)
    assert not sound(1e3 * allowed)
    # What moves places by their rounding only is as good as numbers of their length can be.
    assert sound(1e3 * allowed, missing=1e-9)
