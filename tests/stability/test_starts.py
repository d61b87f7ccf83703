"""Starts where something is exactly zero: rest, strain, angles, distances.

What could go wrong: the root of zero, the quotient of two zeros, the arc tangent at the origin. Values
survive that by a `where`; derivatives do not, and a guard that is right for the first derivative is silently
wrong for the second (exact values: `test_gradients.test_second_derivative_starting_at_rest`).
"""

from functools import cache

import jax
import jax.numpy as jnp
import pytest
import tolerances as tol
from motions import simulate

import natcoord_jax as nc

JOINTS = (("cardan", nc.Universal), ("tube", nc.Cylindrical))


@cache
def still():
    """Every joint coordinate and store at exactly zero, axes along those of the world, no gravity."""
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


def finite(tree) -> bool:
    return all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(tree))


def moving(state, v):
    return nc.State(state.t, state.q, v, state.coordinates, state.rates, state.work)


def at_rest(order, system, state, second=True):
    """Value, tangent, gradient and second derivative along a direction, all of one function at rest."""
    pushed = nc.assemble(system, moving(state, jax.random.normal(jax.random.key(0), state.v.shape))).v

    def f(x):
        amount, factor = x
        heavier = system.__class__(**(vars(system) | {"mass": system.mass * factor}))
        start = moving(state, amount * pushed)
        found = simulate(heavier, start, order=order, dt=0.05, steps=4, throw=False)
        last = found.states
        return jnp.sum(last.q[-1, :, 0]) + jnp.sum(last.v[-1] ** 3) + 0.3 * jnp.sum(last.coordinates[-1])

    x, d = (jnp.array(0.0), jnp.array(1.0)), (jnp.array(0.7), jnp.array(0.2))

    def along(x):
        return jax.jvp(f, (x,), (d,))

    if not second:
        return jax.jit(lambda x: (*along(x), jax.grad(f)(x)))(x)
    gradient, curvature = jax.jit(lambda x: jax.jvp(jax.grad(f), (x,), (d,)))(x)
    return *jax.jit(along)(x), gradient, curvature


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4])
def test_everything_at_zero(order):
    """Rest, zero strain, aligned axes: value, gradient, tangent and Hessian times vector are finite.

    At order four the latter compiles for minutes: it is left to the single spring below.
    """
    found = at_rest(order, *still(), second=order == 2)
    assert finite(found)
    _, tangent, gradient = found[:3]
    assert float(jnp.abs(gradient[0])) > 0, "nothing depends on the start: nothing is tested"
    assert float(tangent) == pytest.approx(
        float(0.7 * gradient[0] + 0.2 * gradient[1]), rel=tol.SAME_GRADIENT
    )


@cache
def collapsed(length: float):
    """A spring whose ends coincide: it has no direction, and no force only without natural length."""
    scene = nc.Scene()
    ball = scene.add(nc.PointMass(mass=1.0, name="ball"))
    scene.add(nc.Spring((nc.Point(nc.ground), nc.Point(ball)), name="spring", stiffness=5.0, length=length))
    return scene.compile()


@pytest.mark.parametrize(
    "order, length",
    [
        pytest.param(2, 0.0, marks=pytest.mark.exhaustive),
        pytest.param(2, 0.5, marks=pytest.mark.slow),
        pytest.param(4, 0.0, marks=pytest.mark.exhaustive),
    ],
)
def test_ends_of_a_spring_that_coincide(order, length):
    """Finite in every mode: without natural length the spring is linear, with one it has no force."""
    assert finite(at_rest(order, *collapsed(length)))
