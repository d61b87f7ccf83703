"""The benchmark models in MJX, MuJoCo in JAX (written for mujoco-mjx 3.17 and JAX 0.10), in double precision.

usage: python -m benchmarks.peers.mjx_models MODEL STEPS [integrator=Euler|RK4|implicitfast]
       [lanes=1000] [batch_steps=100] [gradient_steps=100]

`lanes=0` and `gradient_steps=0` leave out the batch and the gradient, which take longest to compile. RK4 of
this version is of order two, not four, on models with ball joints (as MuJoCo's own was in 3.17). Its equality
constraints leave out the accelerations that come from velocities, which MuJoCo 4.0 has, so that errors of
closed loops are larger than MuJoCo's at the same step on Bricard's mechanism.
"""

import contextlib
import io
import time
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.measure import MODELS, command_line, per_step, times_per_call
from benchmarks.peers.mujoco_models import build, read_state

with contextlib.redirect_stdout(io.StringIO()):  # names the optional modules that it does not find
    from mujoco import mjx


def _rollout(mjx_model, start, steps: int):
    """A function from controls (steps, motors) and initial velocity to the final positions and velocities.

    Only positions and velocities are carried: faster here, by up to two, than to carry the whole `mjx.Data`.
    """

    def rollout(controls, velocity):
        def step(state, control):
            data = mjx.step(mjx_model, start.replace(qpos=state[0], qvel=state[1], ctrl=control))
            return (data.qpos, data.qvel), None

        return jax.lax.scan(step, (start.qpos, velocity), controls, length=steps)[0]

    return rollout


def _timed(function, arguments, steps: int, repeats: int) -> tuple[dict, object]:
    """Compile time and time per step of a function of arrays, and its value."""
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    times = times_per_call(lambda: jax.block_until_ready(compiled(*arguments)), repeats)
    return {"compile_s": seconds, **per_step(times, steps)}, compiled(*arguments)


def _batch(rollout, controls, velocity, steps: int, lanes: int, repeats: int) -> dict:
    """Time per step and lane of `lanes` rollouts from different velocities."""
    velocities = velocity + 1e-3 * jax.random.normal(jax.random.key(0), (lanes, velocity.size))
    timing, _ = _timed(jax.vmap(rollout, in_axes=(None, 0)), (controls, velocities), steps * lanes, repeats)
    return {"lanes": lanes, "steps": steps, **timing}


def _gradient(rollout, controls, velocity, steps: int, repeats: int) -> dict:
    """Value and gradient of the summed squares of the final velocities by controls and initial velocities."""

    def loss(parameters):
        return jnp.sum(rollout(*parameters)[1] ** 2)

    parameters = (controls[:steps], velocity)
    forward, _ = _timed(loss, (parameters,), steps, repeats)
    both, (_, gradient) = _timed(jax.value_and_grad(loss), (parameters,), steps, repeats)
    return {
        "steps": steps,
        **both,
        "over_forward": both["us_per_step"] / forward["us_per_step"],
        "finite": all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in gradient),
    }


def batch(model: str, integrator: str, steps: int, factors):
    """A function of the step [s]: positions and velocities after some steps, of all lanes.

    Args:
        model: a name in `MODELS`.
        integrator: Euler, RK4 or implicitfast.
        steps: number of steps.
        factors: of the start velocities, by lane.
    """
    source = MODELS[model]
    mj_model, data = build(source, 1.0, integrator)
    jax.config.update("jax_enable_x64", True)
    mjx_model, start = mjx.put_model(mj_model), mjx.put_data(mj_model, data)
    controls = jnp.tile(start.ctrl, (steps, 1))

    def rollout(dt, factor):
        # The time constant of constraints is given in steps, of one second in this model.
        solref = mjx_model.eq_solref * jnp.stack([dt, jnp.ones_like(dt)])
        timed = mjx_model.tree_replace({"opt.timestep": dt, "eq_solref": solref})
        return _rollout(timed, start, steps)(controls, factor * start.qvel)

    program = jax.jit(jax.vmap(rollout, in_axes=(None, 0)))
    return lambda dt: program(jnp.asarray(dt), factors)


def run(
    model: str,
    steps: int,
    *,
    integrator: str = "Euler",
    lanes: int = 1000,
    batch_steps: int = 100,
    gradient_steps: int = 100,
    repeats: int = 5,
) -> dict:
    """Times `steps` steps over [0, T_END], a batch and a gradient.

    Returns times, compile times and the final state.

    Args:
        model: a name in `MODELS`.
        steps: number of steps.
        integrator: Euler, RK4 or implicitfast.
        lanes: number of rollouts in the batch; 0: no batch.
        batch_steps: steps of each rollout in the batch.
        gradient_steps: steps that the gradient goes through; 0: no gradient.
        repeats: timed repetitions.
    """
    jax.config.update("jax_enable_x64", True)
    source = MODELS[model]
    mj_model, data = build(source, source.T_END / steps, integrator)
    mjx_model, start = mjx.put_model(mj_model), mjx.put_data(mj_model, data)
    controls, velocity = jnp.tile(start.ctrl, (max(steps, gradient_steps, batch_steps), 1)), start.qvel

    rollout = _rollout(mjx_model, start, steps)
    timing, final = _timed(rollout, (controls[:steps], velocity), steps, repeats)
    data.qpos[:], data.qvel[:] = (np.asarray(x) for x in final)
    result = {
        "peer": "mjx",
        "version": version("mujoco-mjx"),
        "jax": jax.__version__,
        "model": model,
        "steps": steps,
        "h": source.T_END / steps,
        "settings": {"integrator": integrator},
        **timing,
        **read_state(source, mj_model, data),
    }
    if lanes:
        short = _rollout(mjx_model, start, batch_steps)
        result["batch"] = _batch(short, controls[:batch_steps], velocity, batch_steps, lanes, repeats)
    if gradient_steps:
        short = _rollout(mjx_model, start, gradient_steps)
        result["value_and_gradient"] = _gradient(short, controls, velocity, gradient_steps, repeats)
    return result


if __name__ == "__main__":
    command_line(run)
