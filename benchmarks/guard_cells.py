"""One process of `benchmarks.guard`: it compiles cells, keeps their programs, and times them when asked to.

Requests and answers are lines of JSON, `{"do": "compile" or "time", "cell": [scene, kind, lanes, steps]}`.
Programs are compiled as `nc.jit(..., effort="full")` does it, from nothing: what JAX has traced before is
forgotten. All times are processor time. Numbers are arguments of the programs, none is a constant in them.
"""

import gc
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common
from benchmarks.guard_scenes import SCENES, Cell, Subject, Yardstick, yardstick
from natcoord_jax.xla.effort import FULL, accepted

SHORTEST = 0.008
"""Processor time of one side of a round, at least [s]: calls are repeated until then."""
SPAN = 1.2
"""Processor time of all rounds of a cell, about [s]."""
ROUNDS = 5, 31
"""Number of rounds, at least and at most."""
PACE = 60_000
"""Turns of the loop by which the speed of the machine is judged while it compiles. FROZEN, as its body is."""


class Program(NamedTuple):
    """A compiled cell.

    Attributes:
        run: waits for the end.
        steps: of one call, of all lanes together.
        compile_s: processor seconds of tracing and compiling.
        pace_s: processor seconds of the loop of `pace`, about that time.
    """

    run: Callable[[], Any]
    steps: int
    compile_s: float
    pace_s: float


def pace() -> float:
    """Processor seconds of a fixed loop of Python over small objects, the least of three."""

    def turns() -> None:
        table: dict[Any, Any] = {}
        for k in range(PACE):
            table[(k % 997, "name")] = [k, table.get((k % 31, "name"))]
            if k % 997 == 0:
                table.clear()

    return min(common.seconds(turns, time.process_time) for _ in range(3))


def function_of(cell: Cell, subject: Subject) -> tuple[Callable, list[Any]]:
    """What is compiled, and its arguments: arrays.

    Lanes differ in velocities and inputs, by up to a tenth. The gradient is of the summed squares of the last
    velocities, by the first.
    """
    system, state = subject.system, subject.state
    inputs, v = jnp.asarray(subject.inputs(cell.steps)), state.v
    # Without these arrays, which are arguments of their own.
    arrays, fixed = eqx.partition((system, state, jnp.asarray(subject.dt, float)), eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def run(leaves: list[Any], v: Any, inputs: Any) -> nc.Trajectory:
        system, state, dt = eqx.combine(jax.tree.unflatten(tree, leaves), fixed)
        state = eqx.tree_at(lambda s: s.v, state, v)
        return nc.simulate(system, state, dt=dt, inputs=inputs)

    def value(leaves: list[Any], v: Any, inputs: Any) -> tuple[Any, list[Any]]:
        trajectory = run(leaves, v, inputs)
        return trajectory.result, jax.tree.leaves(eqx.filter(trajectory, eqx.is_array))

    def loss(v: Any, leaves: list[Any], inputs: Any) -> tuple[Any, Any]:
        trajectory = run(leaves, v, inputs)
        return jnp.sum(trajectory.v[-1] ** 2), trajectory.result

    def gradient(leaves: list[Any], v: Any, inputs: Any) -> tuple[Any, list[Any]]:
        (squares, result), by_v = jax.value_and_grad(loss, has_aux=True)(v, leaves, inputs)
        return result, [squares, by_v]

    function = value if cell.kind == "value" else gradient
    if cell.lanes > 1:
        factors = 1 + 0.1 * jnp.linspace(-1, 1, cell.lanes)
        v, inputs = (factors.reshape(-1, *[1] * x.ndim) * x for x in (v, inputs))
        function = jax.vmap(function, in_axes=(None, 0, 0))
    return function, [leaves, v, inputs]


def compiled(cell: Cell, subject: Subject) -> Program:
    """The program of a cell, from nothing.

    Raises:
        FloatingPointError: when it runs into the ground, or finds numbers that are not finite: the time of a
            wrong run says nothing.
    """
    function, arguments = function_of(cell, subject)
    options = accepted(FULL)
    jax.clear_caches()
    gc.collect()
    before, start = pace(), time.process_time()
    program = jax.jit(function).lower(*arguments).compile(options)
    spent = time.process_time() - start
    after = pace()
    result, numbers = jax.block_until_ready(program(*arguments))
    if np.any(np.asarray(result)):
        raise FloatingPointError("the run does not reach its end")
    if not all(bool(jnp.all(jnp.isfinite(x))) for x in numbers if jnp.issubdtype(x.dtype, jnp.floating)):
        raise FloatingPointError("numbers are not finite")
    run = lambda: jax.block_until_ready(program(*arguments))  # noqa: E731
    return Program(run, cell.steps * cell.lanes, spent, (before + after) / 2)


def _repeated(call: Callable[[], object]) -> tuple[Callable[[], None], int]:
    """A call as often as it takes to be measured."""
    call()
    count = max(1, round(SHORTEST / max(common.seconds(call, time.process_time), 1e-6)))

    def calls() -> None:
        for _ in range(count):
            call()

    return calls, count


def timed(program: Program, peer: Yardstick, span: float = SPAN) -> dict[str, Any]:
    """Times a step, in turn with the peer: medians, and the median and quartiles of the ratios of rounds."""
    (ours, many), (theirs, often) = _repeated(program.run), _repeated(peer.call)
    one = common.seconds(ours, time.process_time) + common.seconds(theirs, time.process_time)
    rounds = min(max(ROUNDS[0], round(span / one)), ROUNDS[1])
    pairs = [
        (
            1e6 * common.seconds(ours, time.process_time) / (many * program.steps),
            1e6 * common.seconds(theirs, time.process_time) / (often * peer.steps),
        )
        for _ in range(rounds)
    ]
    quartiles = statistics.quantiles([a / b for a, b in pairs], n=4, method="inclusive")
    return {
        "us_per_step": statistics.median(a for a, _ in pairs),
        "peer_us_per_step": statistics.median(b for _, b in pairs),
        "ratio": quartiles[1],
        "ratio_quartiles": [quartiles[0], quartiles[2]],
        "rounds": rounds,
    }


class Desk:
    """Scenes, peers and programs of this process."""

    def __init__(self) -> None:
        self.subjects: dict[str, Subject] = {}
        self.peers: dict[str, Yardstick] = {}
        self.programs: dict[Cell, Program] = {}

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """What a request asks for."""
        cell = Cell(*request["cell"])
        if request["do"] == "compile":
            if cell.scene not in self.subjects:
                self.subjects[cell.scene] = SCENES[cell.scene].build()
            self.programs[cell] = program = compiled(cell, self.subjects[cell.scene])
            return {"compile_s": program.compile_s, "pace_s": program.pace_s}
        if cell.scene not in self.peers:
            self.peers[cell.scene] = yardstick(cell.scene)
        peer = self.peers[cell.scene]
        return {"peer": peer.name} | timed(self.programs[cell], peer, request.get("span", SPAN))


def main() -> None:
    """Answer until there is nothing more to read."""
    # What compilers and peers print goes to the stream of errors.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    jax.config.update("jax_enable_x64", True)
    desk = Desk()
    for line in sys.stdin:
        try:
            answer = desk.answer(json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
