"""Lanes of a vmap: each as if it were alone, also on several cores."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery

ROOT = Path(__file__).resolve().parents[1]
STEPS = 20
SCALES = np.array([0.2, 1.0, 3.0])


@pytest.fixture(scope="module")
def pendulum():
    return gallery.load("pendulum")


def run(example, scale):
    return nc.simulate(example.system, example.state, dt=scale * example.dt, steps=STEPS)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="lanes are worked through together elsewhere")
def test_a_lane_is_as_if_it_were_alone(pendulum):
    """Neither a digit nor an iteration depends on the other lanes, whose steps are far longer or shorter."""
    lanes = jax.vmap(lambda scale: run(pendulum, scale))(SCALES)
    alone = [run(pendulum, scale) for scale in SCALES]
    counts = [int(result.iterations) for result in alone]
    assert len(set(counts)) > 1, "all lanes need the same: this shows nothing"
    assert lanes.iterations.tolist() == counts
    for lane, result in enumerate(alone):
        np.testing.assert_array_equal(lanes.states.q[lane], result.states.q)
        np.testing.assert_array_equal(lanes.states.v[lane], result.states.v)


@pytest.mark.exhaustive
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="lanes are worked through together elsewhere")
def test_a_gradient_is_as_if_it_were_alone(pendulum):
    slope = jax.jit(jax.grad(lambda scale: jnp.sum(run(pendulum, scale).states.q[-1] ** 3)))
    np.testing.assert_array_equal(jax.vmap(slope)(SCALES), [slope(scale) for scale in SCALES])


@pytest.mark.exhaustive
def test_batches_of_batches(pendulum):
    """Lanes of lanes, and lanes that differ in some arguments only."""

    def end(system, scale):
        result = nc.simulate(system, pendulum.state, dt=scale * pendulum.dt, steps=STEPS)
        return result.states.q[-1]

    several = jax.vmap(jax.vmap(end, in_axes=(None, 0)), in_axes=(None, 1))
    grid = SCALES[:, None] * jnp.array([1.0, 0.5])
    result = several(pendulum.system, grid)
    assert result.shape == (2, 3, *pendulum.state.q.shape)
    np.testing.assert_allclose(result[1, 2], end(pendulum.system, grid[2, 1]), rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_lanes_on_several_cores():
    """What the page on batches says of cores, with as many devices as it asks for."""
    page = (ROOT / "docs" / "howto" / "batches.md").read_text("utf-8")
    block = re.search(r"```py\n(.*?)```", page, re.DOTALL)
    assert block is not None, "the page on batches does not say how to use several cores"
    program = f"""
import jax
import jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import natcoord_jax as nc
from natcoord_jax import gallery

def final_energy(dt):
    example = gallery.load("pendulum")
    return example.system.energy(nc.simulate(example.system, example.state, dt=dt, steps=20)).total[-1]

{block.group(1)}
steps = jnp.linspace(0.001, 0.02, 2 * len(jax.devices()))
assert len(jax.devices()) == 4
print(float(jnp.max(jnp.abs(on_all_cores(steps) - jax.vmap(final_energy)(steps)))))
"""
    env = os.environ | {"JAX_PLATFORMS": "cpu"}
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert float(run.stdout) < 1e-12
