"""Impulses of open contacts decay to numbers whose squares underflow: no derivative divides by them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from natcoord_jax.effects.contact.friction import missing_friction
from natcoord_jax.maths.friction_law import friction_impulses

DECAYED = [0.0, 1e-310, 1e-160, 1e-150, 1e-40]


@pytest.mark.parametrize("size", DECAYED)
def test_friction_of_an_open_contact(size):
    along, slip, direction = (
        jnp.array([size, -size, 0.0]),
        jnp.array([1.0, 0.5, 0.0]),
        jnp.array([1.0, 2.0, 0]),
    )

    def law(along, most):
        return missing_friction(along, slip, most, jnp.asarray(1e-6))

    numbers = along, jnp.asarray(-1.0)
    for change in ((direction, jnp.ones(())), (size * direction, jnp.ones(()))):
        value, rate = jax.jvp(law, numbers, change)
        assert np.all(np.isfinite(value))
        # Friction that is missing is what opposes slip without a force along the normal.
        speed = np.sqrt(1.25 + 1e-12)
        np.testing.assert_allclose(rate, speed * change[0], rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("size", DECAYED)
def test_impacts_of_an_open_contact(size):
    matrix, taken, friction = jnp.diag(jnp.array([2.0, 2.0, 0.0])), jnp.zeros((1, 3)), jnp.array([0.3])

    def law(slip, held, pressed):
        return friction_impulses(matrix, taken, slip, held, pressed, friction)

    held = jnp.array([[size, -size, 0.0]])
    numbers = jnp.array([[1.0, 0.5, 0.0]]), held, jnp.zeros(1)
    for change in (held, jnp.ones_like(held)):
        value, rate = jax.jvp(law, numbers, (jnp.ones((1, 3)), change, jnp.zeros(1)))
        # All that is held is let go.
        np.testing.assert_allclose(value, -held, atol=1e-300)
        np.testing.assert_allclose(rate, -change, atol=1e-12)
