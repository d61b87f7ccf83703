"""Starts where something is exactly zero: rest, strain, angles, distances.

What could go wrong: the root of zero, the quotient of two zeros, the arc tangent at the origin. Values
survive that by a `where`; derivatives do not, and a guard that is right for the first derivative is silently
wrong for the second (exact values: `test_gradients.test_second_derivative_starting_at_rest`).
"""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from motions import simulate

import natcoord_jax as nc

JOINTS = (("cardan", nc.Universal), ("tube", nc.Cylindrical))


@cache
def still():
    """Joint coordinates and stores at exactly zero, axes along those of the world, no gravity."""
    scene = nc.Scene()
    carrier, place = nc.ground, jnp.zeros(3)
    for name, joint in JOINTS:
        body = scene.add(
            nc.RigidBody(mass=1.0, inertia=(0.2, 0.2, 0.2), position=place, name=f"body of {name}")
        )
        hinge = scene.add(
            joint(carrier, body, point=place, axis=(0.0, 0.0, 1.0), second=(1.0, 0.0, 0.0), name=name)
        )
        for k in range(len(joint.coordinates)):
            scene.add(nc.JointSpring(hinge, coordinate=k, stiffness=3.0, name=f"coil {k} of {name}"))
        ends = nc.Point(carrier, place + jnp.array([0.0, 1.0, 0.0])), nc.Point(body, place)
        scene.add(nc.Spring(ends, name=f"spring of {name}", stiffness=5.0, length=1.0))
        scene.add(nc.Damper(ends, name=f"dashpot of {name}", damping=0.1))
        carrier, place = body, place + jnp.array([1.0, 0.0, 0.0])
    last = scene.add(nc.PointMass(mass=1.0, position=place, name="bead"))
    scene.add(
        nc.Distance(carrier, last, point=place, parent_point=place - jnp.array([1.0, 0.0, 0.0]), name="rod")
    )
    return scene.compile()


@cache
def collapsed(length: float):
    """A spring whose ends coincide: it has no direction, and no force only without natural length."""
    scene = nc.Scene()
    bead = scene.add(nc.PointMass(mass=1.0, name="bead"))
    scene.add(nc.Spring((nc.Point(nc.ground), nc.Point(bead)), name="spring", stiffness=5.0, length=length))
    return scene.compile()


DIRECTION = jnp.array(0.7), jnp.array(0.2)


@cache
def derivatives(order: int, modes: str):
    """Of a function of a speed and a mass: value and gradient; tangent; change of the gradient."""

    def end(x, system, state, speeds):
        amount, factor = x
        mass = system.get("bead", "mass")
        start = dataclasses.replace(state, v=amount * speeds)
        run = simulate(
            system.set("bead", mass=mass * factor), start, order=order, dt=0.05, steps=4, throw=False
        )
        last = run.states
        return jnp.sum(last.q[-1, :, 0]) + jnp.sum(last.v[-1] ** 3) + 0.3 * jnp.sum(last.coordinates[-1])

    @jax.jit
    def program(*scene):
        x = jnp.array(0.0), jnp.array(1.0)

        def along(function):
            return jax.jvp(lambda x: function(x, *scene), (x,), (DIRECTION,))[1]

        results = {}
        results["value"], results["gradient"] = jax.value_and_grad(end)(x, *scene)
        if "tangent" in modes:
            results["tangent"] = along(end)
        if "second" in modes:
            results["curvature"] = along(jax.grad(end))
        return results

    return program


def assert_finite_at_rest(order, system, state, modes):
    """In these modes, with a gradient that is not zero and agrees with the tangent."""
    shaken = dataclasses.replace(state, v=jax.random.normal(jax.random.key(0), state.v.shape))
    results = derivatives(order, modes)(system, state, nc.assemble(system, shaken).v)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(results)), results
    gradient = results["gradient"]
    assert float(jnp.abs(gradient[0])) > 0, "nothing depends on the start: nothing is tested"
    if "tangent" in results:
        along = DIRECTION[0] * gradient[0] + DIRECTION[1] * gradient[1]
        np.testing.assert_allclose(results["tangent"], along, rtol=tol.SAME_GRADIENT)


@pytest.mark.parametrize(
    "order, modes",
    [
        pytest.param(2, "", marks=pytest.mark.slow),
        pytest.param(2, "tangent second", marks=pytest.mark.exhaustive),
        pytest.param(4, "tangent second", marks=pytest.mark.exhaustive),
    ],
)
def test_ends_of_a_spring_that_coincide(order, modes):
    """Finite in these modes: without natural length the spring is linear, with one it has no force."""
    for length in (0.0, 0.5):
        assert_finite_at_rest(order, *collapsed(length), modes)


@pytest.mark.exhaustive
@pytest.mark.parametrize("order, modes", [(2, "tangent second"), (4, "tangent")])
def test_everything_at_zero(order, modes):
    """Rest, zero strain, aligned axes: value, gradient, tangent and Hessian times vector are finite.

    At order four the latter compiles for minutes: it is left to the single spring above.
    """
    assert_finite_at_rest(order, *still(), modes)
