"""What sweeps are made of in tests, at the top of a module that workers import."""

import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc

jax.config.update("jax_enable_x64", True)
if sys.argv[1:2] == ["share"] and not jax.distributed.is_initialized():
    # Before anything is computed: one of two processes of a job.
    jax.distributed.initialize(f"127.0.0.1:{sys.argv[4]}", 2, int(sys.argv[3]))


def _swing():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.1), com=(0.5, 0.0, 0.0), name="arm"))
    hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


SYSTEM, STATE = _swing()


def angle(mass, torque, dt, steps):
    """Angle of a pendulum after some time, and how the run ended; a torque that is no number fails."""
    system = SYSTEM.set("arm", mass=mass)
    run = nc.simulate(system, STATE, dt=dt, steps=steps, inputs=lambda t, state: jnp.full(1, torque))
    return {"angle": run.states.coordinates[-1, 0], "result": run.result}


WORKED: list[tuple[float, float]] = []
"""Rows that this process has worked through, in turn."""


def _work(x, y):
    """Takes its time where that is wished for, and breaks down once where a file says so."""
    time.sleep(float(os.environ.get("SWEEP_SECONDS", 0.0)))
    flag = Path(os.environ.get("SWEEP_BREAKS", "nowhere"))
    if x == 5.0 and flag.exists():
        flag.unlink()
        raise RuntimeError("this row is broken")
    WORKED.append((float(x), float(y)))
    return np.asarray(x + y)


def line(x, y):
    """Something that takes next to no time."""
    total = jax.pure_callback(_work, jax.ShapeDtypeStruct((), float), x, y, vmap_method="sequential")
    return {"sum": total, "pair": jnp.stack([x, y])}


def rooms(x, steps):
    """The number of steps that a lane is given, and how many it has room for."""
    return {"x": x, "number": jnp.asarray(steps.number), "most": jnp.asarray(steps.most)}


AXES = {
    "mass": np.array([1.0, 1.5]),
    "torque": np.array([0.0, np.nan, 2.0]),
    ("dt", "steps"): (np.array([0.02, 0.01]), np.array([10, 20])),
}
LINE = {"x": np.arange(20.0), "y": np.arange(7.0)}
SWEEP = {"axes": AXES, "buckets": ("steps",), "block": 4}
LINES = {"axes": LINE, "block": 4}


def share(store):
    """One of two processes of a job."""
    nc.sweep(line, store=store, **LINES)
    print(jax.process_count())
    jax.distributed.shutdown()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    import sweeping

    command, *arguments = sys.argv[1:]
    {
        "line": lambda: nc.sweep(sweeping.line, store=arguments[0], **LINES),
        "share": lambda: sweeping.share(arguments[0]),
        "devices": lambda: print(
            len(jax.local_devices()), nc.sweep(sweeping.angle, store=arguments[0], **SWEEP).explain()
        ),
    }[command]()
