"""Derivatives through contact: those of the program V-shaped, their order in the step, what grazes, lanes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import BALL, FLOOR, SHAPES, meeting, solids
from differences import assert_v_shaped

import natcoord_jax as nc

SLOW, EXHAUSTIVE = pytest.mark.slow, pytest.mark.exhaustive
EXACT = 1.284175
"""Derivative of the height after 1 s by that at the start: a drop of 1 m from 0.3 m/s on a hard floor."""
SOFT = -5.1402e-7
"""The same height by the stiffness of a floor of 1e4 N/m under 1 kg [m^2/N], by pieces of exact solutions."""


def drop(**contact):
    """A mass of 1 kg, 1 m above a floor, that begins with 0.3 m/s upwards."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 1.0), velocity=(0, 0, 0.3), name="mass"))
    scene.add(nc.Contact(mass, FLOOR, name="impact", **contact))
    return scene.compile()


def thrown(**contact):
    """A ball of 1 kg that meets a floor with slip."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.12), velocity=(1.0, 0.2, -0.5), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, name="impact", **contact))
    return scene.compile()


def cloud():
    """Balls on a lattice that look for their neighbours."""
    scene, random = nc.Scene(), np.random.default_rng(3)
    lattice = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:5]
    balls = [
        scene.add(nc.RigidBody(**BALL, position=0.22 * x, velocity=2.0 * random.normal(size=3)))
        for x in lattice
    ]
    scene.add(nc.Contact(all_pairs_of=balls, stiffness=2e5, capacity=4, name="impact"))
    return scene.compile()


CASES = {
    # Scene, numbers that are changed, step [s], steps, mark.
    "soft": (lambda: drop(stiffness=1e4, restitution=0.8, speed=4.0),
             ("stiffness", "restitution"), 5e-3, 200, ()),
    "hard": (lambda: drop(restitution=0.8), ("restitution",), 1e-2, 90, EXHAUSTIVE),
    "hard and rubbing": (lambda: thrown(restitution=0.5, friction=0.2), ("friction",), 1e-2, 30, EXHAUSTIVE),
    "rubbing": (lambda: thrown(stiffness=2e4, friction=0.2), ("friction", "stiffness"), 2e-3, 60, EXHAUSTIVE),
    "edges": (lambda: meeting("box, box", "soft", turn="edge"), (), 2e-3, 60, EXHAUSTIVE),
    "surfaces": (lambda: solids(stiffness=2e3), ("stiffness",), 4e-3, 15, EXHAUSTIVE),
    "surfaces that rub": (lambda: solids(stiffness=2e3, friction=0.4, one_pass=True),
                          ("friction",), 4e-3, 10, EXHAUSTIVE),
    "mortar": (lambda: solids(method="mortar"), ("stiffness",), 4e-3, 10, EXHAUSTIVE),
    "search": (cloud, ("stiffness",), 1e-3, 50, EXHAUSTIVE),
}  # fmt: skip


def outcome(make, numbers, dt, steps):
    """Of a change of the start and of each number: weighted places and speeds at the end."""
    system, state = make()
    weights = jnp.cos(jnp.arange(state.v.size)).reshape(state.v.shape)
    values = {number: jnp.asarray(system.get("impact", number)) for number in numbers}

    @jax.jit
    def last(x):
        changed = system
        for k, (number, value) in enumerate(values.items()):
            changed = changed.set("impact", **{number: value * (1 + x[k + 1])})
        start = nc.State(**{**vars(state), "v": state.v * (1 + x[0])})
        end = nc.simulate(changed, start, dt=dt, steps=steps, throw=False)
        return jnp.vdot(weights, end.q[-1]) + 0.1 * jnp.vdot(weights, end.v[-1])

    return last


@pytest.mark.parametrize("case", [pytest.param(name, marks=case[4]) for name, case in CASES.items()])
def test_derivatives_are_those_of_the_program(case):
    """In reverse and forward, by the start and by numbers of the contact: V-shaped."""
    last = outcome(*CASES[case][:4])
    count = 1 + len(CASES[case][1])
    x, along = 0.013 * jnp.arange(1.0, count + 1), jnp.asarray([1.0, -0.4, 0.3])[:count]
    slope = jnp.vdot(jax.grad(last)(x), along)
    assert_v_shaped(last, x, along, slope, steps=10.0 ** -np.arange(1.5, 9.0, 0.5))
    if case != "soft":
        assert float(jax.jvp(last, (x,), (along,))[1]) == pytest.approx(float(slope), rel=tol.SAME_GRADIENT)


@EXHAUSTIVE
@pytest.mark.parametrize("case", ["soft", "hard"])
def test_second_derivatives_are_those_of_the_program(case):
    """Where no difference crosses a change of contacts."""
    last = outcome(*CASES[case][:4])
    count = 1 + len(CASES[case][1])
    x, along = 0.013 * jnp.arange(1.0, count + 1), jnp.asarray([1.0, -0.4, 0.3])[:count]
    slope = jax.jit(lambda x: jnp.vdot(jax.grad(last)(x), along))
    bend = jax.jvp(slope, (x,), (along,))[1]
    assert_v_shaped(slope, x, along, bend, steps=10.0 ** -np.arange(2.0, 9.0, 0.5))


@EXHAUSTIVE
@pytest.mark.parametrize("shape", ["box", "capsule"])
def test_derivatives_where_contacts_share_a_load(shape):
    """What each bears is known by compliance alone: forward, reverse and differences agree nevertheless."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    lying = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    start = {"position": (0, 0, 0.3), "velocity": (1.0, 0.2, 0), "orientation": lying}
    body = scene.add(nc.RigidBody(shape=SHAPES[shape], density=100.0, **start))
    scene.add(nc.Contact(body, FLOOR, restitution=0.5, friction=0.3, name="rubs"))
    system, state = scene.compile()

    @jax.jit
    def place(friction):
        changed = system.set("rubs", friction=friction)
        return nc.simulate(changed, state, dt=0.01, steps=24).q[jnp.array([21, 22, 24]), 0, :2]

    forward, reverse = jax.jit(jax.jacfwd(place))(0.3), jax.jit(jax.jacrev(place))(0.3)
    assert np.all(np.abs(forward[:, 0]) > 1e-3)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-10)
    differences = (place(0.3 + 1e-4) - place(0.3 - 1e-4)) / 2e-4
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-7)


