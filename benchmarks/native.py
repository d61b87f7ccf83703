"""What machine code of our own takes a lane-step, beside the code that XLA makes of the same programs.

usage: python -m benchmarks.native [--quick] [--output FOLDER] [--scene NAME ...] [--steps N ...]

Scenes of `benchmarks.guard_scenes`, a double pendulum with a controller and two robots from files (those of
`example-robot-data`; without it or MuJoCo they are left out), on one core; lanes differ by a
twentieth in velocities and inputs. Both programs of a cell are compiled from nothing with full effort and run
in turn; given are medians of processor times a lane-step [us], the ratio of each round's pair, and the
processor seconds until the first result.
"""

import json
import statistics
import sysconfig
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from benchmarks import common
from benchmarks.guard_scenes import SCENES, Subject
from natcoord_jax.native import call
from natcoord_jax.xla.effort import FULL, accepted

LANES = 64
SPREAD = 0.05
ROUNDS = 7
SHORTEST = 0.02
"""Processor time of one side of a round, at least [s]."""
STEPS = 10, 100, 1000
CELLS = (
    ("spacecraft", "value", 1), ("spacecraft", "value", LANES), ("spacecraft", "gradient", LANES),
    ("heavy top", "value", 1), ("heavy top", "value", LANES), ("heavy top", "gradient", LANES),
    ("open tree", "value", 1), ("open tree", "value", LANES), ("open tree", "gradient", LANES),
    ("four-bars, 2", "value", 1), ("four-bars, 2", "value", LANES),
    ("controlled pendulum", "value", 1), ("controlled pendulum", "value", LANES),
    ("rubbing balls", "value", 1), ("rubbing balls", "value", LANES),
    ("panda", "value", 1), ("panda", "value", LANES),
    ("solo12", "value", 1), ("solo12", "value", LANES),
)  # fmt: skip


