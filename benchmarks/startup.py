"""The wait for a first result: fresh process, empty cache, one core, beside MJX.

What is timed is everything from the start of the interpreter to the first value (or value and gradient) of
the summed squares of the final velocities: imports, the scene, tracing, compiling and running 200 steps.
By `nc.jit`, which compiles with least effort first, and by `jax.jit`, which those waited for before.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import common

STEPS = 200
REPEATS = 1
"""Of fresh processes: a run of all of them takes a quarter of an hour."""


class Row(NamedTuple):
    """A scene of the table.

    Attributes:
        scene: of the gallery.
        order: of the scheme.
        value: aim for the first value [s].
        gradient: aim for the first gradient [s].
        mjx: name of the model of the peers.
    """

    scene: str
    order: int
    value: float
    gradient: float
    mjx: str | None = None


ROWS = {
    "heavy top": Row("heavy_top", 2, 1.5, 3.0),
    "spacecraft": Row("spacecraft", 2, 2.0, 5.0, "spacecraft"),
    "four-bars, redundant": Row("four_bar", 2, 3.0, 9.0),
    "open tree of eight": Row("open_tree", 2, 4.0, 12.0, "open_tree"),
    "rope of 16 elements": Row("rope", 2, 6.0, 15.0),
    "spacecraft, order six": Row("spacecraft", 6, 8.0, 20.0),
}
SOLVED = 15.0
"""Aim for the reorientation by `nc.optimise` [s]."""
AGAIN = 2.5
"""Aim for the command line, the second time [s]."""

OURS = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import natcoord_jax as nc
from natcoord_jax import gallery
example = gallery.load({scene!r})
inputs = example.inputs({steps})
def cost(state):
    options = dict(dt=example.dt, steps={steps}, inputs=inputs, scheme=nc.EnergyMomentum(order={order}))
    return jnp.sum(nc.simulate(example.system, state, throw=False, **options).v[-1] ** 2)
program = {jit}({kind})
jax.block_until_ready(program(example.state))
print("done", flush=True)
"""

MJX = """
import jax, jax.numpy as jnp
from benchmarks.peers.measure import MODELS
from benchmarks.peers.mjx_models import _rollout, build, mjx
source = MODELS[{model!r}]
mj_model, data = build(source, source.T_END / {steps}, "Euler")
jax.config.update("jax_enable_x64", True)
model, start = mjx.put_model(mj_model), mjx.put_data(mj_model, data)
rollout, controls = _rollout(model, start, {steps}), jnp.tile(start.ctrl, ({steps}, 1))
def cost(velocity):
    return jnp.sum(rollout(controls, velocity)[1] ** 2)
jax.block_until_ready(jax.jit({kind})(start.qvel))
print("done", flush=True)
"""

REORIENTATION = """
import jax
jax.config.update("jax_enable_x64", True)
import natcoord_jax as nc
from natcoord_jax.gallery.manoeuvres import reorientation
solution = nc.optimise(reorientation())
assert solution.ok, solution.explain()
print("done", flush=True)
"""

KINDS = {"value": "cost", "gradient": "jax.value_and_grad(cost)"}
JITS = {"": "nc.jit", " by jax.jit": "jax.jit"}


def waited(command: list[str], environment: dict[str, str] | None = None) -> float:
    """Time [s] from the start of a process to its word "done", or to its end."""
    settings = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    begun = time.monotonic()
    run = subprocess.Popen(
        command,
        cwd=common.ROOT,
        env=settings | (environment or {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    taken = None
    for line in run.stdout:
        if line == "done\n":
            taken = time.monotonic() - begun
            break
    _, errors = run.communicate()
    if run.returncode != 0:
        raise RuntimeError(errors[-2000:])
    return time.monotonic() - begun if taken is None else taken


def first(python: str, program: str, **names: Any) -> float:
    """Time [s] to the first result of a program."""
    return waited([python, "-c", program.format(steps=STEPS, **names)])


def second_of_command_line() -> tuple[float, float]:
    """Times [s] of the command line, the first time and the second."""
    command = [sys.executable, "-m", "natcoord_jax", "run", "spacecraft"]
    with tempfile.TemporaryDirectory() as folder:
        environment = {"XDG_CACHE_HOME": folder, "JAX_ENABLE_COMPILATION_CACHE": "true"}
        command += ["--plot", str(Path(folder) / "figure.png")]
        one, two = (waited(command, environment) for _ in range(2))
    return one, two


def measure(name: str, row: Row, repeats: int, peers: str | None) -> dict[str, Any]:
    """First values and gradients of a scene, medians over fresh processes [s]."""
    found: dict[str, list[float]] = {}
    for _ in range(repeats):
        for kind, function in KINDS.items():
            for who, jit in JITS.items():
                given = dict(scene=row.scene, order=row.order, jit=jit, kind=function)
                found.setdefault(kind + who, []).append(first(sys.executable, OURS, **given))
            if peers is not None and row.mjx is not None:
                taken = first(peers, MJX, model=row.mjx, kind=function)
                found.setdefault(f"{kind} by MJX", []).append(taken)
    return {"scene": name} | {key: statistics.median(times) for key, times in found.items()}


def main() -> None:
    """Run the benchmark."""
    chosen = common.peer_parser("The wait for a first result.", "nothing").parse_args()
    common.on_one_core()
    peers = None if chosen.no_peers else chosen.peers_python
    results = common.circumstances("startup", quick=chosen.quick)
    rows = dict(list(ROWS.items())[:1]) if chosen.quick else ROWS
    repeats = 1 if chosen.quick else REPEATS
    waited([sys.executable, "-c", "import natcoord_jax"])  # (Python compiles its own files once, too.)
    runs = []
    for name, row in rows.items():
        runs.append(measure(name, row, repeats, peers))
        print({key: x if isinstance(x, str) else round(x, 1) for key, x in runs[-1].items()}, flush=True)
    targets = [
        common.target(f"first {kind}, {name}", run[kind], getattr(row, kind), "s")
        for (name, row), run in zip(rows.items(), runs)
        for kind in KINDS
    ]
    command_line, solved = second_of_command_line(), None
    if not chosen.quick:
        solved = first(sys.executable, REORIENTATION)
    targets.append(common.target("reorientation by nc.optimise", solved, SOLVED, "s"))
    targets.append(common.target("natcoord-jax run spacecraft, second time", command_line[1], AGAIN, "s"))
    results |= {"runs": runs, "command_line": command_line, "reorientation": solved, "targets": targets}
    print(f"{common.environment_line(results)}\n{common.show_targets(targets)}")
    common.write(results, None, common.folder(chosen))


if __name__ == "__main__":
    main()
