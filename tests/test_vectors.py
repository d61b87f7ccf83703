"""Numbers whose derivatives the step relies on where the usual ones have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from natcoord_jax.maths.vectors import largest


@pytest.mark.parametrize("count", range(1, 8))
def test_the_largest_is_the_largest(count):
    x = jnp.asarray(np.random.default_rng(count).normal(size=(count, 5)))
    np.testing.assert_array_equal(largest(x), jnp.max(x, axis=0))
    chosen = jax.grad(lambda x: jnp.sum(largest(x)))(x)
    np.testing.assert_array_equal(chosen, x == jnp.max(x, axis=0))


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (2.0, -1.0, 2.0), (0.0, 0.0)])
def test_the_derivative_of_equal_ones_is_that_of_one_of_them(values):
    """And so wherever the program rounds: there is always one that is chosen."""
    chosen = jax.grad(lambda x: largest(x))(jnp.array(values))
    assert sorted(chosen.tolist())[-1] == 1.0 and float(jnp.sum(chosen)) == 1.0
