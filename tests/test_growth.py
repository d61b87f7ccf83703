"""Growth of disturbances: what a derivative over a long time is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

MASS, LENGTH, INERTIA, GRAVITY = 2.0, 0.5, 0.1, 9.81
RATE = np.sqrt(MASS * GRAVITY * LENGTH / (INERTIA + MASS * LENGTH**2))


@pytest.fixture(scope="module")
def upright():
    """A pendulum that stands on its head."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    rod = nc.RigidBody(mass=MASS, inertia=(INERTIA, INERTIA, 0.05), position=(0, 0, LENGTH), name="rod")
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(rod), point=(0, 0, 0), axis=(0, 1, 0)))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


@pytest.mark.slow
def test_an_upright_pendulum_falls_at_its_exponent(upright):
    """Could go wrong: a scale that is left out of the sum. In ten seconds its rounding makes it fall."""
    growth = nc.tangent_growth(*upright, dt=0.01, steps=500, save_every=10)
    assert growth.t.shape == growth.decades.shape == (51,)
    # The midpoint rule rises by (1 + x)/(1 - x) with x = rate dt / 2.
    discrete = np.log((1 + 0.005 * RATE) / (1 - 0.005 * RATE)) / 0.01
    np.testing.assert_allclose(growth.rate, discrete, rtol=1e-6)
    assert "disturbances grow by 10^8.2 in 5 s" in growth.explain()
    assert "rounding of its start: nowhere" in growth.explain()


@pytest.mark.exhaustive
def test_it_is_the_size_of_the_derivative(upright):
    """Could go wrong: the tangent of another motion, for instance of one without the inputs."""
    system, state = upright
    inputs = 0.3 * jnp.sin(jnp.arange(300.0))[:, None]
    growth = nc.tangent_growth(system, state, dt=0.01, inputs=inputs, save_every=50, seed=3)
    push = jnp.asarray(np.random.default_rng(3).normal(size=state.v.shape))

    def end(scale):
        start = nc.State(**(vars(state) | {"v": state.v + scale * push}))
        return nc.simulate(system, start, dt=0.01, inputs=inputs, throw=False).q[-1]

    moved = jax.jvp(end, (0.0,), (1.0,))[1]
    first = 0.01 * np.linalg.norm(push)
    assert abs(np.log10(np.linalg.norm(moved) / first) - growth.decades[-1]) < 0.01


@pytest.mark.exhaustive
def test_a_run_that_fails_has_no_growth(upright):
    system, state = upright
    broken = lambda t, state: jnp.full(1, jnp.nan)  # noqa: E731
    growth = nc.tangent_growth(system, state, dt=0.01, steps=20, inputs=broken, save_every=10)
    assert int(growth.result) != 0 and np.all(np.isnan(growth.decades[1:]))
    assert "the run ended early" in growth.explain() and "nan" not in growth.explain()
    with pytest.raises(ValueError, match="save_every is 7; pass a positive divisor of steps = 20"):
        nc.tangent_growth(system, state, dt=0.01, steps=20, save_every=7)
