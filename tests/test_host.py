"""Setting up a scene compiles nothing: small calculations are done by NumPy, with the same results."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import natcoord_jax as nc
from natcoord_jax.core.eager_numpy import eager_numpy

X = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
PLACES = jnp.array([2, 0, 3])


def beam(curve):
    return nc.Beam(nc.CircularSection(radius=0.01, E=1e6, density=1e3), curve, elements=5, length=1.0)


CASES = {
    "elementwise": lambda x: (
        jnp.sin(x) ** 3 / (1 + x**2),
        jnp.sign(x),
        jnp.clip(x, 0, 1),
        jnp.abs(x) ** 0.3,
    ),
    "integers": lambda x: (jnp.arange(7) // 2, jnp.arange(7) % 3, PLACES**2, jnp.round(x).astype(int)),
    "reductions": lambda x: (jnp.linalg.norm(x, axis=1), jnp.max(x, 0), jnp.any(x > 0), jnp.cumsum(x, 1)),
    "extremes": lambda x: (jnp.argmin(x, axis=1), jnp.argmax(x), jnp.min(x, initial=-3.0)),
    "none": lambda x: (jnp.max(x[:0], initial=0.0), jnp.min(x[:0], 0, initial=1.0), jnp.sum(x[:0], 0)),
    "shapes": lambda x: (x.T, x[::-1, 1:], jnp.tile(x, 2), jnp.pad(x, 1), jnp.roll(x, 1), jnp.split(x, 2)),
    "taken apart": lambda x: (*jnp.unstack(x), *jnp.unstack(x, axis=1), *jnp.unstack(x[0])),
    "joined": lambda x: (jnp.stack([x, x], 1), jnp.block([[x, x], [x, x]]), jnp.diag(x[0]), jnp.diff(x)),
    "taken": lambda x: (x[PLACES], x[PLACES, 1], x[:, PLACES % 3], x[-1], x[PLACES[0]], jnp.take(x, 9)),
    "put": lambda x: (
        x.at[PLACES].set(1.0),
        x.at[PLACES, 0].add(x[:3, 1]),
        x.at[jnp.array([1, 1])].add(2.0),
        x.at[7].set(1.0, mode="drop"),
        x.at[1].multiply(3.0),
    ),
    "by lanes": lambda x: jax.vmap(lambda row, k: (row[k], row.at[k].set(0.0)))(x, jnp.array([0, 1, 2, 1])),
    "products": lambda x: (x @ x.T, jnp.einsum("ij,kj->ik", x, x), jnp.einsum("bi,bj->bij", x, x)),
    "derivatives": lambda x: (
        jax.vmap(jax.jacfwd(lambda r: jnp.cross(r, r**2)))(x),
        jax.grad(lambda y: jnp.sum(jnp.tanh(y) * y))(x),
    ),
    "loops": lambda x: (
        lax.scan(lambda s, y: (s + y, s * y), x[0], x, reverse=True),
        lax.while_loop(lambda s: jnp.sum(s) < 9.0, lambda s: s + 1.0, x[0]),
        jax.vmap(lambda row: lax.while_loop(lambda s: jnp.sum(s) < 9.0, lambda s: s + 1.0, row))(x),
        lax.fori_loop(0, 3, lambda k, s: s * x[k, 0], 1.0),
        lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x[1]),
    ),
    "found": lambda x: (jnp.interp(x[0], jnp.arange(5.0), jnp.arange(5.0) ** 2), jnp.searchsorted(x[0], 0.0)),
    "not a number": lambda x: (jnp.nanmax(x / 0.0 - x), jnp.isnan(x / 0.0), jnp.maximum(x, jnp.nan)),
    "left to the compiler": lambda x: (jnp.sort(x), jnp.linalg.solve(x[:3] + 3 * jnp.eye(3), x[0])),
}


def unlike(expected, answers):
    """What differs in kind or in value."""
    pairs = zip(jax.tree.leaves(expected), jax.tree.leaves(answers), strict=True)
    return [
        (want, have)
        for want, have in pairs
        if not isinstance(have, jax.Array)
        or (want.shape, want.dtype) != (have.shape, have.dtype)
        or not np.allclose(have, want, rtol=1e-13, atol=1e-14, equal_nan=True)
    ]


def test_results_are_those_of_programs():
    """Could go wrong: an operation that NumPy defines differently at a corner; results that are no arrays."""
    expected = jax.jit(lambda x: {name: case(x) for name, case in CASES.items()})(X)
    wrong = {name: unlike(expected[name], eager_numpy(case)(X)) for name, case in CASES.items()}
    assert not any(wrong.values()), wrong


@pytest.mark.exhaustive
def test_lanes_outside_of_programs_are_evaluated_all_at_once():
    """Could go wrong: lanes along another axis, and what is not in lanes; `jax.vmap` in another one, too."""
    cases = {name: case for name, case in CASES.items() if name not in ("by lanes", "taken apart")}
    many, factor = jnp.stack([X, 2 * X, -X], axis=1), jnp.asarray(1.5)

    @jax.jit
    @partial(jax.vmap, in_axes=1)
    def programs(x):
        return {name: case(x * 1.5) for name, case in cases.items()}

    expected, wrong = programs(many), {}
    for name, case in cases.items():
        of_two = eager_numpy(lambda x, y, case=case: case(x * y))
        lanes = jax.vmap(of_two, in_axes=(1, None))(many, factor)
        nested = jax.vmap(jax.vmap(of_two, in_axes=(0, None)), in_axes=(None, 0))(X[None], factor[None])
        first, one = (
            jax.tree.map(lambda x, k=k: x[k], y) for k, y in ((0, expected[name]), ((0, 0), nested))
        )
        wrong[name] = unlike(expected[name], lanes) + unlike(first, one)
    assert not any(wrong.values()), wrong


def test_transformed_it_is_the_function_itself():
    square = eager_numpy(lambda x: jnp.sum(x**2))
    np.testing.assert_allclose(jax.grad(square)(X), 2 * X)
    np.testing.assert_allclose(jax.jit(square)(X), jnp.sum(X**2))
    np.testing.assert_allclose(jax.vmap(square)(X), jnp.sum(X**2, axis=1))


def test_derivatives_outside_of_programs_are_programs_as_a_whole(programs):
    def long(x):
        for _ in range(5):
            x = jnp.sin(x[::-1]) * jnp.tanh(x) + x[0]
        return x.sum()

    numbers = jnp.asarray(np.linspace(0.1, 0.2, 17))
    del programs[:]
    slope = jax.grad(eager_numpy(long))(numbers)
    assert len(programs) <= 4, programs
    np.testing.assert_allclose(slope, jax.jit(jax.grad(long))(numbers), rtol=1e-12)


def test_what_is_closed_over_may_be_traced():
    """Could go wrong: arguments that are known, or lanes, and a function that reads what is neither."""

    def product(x, y):
        return jnp.sum(eager_numpy(lambda z: z * x)(y))

    np.testing.assert_allclose(jax.grad(lambda x: product(x, X))(2.0), jnp.sum(X))
    np.testing.assert_allclose(jax.vmap(lambda x: product(x, X))(X[:, 0]), X[:, 0] * jnp.sum(X), rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(product)(X[:, 0], X), X[:, 0] * jnp.sum(X, axis=1), rtol=1e-14)
    slope = jax.grad(lambda x: jnp.sum(jax.vmap(lambda y: product(x, y))(X)))(2.0)
    np.testing.assert_allclose(slope, jnp.sum(X))


def test_a_program_within_lanes_is_a_program():
    """Could go wrong: values in lanes that a program reads are no lanes there."""
    square = eager_numpy(lambda x: jnp.sum(x**2))
    for compiled in jax.jit, nc.jit:
        lanes = jax.vmap(lambda x, compiled=compiled: compiled(lambda y: square(x) + y)(1.0))(X)
        np.testing.assert_allclose(lanes, jnp.sum(X**2, axis=1) + 1.0)
    inner = nc.jit(jnp.sin)
    lanes = jax.vmap(lambda x: jax.jit(lambda: inner(x))())(X)
    np.testing.assert_allclose(lanes, jnp.sin(X), rtol=1e-15)


@pytest.mark.exhaustive
def test_states_in_lanes_compile_next_to_nothing(programs):
    """Could go wrong: setting a joint in each of some states, one operation after the other."""
    scene, body = nc.Scene(), nc.ground
    for k in range(5):
        link = nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 2.5), position=(k, 0.0, 0.0))
        child = scene.add(link)
        scene.add(nc.Revolute(body, child, point=(k - 0.5, 0, 0), axis=(0, 1, 0), name=f"hinge {k}"))
        body = child
    system, state = scene.compile()
    angles = jnp.asarray(np.linspace(0.0, 1.0, 9))

    def posed(angle):
        return system.with_coordinate(state, "hinge 1", angle, rate=2.0)

    del programs[:]
    states = jax.vmap(posed)(angles)
    energy = jax.vmap(system.energy)(states).total
    assert len(programs) <= 30, programs
    before = len(programs)
    jax.grad(lambda angle: system.energy(posed(angle)).total)(0.3)
    assert len(programs) - before <= 12, programs[before:]
    for have, want in zip(jax.tree.leaves(states), jax.tree.leaves(jax.jit(jax.vmap(posed))(angles))):
        np.testing.assert_allclose(have, want, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(energy[3], system.energy(posed(angles[3])).total, rtol=1e-12)


def test_numbers_of_python_are_no_arrays():
    """Could go wrong: a goal or a shape of the user's that decides by a field, or holds a key."""

    def branching(x, size, flag=False):
        return x * 2 if size > 1.0 else (x if flag else -x)

    double = eager_numpy(branching)
    np.testing.assert_array_equal(double(X, 2.0), 2 * X)
    np.testing.assert_array_equal(double(X, 0.5), -X)
    np.testing.assert_array_equal(double(X, 0.5, True), X)
    np.testing.assert_array_equal(double(X, 0.5, 0), -X)
    assert np.signbit(eager_numpy(lambda x, y: x * y)(np.ones(1), -0.0))
    assert not np.signbit(eager_numpy(lambda x, y: x * y)(np.ones(1), 0.0))
    key = jax.random.key(1)
    np.testing.assert_array_equal(eager_numpy(jax.random.uniform)(key), jax.random.uniform(key))


