"""KLU, called from JAX by klujax, on the systems of the benchmark of linear solvers.

usage: python -m benchmarks.peers.klu SYSTEM REPEATS LOOPS     (JSON to standard output)

The symbolic analysis is made once; timed are a full factorisation with solution and a refactorisation, which
keeps the order of the pivots, with solution. Both run in a loop inside one compiled program, as ours do.
"""

import functools
import json
import sys
import time
from importlib.metadata import version

import jax
import jax.numpy as jnp
import klujax
import numpy as np

from benchmarks import common, patterns


def measure(name: str, repeats: int, loops: int) -> dict:
    """Times and residual of one system."""
    system = patterns.named(name)
    rows, columns, values = system.triplets()
    rows, columns, values = jnp.asarray(rows, jnp.int32), jnp.asarray(columns, jnp.int32), jnp.asarray(values)
    right = jnp.asarray(patterns.right_hand_side(system))
    # The entries are sorted; klujax would have the compiler sort their indices again, for minutes.
    jnp.lexsort = lambda keys: np.arange(keys[0].size)
    symbolic = klujax.analyze(rows, columns, system.size)
    numeric = klujax.factor(rows, columns, values, symbolic)

    def full(values, right):
        return klujax.solve_with_symbol(rows, columns, values, right, symbolic)

    def again(values, right):
        return klujax.refactor_and_solve(rows, columns, values, right, numeric, symbolic)[0]

    def looped(solve):
        def body(_, carry):
            values, x = carry
            return values * (1.0 + 1e-200 * x[0]), solve(values, right)

        return jax.jit(lambda v: jax.lax.fori_loop(0, loops, body, (v, right))[1])

    found = {"version": version("klujax"), "entries": int(values.size)}
    for key, solve in (("full", full), ("refactor", again)):
        program = looped(solve)
        x = np.asarray(program(values))
        run = functools.partial(lambda p: p(values).block_until_ready(), program)
        found[key] = common.timed(run, loops, repeats, time.process_time)
        found[key]["residual"] = patterns.backward_error(system, x)
    return found


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
