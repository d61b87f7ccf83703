"""Programs drawn by lot: loops in loops, branches, records written by index, numbers that are none."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

N = 5
"""Length of the vectors that programs work on."""


class Draw:
    """A program drawn by lot, as the same sequence of operations each time it is traced.

    Args:
        seed: of the lot.
        length: number of operations.
    """

    def __init__(self, seed: int, length: int = 7):
        self.seed, self.length = seed, length

    def __call__(self, x: Any, a: Any, k: Any) -> tuple[Any, ...]:
        """Of a vector (N,), a matrix (N, N) and an integer."""
        lot = np.random.default_rng(self.seed)
        return _drawn(lot, self.length, x, a, k, depth=2)


def _squashed(x: Any) -> Any:
    return jnp.where(jnp.abs(x) > 4, x / (1 + jnp.abs(x)), x)


def _drawn(lot: Any, length: int, x: Any, a: Any, k: Any, depth: int) -> tuple[Any, Any, Any]:
    for _ in range(length):
        names = [*PLAIN, *NESTED] if depth else list(PLAIN)
        name = names[lot.integers(len(names))]
        if name in PLAIN:
            x, a, k = PLAIN[name](lot, x, a, k)
        else:
            x, a, k = NESTED[name](lot, x, a, k, depth - 1)
        x, a, k = _squashed(x), _squashed(a), k % 7
    return x, a, k


def _elementwise(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    functions = [
        jnp.sin,
        jnp.exp,
        jnp.abs,
        jnp.sign,
        jnp.floor,
        jnp.tanh,
        lambda y: y**3,
        lambda y: 1 / (2 + y * y),
    ]
    f, g = (functions[n] for n in lot.integers(len(functions), size=2))
    return f(x) - 0.3 * g(x[::-1]), a + 0.1 * g(a.T), k


def _compared(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    c = float(lot.normal())
    y = jnp.where((x > c) & jnp.isfinite(x), jnp.maximum(x, c), jnp.minimum(-x, 0.5))
    return y, jnp.clip(a, -1.0, jnp.max(y)), k + jnp.argmax(y).astype(k.dtype)


def _product(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    return a @ x * 0.2, jnp.einsum("ij,kj->ki", a, a) * 0.1, k + jnp.sum(x > 0)


def _gathered(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    index = (jnp.arange(N) * 3 + k) % (N + 1)
    return x.at[index].get(mode="fill", fill_value=0.25), a[index % N], k * 2 + 1


def _scattered(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    index = (jnp.arange(N) * 2 + k) % (N - 1)
    return x.at[index].add(0.5 * x), a.at[k % N, :].set(x).at[:, (k + 2) % N].multiply(0.5), k + 1


def _sliced(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    part = jax.lax.dynamic_slice(a, (k - 1, k), (2, 3))
    a = jax.lax.dynamic_update_slice(a, 0.5 * part, (k // 2, 1))
    y = jnp.concatenate([x[2:], x[:2] * 2]).reshape(N, 1) + jnp.zeros((1, 1))
    return y[:, 0], jnp.pad(a, ((1, 0), (0, 1)))[:N, 1:], k


def _no_number(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    bad = jnp.where(k == int(lot.integers(7)), jnp.nan, 1.0)
    return x * bad, a + jnp.max(x * bad) * 0, k


def _integers(lot: Any, x: Any, a: Any, k: Any) -> tuple[Any, Any, Any]:
    j = (k * 5 - 3) // jnp.maximum(k % 3, 1) ^ (k << 2)
    return x + (j % 4).astype(x.dtype), jnp.cumsum(a, axis=int(lot.integers(2))) * 0.3, jnp.abs(j - k)


PLAIN: dict[str, Callable] = {
    f.__name__: f
    for f in (_elementwise, _compared, _product, _gathered, _scattered, _sliced, _no_number, _integers)
}


def _while(lot: Any, x: Any, a: Any, k: Any, depth: int) -> tuple[Any, Any, Any]:
    seed = int(lot.integers(1 << 30))

    def body(carry: Any) -> Any:
        n, x, a, k, record = carry
        record = record.at[n].set(x)
        x, a, k = _drawn(np.random.default_rng(seed), 2, x, a, k, depth)
        return n + 1, x, a, k, record

    start = jnp.zeros((), int), x, a, k, jnp.zeros((8, N))
    n, x, a, k, record = jax.lax.while_loop(lambda c: (c[0] < k % 4 + 2) & ~(c[1][0] > 3), body, start)
    return x + record[n - 1] + jnp.sum(record, axis=0), a, k + n


def _scan(lot: Any, x: Any, a: Any, k: Any, depth: int) -> tuple[Any, Any, Any]:
    seed, reverse = int(lot.integers(1 << 30)), bool(lot.integers(2))

    def body(carry: Any, row: Any) -> Any:
        x, k = carry
        x, b, k = _drawn(np.random.default_rng(seed), 2, x, jnp.outer(row, x), k % 7, depth)
        return (x, k), b[0] + row

    (x, k), rows = jax.lax.scan(body, (x, k), a, reverse=reverse)
    return x, rows, k


def _cond(lot: Any, x: Any, a: Any, k: Any, depth: int) -> tuple[Any, Any, Any]:
    seeds = [int(s) for s in lot.integers(1 << 30, size=3)]

    def branch(seed: int) -> Callable:
        return lambda x, a, k: _drawn(np.random.default_rng(seed), 2, x, a, k, depth)

    if lot.integers(2):
        return jax.lax.cond(x[0] > 0.1, branch(seeds[0]), branch(seeds[1]), x, a, k)
    return jax.lax.switch(k - 1, [branch(s) for s in seeds], x, a, k)


def _mapped(lot: Any, x: Any, a: Any, k: Any, depth: int) -> tuple[Any, Any, Any]:
    """The same of every row: loops side by side that end at different trips."""
    seed = int(lot.integers(1 << 30))

    def row(x: Any, b: Any, k: Any) -> Any:
        def body(carry: Any) -> Any:
            n, x, b, k = carry
            x, b, k = _drawn(np.random.default_rng(seed), 1, x, b, k % 7, 0)
            return n + 1, x, b, k

        return jax.lax.while_loop(lambda c: (c[0] < c[3] % 4 + 1) & (c[1][0] < 2), body, (k * 0, x, b, k))

    n, x, b, k = jax.vmap(row, (0, None, 0))(a, 0.5 * a, jnp.arange(N) + k)
    return x[:, 0] + b[:, 1, 2], jnp.mean(b, axis=0) + x, jnp.sum(n) + k[0]


NESTED: dict[str, Callable] = {f.__name__: f for f in (_while, _scan, _cond, _mapped)}


def arguments(lanes: int, seed: int) -> tuple[Any, Any, Any]:
    """Arguments of so many lanes, that differ."""
    lot = np.random.default_rng(seed)
    return lot.normal(size=(lanes, N)), lot.normal(size=(lanes, N, N)), lot.integers(0, 7, size=lanes)
