"""What sweeps are made of in tests, at the top of a module that workers import."""

import sys
import time
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from natcoord_jax.sweeps import run as running

jax.config.update("jax_enable_x64", True)
if sys.argv[1:2] == ["share"] and not jax.distributed.is_initialized():
    # Before anything is computed: one of two processes of a job.
    jax.distributed.initialize(f"127.0.0.1:{sys.argv[4]}", 2, int(sys.argv[3]))


@cache
def swing():
    """A pendulum with a motor, and its state; asked for outside of programs before sweeps of `angle`."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.1), com=(0.5, 0.0, 0.0), name="arm"))
    hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def angle(mass, torque, dt, steps):
    """Angle of a pendulum after some time, and how the run ended; a torque that is no number fails."""
    system, state = swing()
    system = system.set("arm", mass=mass)
    run = nc.simulate(system, state, dt=dt, steps=steps, inputs=lambda t, state: jnp.full(1, torque))
    return {"angle": run.states.coordinates[-1, 0], "result": run.result}


def line(x, y):
    """Something that takes no time."""
    return {"sum": x + y, "pair": jnp.stack([x, y])}


AXES = {
    "mass": np.array([1.0, 1.5, 2.0]),
    "torque": np.array([0.0, 1.0, np.nan, 2.0]),
    ("dt", "steps"): (np.array([0.02, 0.01, 0.002]), np.array([10, 20, 100])),
}
LINE = {"x": np.arange(20.0), "y": np.arange(7.0)}
SWEEP = {"axes": AXES, "buckets": ("steps",), "block": 4}
LINES = {"axes": LINE, "block": 4}


def slowly(store):
    """A sweep that can be killed in the middle."""
    worked = running._worked

    def slow(*given):
        time.sleep(0.05)
        return worked(*given)

    running._worked = slow
    nc.sweep(line, store=store, **LINES)


def share(store):
    """One of two processes of a job."""
    nc.sweep(line, store=store, **LINES)
    print(jax.process_count())
    jax.distributed.shutdown()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    import sweeping

    command, *given = sys.argv[1:]
    {
        "slowly": lambda: sweeping.slowly(given[0]),
        "share": lambda: sweeping.share(given[0]),
        "devices": lambda: (
            sweeping.swing()
            and print(len(jax.local_devices()), nc.sweep(sweeping.angle, store=given[0], **SWEEP).explain())
        ),
    }[command]()
