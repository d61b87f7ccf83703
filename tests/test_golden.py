"""Twelve scenes as they were: states, gradients, iterations and the size of their programs.

What rebuilds the engine changes none of them. `pytest tests/test_golden.py -m "users or slow or exhaustive"
--compile quick --write-golden` writes the file anew, where a change is meant; the commit says why. Each entry
says at which compiler flags it was made: with others sums are rounded otherwise, and rounding decides whether
the last iteration of a step is made.
"""

import json
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery

FILE = Path(__file__).with_name("golden.json")
STEPS = 20
FLAGS = os.environ["NATCOORD_JAX_EFFORT"]
"""Of the compiler, as `conftest` chose them: "quick", or "full" as of users."""
SCENES = (
    "heavy_top",
    "spacecraft",
    "double_pendulum",
    "torsion_spring",
    "four_bar",
    "bricard",
    "slider_crank",
    "binary_tree",
    "robot_arm",
    "mass_ladder",
    "rope",
    "cantilever",
)
USERS = {(scene, 2) for scene in ("heavy_top", "double_pendulum", "four_bar")}
"""Cases by default, and at the flags of users again."""
SLOW = {
    (scene, 2)
    for scene in (
        "spacecraft",
        "torsion_spring",
        "mass_ladder",
        "slider_crank",
    )
}
"""The others compile for longer."""


def lane(case: tuple[str, int]) -> pytest.MarkDecorator:
    if case in USERS:
        return pytest.mark.users
    return pytest.mark.slow if case in SLOW else pytest.mark.exhaustive


CASES = [
    pytest.param(scene, order, marks=lane((scene, order)), id=f"{scene}, {order}")
    for scene in SCENES
    for order in (2, 4)
]


def size(program: jax.stages.Lowered) -> dict[str, int]:
    """Operations and loops of a lowered program."""
    text = program.as_text()
    return {"operations": text.count(" = "), "loops": text.count("stablehlo.while")}


def measured(name: str, order: int) -> dict[str, Any]:
    """What the file holds of a scene."""
    example = gallery.load(name)
    scheme = nc.EnergyMomentum(order=order)
    inputs = example.inputs(STEPS, scheme=scheme)
    numbers, structure = eqx.partition((example.system, example.state, inputs), eqx.is_inexact_array)

    def run(numbers: Any, v: Any, dt: Any) -> tuple[Any, nc.Trajectory]:
        system, state, inputs = eqx.combine(numbers, structure)
        state = eqx.tree_at(lambda s: s.v, state, v)
        trajectory = nc.simulate(system, state, dt=dt, inputs=inputs, scheme=scheme)
        return jnp.sum(trajectory.v[-1] ** 2) + jnp.sum(trajectory.q[-1] ** 2), trajectory

    arguments = numbers, example.state.v, jnp.asarray(example.dt, float)
    value = jax.jit(run).lower(*arguments)
    gradient = jax.jit(jax.value_and_grad(run, argnums=(1, 2), has_aux=True)).lower(*arguments)
    (_, trajectory), (by_v, by_dt) = gradient.compile()(*arguments)
    assert int(trajectory.result) == 0
    return {
        "flags": FLAGS,
        "q": trajectory.q[-1].ravel().tolist(),
        "v": trajectory.v[-1].ravel().tolist(),
        "by v": by_v.ravel().tolist(),
        "by dt": float(by_dt),
        "iterations": int(trajectory.iterations),
        "value": size(value),
        "gradient": size(gradient),
    }


def distance(a: Any, b: Any) -> float:
    """Relative, by the largest number."""
    a, b = np.asarray(a), np.asarray(b)
    return float(np.max(np.abs(a - b), initial=0.0) / max(np.max(np.abs(b), initial=0.0), 1e-300))


@pytest.mark.parametrize(("scene", "order"), CASES)
def test_scenes_are_as_they_were(scene, order, request):
    now, key = measured(scene, order), f"{scene}, {order}"
    if request.config.option.write_golden:
        golden = json.loads(FILE.read_text()) if FILE.exists() else {}
        golden[key] = now
        FILE.write_text(json.dumps(dict(sorted(golden.items())), indent=0) + "\n")
    golden = json.loads(FILE.read_text())[key]
    assert distance(now["q"], golden["q"]) <= tol.GOLDEN_STATE
    assert distance(now["v"], golden["v"]) <= tol.GOLDEN_STATE
    assert distance(now["by v"], golden["by v"]) <= tol.GOLDEN_GRADIENT
    assert distance(now["by dt"], golden["by dt"]) <= tol.GOLDEN_GRADIENT
    may_differ = 0 if golden["flags"] == FLAGS else tol.GOLDEN_ITERATIONS * golden["iterations"]
    assert abs(now["iterations"] - golden["iterations"]) <= may_differ
    for program in ("value", "gradient"):
        for what, count in golden[program].items():
            assert now[program][what] <= count, f"{what} of the {program}'s program"
