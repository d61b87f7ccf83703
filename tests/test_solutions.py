"""What a step ends with is a matter of its equations, not of how they are solved or what came before.

Could go wrong: a step that ends with a kick of other stages, or of the step before; an inverse, a guess or a
Jacobian that is carried on and spoils a solution; forces of a constraint that reach another stage; tangents
of single bodies that are not those of all; what rounding leaves of a balance, lost in every step.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account

import natcoord_jax as nc
from natcoord_jax import gallery

RUNS = {
    # Step, number of steps, and what the last correction leaves.
    "four_bar": (2**-7, 24, tol.STEP_ON_ITS_OWN),
    "heavy_top": (2**-7, 24, tol.STEP_ON_ITS_OWN),
    "bricard": (2**-7, 24, tol.STEP_ON_ITS_OWN),
    "open_tree": (2**-7, 24, tol.STEP_ON_ITS_OWN),
    "stiff_chain": (2**-7, 24, tol.STIFF_STEP_ON_ITS_OWN),
}
CASES = [
    pytest.param("four_bar", 4, marks=pytest.mark.exhaustive),
    pytest.param("four_bar", 6, marks=pytest.mark.exhaustive),
    pytest.param("heavy_top", 2, marks=pytest.mark.exhaustive),
    pytest.param("bricard", 4, marks=pytest.mark.exhaustive),
    pytest.param("bricard", 6, marks=pytest.mark.exhaustive),
    pytest.param("open_tree", 4, marks=pytest.mark.exhaustive),
    pytest.param("stiff_chain", 4, marks=pytest.mark.exhaustive),
]
TRIED = (1, 9, 17, 23)
"""Steps that are made once more."""
SAVED = 0.9
"""Of the corrections of steps that begin anew, those of a run that goes on are fewer than this part."""


@pytest.mark.parametrize(("name", "order"), CASES)
def test_steps_of_a_run_are_those_that_begin_anew(name, order):
    """From a state alone, without kicks, inverses, guesses and remainders of the steps before it.

    Velocities obey the constraints with their kicks, energy is kept; what is carried on saves corrections.
    """
    example, (dt, steps, bound) = gallery.load(name), RUNS[name]
    options = dict(dt=dt, scheme=nc.EnergyMomentum(order))
    run = nc.simulate(example.system, example.state, steps=steps, **options)
    corrections = []
    for k in TRIED:
        start, end = (jax.tree.map(lambda x, k=k: x[k], run.states) for k in (k, k + 1))
        alone = nc.simulate(example.system, start, steps=1, **options)
        corrections.append(int(alone.iterations))
        for field in ("q", "v", "rates"):
            once, again = getattr(end, field), getattr(alone.states, field)[-1]
            scale = 1.0 + np.max(np.abs(once), initial=0.0)
            assert np.max(np.abs(once - again), initial=0.0) <= bound * scale, (field, k)
    assert int(run.iterations) <= SAVED * steps * np.mean(corrections)
    errors = example.system.constraint_errors(run)
    assert np.max(errors.position) <= tol.CONSTRAINT
    if order > 2:
        assert np.max(errors.velocity) <= tol.TANGENT
        assert np.max(example.system.constraint_errors(run.states).velocity) <= tol.TANGENT
    assert np.max(nc.balance(example.system, run).energy) <= tol.ENERGY


# --- what rounding leaves of balances ----------------------------------------------------------------------


def walk(states, system):
    """Of the energy along states, root mean square, in terms of what moves."""
    run = account(system, states)
    energy = run.kinetic + sum(run.stores.values())
    return float(np.sqrt(np.mean((energy - energy[0]) ** 2)) / run.energy_scale)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["heavy_top", "double_pendulum"])
def test_rounding_does_not_add_up(name):
    """Energy walks far less than if each step began anew: what rounding leaves of balances is handed on."""
    example, steps, dt = gallery.load(name), 4000, 2e-3
    system = example.system
    carried = walk(nc.simulate(system, example.state, dt=dt, steps=steps).states, system)
    assert carried <= tol.HANDED_ON

    def anew(state, _):
        after = nc.step(system, state, dt=dt)
        return after, after

    states = jax.jit(lambda state: jax.lax.scan(anew, state, length=steps)[1])(example.state)
    assert walk(states, system) >= 3.0 * carried


# --- bodies that touch nothing ------------------------------------------------------------------------------


def bodies_on_springs(far: bool):
    """Free bodies, a point mass, and bodies on the ground by joints of several kinds, coupled by springs.

    Far off there may be a double pendulum, which has nothing to do with them.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity())
    part = dict(mass=2.0, inertia=(1.0, 1.2, 1.4), com=(0.1, 0.0, 0.05))
    bodies = [
        scene.add(nc.RigidBody(**part, position=(0.0, 0, 0), angular_velocity=(0.5, -0.3, 0.8))),
        scene.add(nc.RigidBody(**part, position=(1.0, 0, 0))),
        scene.add(nc.RigidBody(**part, position=(2.0, 0, 0))),
        scene.add(nc.RigidBody(**part, position=(3.0, 0, 0))),
        scene.add(nc.PointMass(mass=0.5, position=(4.0, 0.1, 0))),
    ]
    scene.add(nc.Revolute(nc.ground, bodies[1], point=(1.0, 0.5, 0), axis=(0, 0.6, 0.8)))
    scene.add(nc.Spherical(nc.ground, bodies[2], point=(2.0, 0, 0.4)))
    scene.add(nc.Prismatic(nc.ground, bodies[3], point=(3.0, 0, 0), axis=(0, 1, 0)))
    for k, (one, other) in enumerate(zip(bodies, bodies[1:])):
        ends = nc.Point(one, (k + 0.2, 0.1, 0)), nc.Point(other, (k + 1.0, 0.0, 0.2 * (k < 3)))
        if k == 3:
            ends = nc.Point(one, (3.2, 0.1, 0)), nc.Point(other, (4.0, 0.1, 0))
        scene.add(nc.Spring(ends, stiffness=80.0, length=0.7))
    if far:
        arms = [scene.add(nc.RigidBody(**part, position=(50.0 + k, 0, 0))) for k in range(2)]
        for k, (one, other) in enumerate(((nc.ground, arms[0]), arms)):
            scene.add(nc.Revolute(one, other, point=(50.0 + k, 0, 0.5), axis=(0, 1, 0)))
    return *scene.compile(), bodies


@pytest.mark.exhaustive
def test_bodies_that_touch_nothing_change_nothing():
    """Bodies that hang on nothing but the ground are solved each with tangents of its own, chains are not."""
    places = []
    for far in (False, True):
        system, state, bodies = bodies_on_springs(far)
        run = nc.simulate(system, state, dt=0.03, steps=20, scheme=nc.EnergyMomentum(4))
        assert np.max(nc.balance(system, run).energy) <= tol.ENERGY_OF_A_SMALL_SCENE
        assert np.max(system.constraint_errors(run.states).velocity) <= tol.TANGENT_OF_A_SMALL_SCENE
        rows = np.asarray(run.states.rows)
        places.append(rows[:, [system.body_index(body.name) for body in bodies]])
    assert np.max(np.abs(jnp.diff(places[0], axis=0))) > 1e-3, "nothing moves"
    np.testing.assert_allclose(places[0], places[1], rtol=0, atol=tol.SAME_TRAJECTORY)