@SLOW
def test_derivative_by_stiffness_is_of_order_two():
    """Six steps in a contact are good to 5 %, twelve to 1.5 %; the report counts them and says so."""
    system, state = drop(stiffness=1e4)

    @jax.jit
    def end(k, dt, steps):
        run = nc.simulate(
            system.set("impact", stiffness=k), state, dt=dt, steps=nc.Steps(steps, 800), throw=False
        )
        return run.q[-1, 0, 2]

    slope, errors = jax.jit(lambda *x: jax.jvp(lambda k: end(k, *x), (1e4,), (1.0,))[1]), []
    for h in (1e-2, 5e-3, 2.5e-3, 1.25e-3):
        steps = round(1 / h)
        errors.append(abs(float(slope(h, steps)) / SOFT - 1))
        report = nc.contacts(system, nc.simulate(system, state, dt=h, steps=nc.Steps(steps, 800)))
        assert report.steps_in_contact[0] == pytest.approx(0.0314 / h, abs=2.1)
        assert any("fewer than six" in note for note in report.notes) == (h > 5.5e-3)
    assert errors[1] <= 0.05 and errors[2] <= 0.015 and errors[3] <= 0.005
    assert errors[0] / errors[3] > 20


@EXHAUSTIVE
def test_an_impact_inside_a_step_is_told():
    """There the derivative is that of the program, not of the motion; how far differences agree is told."""
    system, state = drop(restitution=1.0)

    def start(by):
        return eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].add(by))

    @jax.jit
    def end(by):
        return nc.simulate(system, start(by), dt=5e-3, steps=200, throw=False).q[-1, 0, 2]

    slope = float(jax.grad(end)(1e-3))
    assert abs(slope - EXACT) > 0.1
    report = nc.contacts(system, nc.simulate(system, start(1e-3), dt=5e-3, steps=200))
    assert report.notes == ("impact inside a step: impact; derivatives are those of the program",)
    # A difference within the margin agrees; the gap moves as the mass does.
    step = 0.2 * float(report.margin.min())
    apart = (end(1e-3 + step) - end(1e-3 - step)) / (2 * step)
    assert float(apart) == pytest.approx(slope, rel=1e-5)


@EXHAUSTIVE
def test_grazing():
    """Past a disc: the nearer to its rim, the steeper without a stiffness; with one bounded, and 0 beyond."""
    slopes = {}
    for name, contact in (("hard", {"restitution": 1.0}), ("soft", {"stiffness": 1e4})):
        scene = nc.Scene()
        ball = nc.RigidBody(mass=1.0, inertia=(1.0,) * 3, shape=nc.Sphere(0.5), position=(-2, 0, 0))
        ball = scene.add(ball)
        post = scene.add(nc.RigidBody(mass=1e9, inertia=(1e9,) * 3, shape=nc.Sphere(0.5)))
        scene.add(nc.Contact(post, ball, name="post", **contact))
        system, state = scene.compile()

        def side(b, system=system, state=state):
            rows = state.q.at[0, 1].add(b), state.v.at[0, 0].set(1.0)
            start = eqx.tree_at(lambda s: (s.q, s.v), state, rows)
            return nc.simulate(system, start, dt=2e-3, steps=1500, throw=False).q[-1, 0, 1]

        slope = jax.jit(jax.grad(side))
        slopes[name] = [float(slope(b)) for b in (0.9, 0.99, 0.99999, 1.001)]
    assert np.isfinite(list(slopes.values())).all()
    hard, soft = np.abs(slopes["hard"]), np.abs(slopes["soft"])
    assert hard[2] > 3 * hard[1] > 6 * hard[0]
    assert soft[2] < 0.5 * hard[2]
    assert slopes["hard"][3] == pytest.approx(1.0) and slopes["soft"][3] == pytest.approx(1.0)


@EXHAUSTIVE
def test_lanes_with_other_contacts():
    """64 drops from other heights with friction and spin: each lane has the derivative that it has alone."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = nc.RigidBody(shape=nc.Sphere(0.1), density=300.0, position=(0, 0, 0.2), velocity=(1.0, 0, 0))
    ball = scene.add(ball)
    scene.add(nc.Contact(ball, FLOOR, restitution=0.6, friction=0.2, name="bounce"))
    system, state = scene.compile()

    def run(x):
        start = eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].add(x))
        return nc.simulate(system, start, dt=0.01, steps=60, throw=False)

    def end(x):
        return run(x).q[-1, 0, 0]

    starts = jnp.linspace(0.0, 0.5, 64)
    lanes = jax.jit(jax.vmap(jax.value_and_grad(end)))(starts)
    motions = jax.jit(jax.vmap(run))(starts)
    report = nc.contacts(system, motions)
    assert len(np.unique(report.impacts.sum(axis=(1, 2)))) >= 3
    np.testing.assert_allclose(report.gap[..., 0], np.asarray(motions.q)[:, :, 0, 2] - 0.1, atol=1e-14)
    alone = jax.jit(jax.value_and_grad(end))
    for k in range(0, 64, 9):
        np.testing.assert_allclose([x[k] for x in lanes], alone(starts[k]), rtol=1e-9, atol=1e-11)
