"""Bodies without mass between two joints: two hinges in a row are a universal joint, to round-off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.core.bodies import TRIAD, Body
from natcoord_jax.viz.outline import bodies_of

SPIN, DRIFT = np.array((0.3, 0.1, -0.2)), np.array((0.1, 0.0, 0.0))


def cross(place, name="cross", spin=SPIN):
    """A body without mass."""
    numbers = jnp.zeros((4, 4)), jnp.asarray(place), jnp.eye(3), jnp.asarray(DRIFT), jnp.asarray(spin)
    return Body(*numbers, TRIAD, None, name)


def compiled(chain, **options):
    """A base and an arm on two crossing axes, by two hinges or by a universal joint, and a tip."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    centre = np.array((0.0, 0.0, 0.5))
    moving = {"velocity": DRIFT, "angular_velocity": SPIN}
    base = scene.add(nc.RigidBody(mass=2.0, inertia=(0.2, 0.2, 0.3), position=centre, **moving, name="base"))
    link = nc.RigidBody(
        mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.1, 0, 0.3), position=centre, **moving, name="arm"
    )
    arm = scene.add(link)
    place = centre + (0.0, 0.5, 0.0)
    moving["velocity"] = DRIFT + np.cross(SPIN, place - centre)
    link = nc.RigidBody(
        mass=0.5, inertia=(0.01, 0.02, 0.03), com=(0.1, 0, 0.3), position=place, **moving, name="tip"
    )
    tip = scene.add(link)
    if chain:
        between = scene.add(cross(centre))
        scene.add(nc.Revolute(base, between, axis=(1, 0, 0), name="first"))
        scene.add(nc.Revolute(between, arm, axis=(0, 1, 0), name="second"))
    else:
        scene.add(nc.Universal(base, arm, axis=(1, 0, 0), second=(0, 1, 0), name="both"))
    scene.add(nc.Revolute(arm, tip, axis=(0, 0, 1), name="wrist"))
    return scene.compile(**options)


def rows(system, x):
    """Rows of the three bodies with mass."""
    which = [system.body_index(name) for name in ("base", "arm", "tip")]
    return np.asarray(x).reshape(*x.shape[:-2], -1, 4, 3)[..., which, :, :]


@pytest.mark.slow
@pytest.mark.parametrize("solver, order", [("reduced", 2), ("recursive", 4)])
def test_two_hinges_are_a_universal_joint(solver, order):
    found = []
    for chain in (False, True):
        system, state = compiled(chain, solver=solver)
        found.append([rows(system, system.instant(state).accelerations)])
        run = nc.simulate(system, state, dt=0.02, steps=10, scheme=nc.EnergyMomentum(order=order))
        assert nc.balance(system, run).energy.max() < 1e-13
        found[-1] += [rows(system, x) for x in (run.states.q, run.states.v, system.tangent(run).v)]
    for one, other in zip(*found):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def test_they_are_sensed_and_drawn_where_they_are():
    system, state = compiled(True)
    sensed = system.sense(state, "cross")
    np.testing.assert_allclose(sensed.com, (0.0, 0.0, 0.5), atol=1e-15)
    drawn = bodies_of(system, range(len(system.structure.bodies)))
    assert [number for number, found in drawn.items() if found is None] == [system.body_index("cross")]
    slope = jax.grad(lambda m: system.set("arm", mass=m).energy(state).kinetic)(1.0)
    assert np.isfinite(slope)


def test_at_the_end_of_a_chain_they_are_refused():
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="body"))
    end = scene.add(cross((0.0, 0.0, 0.0), name="end", spin=np.zeros(3)))
    scene.add(nc.Revolute(nc.ground, end, name="hinge"))
    with pytest.raises(ValueError, match="moves no mass"):
        scene.compile()