def test_arrays_do_not_share_memory_with_what_was_passed():
    """Could go wrong: an array of the notebook, changed in place, that changes a scene."""
    place = np.ones(3)
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=place))
    place[:] = 2.0
    system, state = scene.compile()
    gravity = np.array([0.0, 0.0, -9.81])
    scene.add(nc.Gravity(vector=gravity, name="gravity"))
    heavy, _ = scene.compile()
    gravity[:] = 0.0
    np.testing.assert_array_equal(state.q[0], 1.0)
    np.testing.assert_allclose(heavy.energy(state).stores["gravity"], 9.81)


def test_functions_are_read_anew():
    """Could go wrong: a curve that reads a number of the notebook, which has changed since."""
    radius = 1.0

    def curve(s):
        return jnp.array([radius * jnp.sin(s / radius), 0.0, radius * (1 - jnp.cos(s / radius))])

    ends = []
    for radius in (1.0, 2.0):  # noqa: B007
        scene = nc.Scene()
        scene.add(beam(curve))
        ends.append(np.asarray(scene.compile()[1].q)[-4])
    assert abs(ends[0][2] - (1 - np.cos(1.0))) < 1e-12
    assert abs(ends[1][2] - 2 * (1 - np.cos(0.5))) < 1e-12


def test_setting_up_a_scene_compiles_next_to_nothing(programs):
    """Could go wrong: an operation called from Python, which is a program for every new shape."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    body, size = nc.ground, 37
    for k in range(size):
        link = nc.RigidBody(mass=1.0 + k, inertia=(1.0, 2.0, 2.5), position=(k, 0.0, 0.0))
        child = scene.add(link)
        hinge = scene.add(nc.Revolute(body, child, point=(k - 0.5, 0.0, 0.0), axis=(0.0, 1.0, k)))
        scene.add(nc.JointSpring(hinge, stiffness=1.0))
        body = child
    section = nc.TubularSection(radius=0.01, thickness=0.002, E=1e9, density=1e3)
    scene.add(nc.Beam(section, [(0, 0, 1), (1, 0, 1), (1, 1, 1)], elements=41, start=nc.ground))
    system, state = scene.compile()
    system.energy(state), system.constraint_errors(state)
    assert len(programs) <= 8, programs
