"""Gradients of place, energy and frequency of a shell by everything that it is made of, and by its loads.

Each number is a factor of what the shell is given; differences are V-shaped along each of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import assert_v_shaped

import natcoord_jax as nc

pytestmark = pytest.mark.exhaustive

FACTORS = ("E", "thickness", "density", "prestress", "shape along x", "shape across", "load")
"""The last: of a force that varies over the loads, or the steps, one number of them after the other."""


@pytest.fixture(scope="module")
def plate():
    """A warped plate, held along an edge, under its weight and a force on a corner."""
    mesh = nc.mesh.rectangle((1.0, 0.5), (3, 2))
    bent = mesh.nodes + 0.05 * np.stack([0 * mesh.nodes[:, 0]] * 2 + [np.sin(3 * mesh.nodes[:, 0])], axis=1)
    metal = nc.Elastic(E=2e5, nu=0.3, density=1200.0)
    scene = nc.Scene()
    shell = nc.Shell(
        nc.mesh.Mesh(bent, mesh.cells, mesh.sets),
        thickness=0.1, material=metal, prestress=(300.0, 200.0, 50.0), name="plate",
    )  # fmt: skip
    shell = scene.add(shell)
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    scene.add(nc.Gravity())
    corner = shell.set("right")[2]
    scene.add(nc.BodyForceInput((nc.Point(corner), nc.Direction(nc.ground, (0, 0, 1))), name="push"))
    system, state = scene.compile()
    return system, state, system.body_index(corner)


def changed(system, factors):
    """The system with numbers times the factors."""
    numbers = {
        key: system.get("plate", key) for key in ("E", "thickness", "density", "prestress", "reference")
    }
    scaled = {key: factors[k] * numbers[key] for k, key in enumerate(FACTORS[:4])}
    stretch = jnp.concatenate([jnp.stack([factors[4], factors[5]]), jnp.ones(1)])
    return system.set("plate", reference=stretch * numbers["reference"], **scaled)


def observed(system, state, corner):
    """Height of the corner, and energy, of order one."""
    return jnp.stack([10 * state.q[4 * corner, 2], system.energy(state).stores["plate"]])


def in_statics(plate, factors):
    """Of the equilibrium under the last of three loads."""
    system, state, corner = plate
    other = changed(system, factors)
    force = (1 + jnp.arange(3.0) * factors[6])[:, None]
    found = nc.equilibrium(other, state, jnp.arange(3.0), inputs=force, throw=False)
    return observed(other, found.state, corner)


def in_dynamics(plate, factors):
    """After eight steps under a force that grows."""
    system, state, corner = plate
    other = changed(system, factors)
    force = (20 + jnp.arange(8.0) * factors[6])[:, None]
    run = nc.simulate(other, state, dt=5e-3, inputs=force)
    return observed(other, jax.tree.map(lambda x: x[-1], run.states), corner)


def in_frequency(plate, factors):
    """Of the first vibrations about the equilibrium."""
    system, state, _ = plate
    other = changed(system, factors)
    rest = nc.equilibrium(other, state, jnp.ones(1), inputs=factors[6] * jnp.ones((1, 1)), throw=False).state
    return nc.modes(other, rest, inputs=factors[6] * jnp.ones(1), damped=False).frequencies[:2]


@pytest.mark.parametrize("of", [in_statics, in_dynamics, in_frequency])
def test_gradients_by_all_numbers(plate, of):
    """Each on its own, of both values."""
    value = jax.jit(lambda factors: of(plate, factors))
    ones = jnp.ones(len(FACTORS))
    slopes = jax.jit(jax.jacrev(lambda factors: of(plate, factors)))(ones)
    for k, name in enumerate(FACTORS):
        for row in range(2):
            try:
                assert_v_shaped(
                    lambda x, row=row: value(x)[row], ones, jnp.eye(len(FACTORS))[k], slopes[row, k]
                )
            except AssertionError as error:
                raise AssertionError(f"{name}, value {row}: {error}") from None
