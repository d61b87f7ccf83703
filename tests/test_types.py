"""Shapes and types of annotated functions, checked while some scenes are traced."""

import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.maths.rotations import from_quaternion

ROOT = Path(__file__).resolve().parents[1]
SCENES = ("spacecraft", "bricard", "rope", "double_pendulum")


@pytest.mark.slow
def test_shapes_and_types():
    command = [sys.executable, "-m", "pytest", "--check-types", "-q", "-n0", "-p", "no:cacheprovider"]
    command += ["tests/test_types.py"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-3000:]
    passed = re.search(r"(\d+) passed", run.stdout)
    assert passed and int(passed[1]) == 2 and "skipped" not in run.stdout


@pytest.fixture
def checked(request):
    if not request.config.option.check_types:
        pytest.skip("types are not checked in this run")


@pytest.mark.usefixtures("checked")
def test_a_wrong_shape_is_found():
    with pytest.raises(TypeCheckError):
        from_quaternion(jnp.zeros(5))


@pytest.mark.usefixtures("checked")
def test_scenes_pass():
    wrong = []
    for name in SCENES:
        example = gallery.load(name)
        inputs = example.inputs(2, 1e-3)

        def speed(state, example=example, inputs=inputs):
            return jnp.sum(nc.simulate(example.system, state, dt=1e-3, inputs=inputs).v[-1] ** 2)

        try:
            assert jax.jit(speed).trace(example.state).jaxpr
        except TypeCheckError as error:
            wrong.append(f"{name}: {error}")
    assert not wrong, "\n".join(wrong)
