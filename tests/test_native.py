"""Machine code of our own: programs drawn by lot give what XLA makes of them, in one lane and in many."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from natcoord_jax.native.call import Code, native_p
from natcoord_jax.native.program import flattened
from tests.random_programs import Draw, arguments

LANES = 1, 3, 8, 17


def native(function: Any, *like: Any, small: int = 640) -> Any:
    """A function as machine code, whatever its size."""
    closed = jax.make_jaxpr(function)(*like)
    assert not closed.consts
    code = Code(closed, flattened(closed), small)
    code.name((False,) * len(like), None)
    return lambda *args: native_p.bind(
        *map(jnp.asarray, args), code=code, varies=(False,) * len(args), lanes=None
    )


def compare(seed: int, small: int) -> None:
    """One lane, lanes of everything, and lanes that share the matrix."""
    function = Draw(seed)
    x, a, k = arguments(max(LANES), seed)
    own = native(function, x[0], a[0], k[0], small=small)
    alone = jax.jit(function)(x[0], a[0], k[0])
    for found, expected in zip(jax.jit(own)(x[0], a[0], k[0]), alone):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    for axes, given in (((0, 0, 0), a), ((0, None, 0), a[0])):
        expected = jax.jit(jax.vmap(function, axes))(x, given, k)
        batch = jax.jit(jax.vmap(own, axes))
        for lanes in LANES:
            some = given[:lanes] if axes[1] == 0 else given
            found = batch(x[:lanes], some, k[:lanes])
            for one, other in zip(found, expected):
                np.testing.assert_allclose(one, other[:lanes], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("seed", (1, 8, 10))
@pytest.mark.parametrize("small", [640, 4])
def test_random_programs_are_those_of_xla(seed: int, small: int) -> None:
    compare(seed, small)


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(100, 160))
@pytest.mark.parametrize("small", [640, 12])
def test_many_random_programs_are_those_of_xla(seed: int, small: int) -> None:
    compare(seed, small)