def controlled_pendulum() -> tuple[Subject, Callable]:
    """Two rods, each hinge with a motor that a function of the state drives."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    before, hinges = nc.ground, []
    for k in range(2):
        rod = scene.add(
            nc.RigidBody(mass=1.0, inertia=(0.01, 0.09, 0.09), position=(k, 0, 0), com=(0.5, 0, 0))
        )
        hinges.append(scene.add(nc.Revolute(before, rod, point=(k, 0, 0), axis=(0, 1, 0))))
        scene.add(nc.JointTorque(hinges[k]))
        before = rod
    system, state = scene.compile()

    def controller(t: Any, state: Any) -> Any:
        angle = jnp.stack([system.coordinate(state, hinge) for hinge in hinges])
        rate = jnp.stack([system.rate(state, hinge) for hinge in hinges])
        return -5.0 * (angle - jnp.sin(t)) - 0.5 * rate

    state = system.with_coordinate(state, hinges[0], 0.3, rate=1.0)
    return Subject(system, state, 5e-3, lambda steps: jnp.zeros((steps, 2))), controller


ROBOTS = Path(sysconfig.get_paths()["purelib"], "cmeel.prefix", "share", "example-robot-data", "robots")
FILES = {
    "panda": ("panda_description/urdf/panda.urdf", False),
    "solo12": ("solo_description/robots/solo12.urdf", True),
}
"""Files of robots, and whether their roots float."""


def robot(name: str) -> Subject:
    """A robot from its file, thrown with random rates and torques."""
    file, floating = FILES[name]
    read = nc.io.load(ROBOTS / file, floating=floating)
    scene = nc.Scene()
    scene.add(nc.Gravity())
    handle = scene.add(read)
    system, state = scene.compile()
    rng, channels = np.random.default_rng(0), len(system.structure.inputs)
    state = handle.state(system, state, None, 0.5 * rng.normal(size=read.description.rate_count))
    return Subject(system, state, 2e-3, lambda steps: np.tile(0.1 * rng.normal(size=channels), (steps, 1)))


def subject_of(scene: str) -> tuple[Subject, Callable | None]:
    """A scene, and what controls it."""
    if scene == "controlled pendulum":
        return controlled_pendulum()
    return robot(scene) if scene in FILES else SCENES[scene].build(), None


def function_of(scene: str, kind: str, lanes: int, steps: int) -> tuple[Callable, tuple[Any, Any]]:
    """What is compiled, and its arguments: velocities and inputs."""
    subject, controller = subject_of(scene)
    system, state, dt, inputs = subject

    def value(v: Any, u: Any) -> nc.Trajectory:
        moving = eqx.tree_at(lambda s: s.v, state, v)
        return nc.simulate(system, moving, dt=dt, steps=steps, inputs=controller or u)

    def gradient(v: Any, u: Any) -> Any:
        return jax.value_and_grad(lambda v: jnp.sum(value(v, u).v[-1] ** 2))(v)

    function = value if kind == "value" else gradient
    arguments = state.v, jnp.asarray(inputs(steps))
    if lanes > 1:
        factors = 1 + SPREAD * jnp.linspace(-1, 1, lanes)
        function = jax.vmap(function)
        arguments: Any = tuple(factors.reshape(-1, *[1] * x.ndim) * x for x in arguments)
    return function, arguments


def compiled(function: Callable, arguments: tuple, native: bool) -> tuple[Callable[[], Any], float]:
    """A program, and the processor seconds until its first result."""
    known, call.available = call.available, call.available if native else lambda: False
    try:
        jax.clear_caches()
        start = time.process_time()
        program = jax.jit(function).lower(*arguments).compile(accepted(FULL))
        jax.block_until_ready(program(*arguments))
        return lambda: jax.block_until_ready(program(*arguments)), time.process_time() - start
    finally:
        call.available = known


def measured(scene: str, kind: str, lanes: int, steps: int) -> dict[str, Any]:
    """Both programs of a cell in turn."""
    function, arguments = function_of(scene, kind, lanes, steps)
    sides = [compiled(function, arguments, native) for native in (True, False)]
    counts = [max(1, round(SHORTEST / common.seconds(run, time.process_time))) for run, _ in sides]
    times: list[list[float]] = [[], []]
    for _ in range(ROUNDS):
        for (run, _), count, found in zip(sides, counts, times):
            start = time.process_time()
            for _ in range(count):
                run()
            found.append(1e6 * (time.process_time() - start) / (count * lanes * steps))
    own, xla = map(statistics.median, times)
    ratio = statistics.median(a / b for a, b in zip(*times))
    seconds = [s for _, s in sides]
    record = {"scene": scene, "kind": kind, "lanes": lanes, "steps": steps, "native_us": own, "xla_us": xla}
    return record | {"ratio": ratio, "native_compile_s": seconds[0], "xla_compile_s": seconds[1]}


def main() -> None:
    """Measure cells, print a table, keep the records."""
    options = common.parser(str(__doc__).splitlines()[0], "nothing")
    options.add_argument("--scene", nargs="*", default=sorted({scene for scene, _, _ in CELLS}))
    options.add_argument("--steps", nargs="*", type=int, default=list(STEPS))
    chosen = options.parse_args()
    common.on_one_core()
    jax.config.update("jax_enable_x64", True)
    steps = [100] if chosen.quick else chosen.steps
    records = []
    for scene, kind, lanes in CELLS:
        if scene in FILES and not (ROBOTS.exists() and find_spec("mujoco")):
            print(f"{scene}: left out; pip install --no-deps example-robot-data; pip install mujoco")
            continue
        for count in steps if scene in chosen.scene else ():
            records.append(record := measured(scene, kind, lanes, count))
            print(
                f"{scene:20} {kind:9} {lanes:3} lanes {count:6} steps: {record['native_us']:8.3f} us, by XLA "
                f"{record['xla_us']:8.3f}: {record['ratio']:.2f}; "
                f"compiled in {record['native_compile_s']:.1f} s, {record['xla_compile_s']:.1f}",
                flush=True,
            )
    if chosen.output is not None or not chosen.quick:
        folder = chosen.output or common.RESULTS
        (folder / "native.json").write_text(json.dumps(records, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
