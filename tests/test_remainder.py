"""What rounding leaves of a step's balances is handed on to the next."""

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from scenes import pair, with_multipliers

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.stepping import attempt
from natcoord_jax.stepping import remainder as subject


def equations_of(order, form):
    system, state = pair(nc.Revolute if form == "tree" else with_multipliers(nc.Revolute))
    tableau = nc.EnergyMomentum(order=order).tableau
    return prepare(system, state, jnp.zeros((tableau.stages, 0)), jnp.array(0.01), tableau)


@pytest.mark.parametrize("form", ["tree", "multipliers"])
@pytest.mark.parametrize("order", [2, 4])
def test_every_stage_gets_the_same(order, form):
    """An impulse at all stages, and its mean over them, are each other's inverse; multipliers get nothing."""
    equations = equations_of(order, form)
    y = equations.guess()
    impulse = 1e-17 * jnp.arange(1.0, 1.0 + equations.by_stage(y).shape[1])
    residual = subject.with_remainder(equations, jnp.zeros_like(y), impulse)
    np.testing.assert_array_equal(equations.by_stage(residual), jnp.tile(impulse, (order // 2, 1)))
    np.testing.assert_array_equal(residual[equations.balances :], 0.0)
    found = subject.remainder(equations, residual, jnp.ones_like(y))
    np.testing.assert_allclose(found, impulse, rtol=1e-15)


def test_beside_stiff_forces_nothing_is_handed_on():
    equations = equations_of(2, "tree")
    y = equations.guess()
    inertias = jnp.ones_like(y).at[0].set(0.0)  # a rate without inertia has no say in it
    for size, handed in ((1e-16, True), (1e-12, False)):
        residual = equations.repeated(jnp.full(equations.by_stage(y).shape[1], size))
        found = subject.remainder(equations, residual, inertias)
        np.testing.assert_array_equal(found, equations.by_stage(residual)[0] * handed)


def drift_of(name, steps=4000):
    """Of the energy over the run, root mean square, in terms of what moves."""
    scene = gallery.load(name)
    # Within jit the number of steps is a part of the program.
    run = nc.jit(lambda state: nc.simulate(scene.system, state, dt=2e-3, steps=steps))
    found = account(scene.system, run(scene.state))
    energy = found.kinetic + sum(found.stores.values())
    return float(np.sqrt(np.mean((energy - energy[0]) ** 2)) / found.energy_scale)


@pytest.mark.parametrize("name", ["heavy_top", "double_pendulum"])
def test_rounding_does_not_add_up(name, monkeypatch):
    """Energy walks far less than if every step began anew."""
    with_it = drift_of(name)
    assert with_it <= tol.HANDED_ON
    monkeypatch.setattr(attempt, "remainder", lambda equations, *given: 0.0 * equations.by_stage(given[0])[0])
    # Another number of steps is another program.
    assert drift_of(name, 4001) >= 3.0 * with_it
