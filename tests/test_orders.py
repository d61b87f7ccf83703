"""The schemes of order four to ten: what is kept, and how fast errors fall."""

from fractions import Fraction
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from scenes import JOINTS, pair, with_multipliers

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.maths.coefficients import collocation
from natcoord_jax.maths.collocation import gauss, rotate_stages
from natcoord_jax.stepping.plan import Plan

ORDERS = (2, 4, 6, 8, 10)
USUAL = {(4, "universal", "tree"), (6, "revolute", "tree")}
EVERY_PAIR = [
    pytest.param(order, joint, form, marks=[] if (order, joint, form) in USUAL else pytest.mark.slow)
    for order, forms in ((4, ("multipliers", "tree")), (6, ("tree", "multipliers")))
    # Each joint in one form at order four, every other of them in the other form; two of them at order six.
    for joint, form in zip(JOINTS, len(JOINTS) * forms)
    if order == 4 or joint in ("screw", "revolute")
]


def scheme(order: int) -> nc.EnergyMomentum:
    return nc.EnergyMomentum(order=order)


@pytest.mark.parametrize(("order", "joint", "form"), EVERY_PAIR)
def test_everything_is_kept(order, joint, form):
    kind = JOINTS[joint] if form == "tree" else with_multipliers(JOINTS[joint])
    system, state = pair(kind)
    trajectory = nc.simulate(system, state, dt=0.04, steps=250, scheme=scheme(order), extra_substeps=300)
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
    errors = system.constraint_errors(trajectory)
    assert max(float(jnp.max(x)) for x in jax.tree.leaves(errors)) <= tol.TANGENT


def forced(order: int, steps: int):
    """The paper's spacecraft under torques that change smoothly."""
    example = craft()
    method, dt = scheme(order), 2.0 / steps
    times = method.times(dt, steps)
    inputs = 300.0 * jnp.sin(jnp.stack([3 * times, 2 * times + 1, times - 1], axis=-1))
    return nc.simulate(example.system, example.state, dt=dt, inputs=inputs, scheme=method)


@cache
def craft():
    return gallery.load("spacecraft")


@cache
def reference():
    return forced(10, 64)


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_order_of_a_forced_spacecraft(order):
    wanted = reference()
    steps = {2: 64, 4: 32, 6: 16, 8: 12, 10: 6}[order]
    errors = []
    for count in (steps, 2 * steps):
        found = forced(order, count)
        errors.append(
            [float(jnp.max(jnp.abs(x[-1] - y[-1]))) for x, y in ((found.q, wanted.q), (found.v, wanted.v))]
        )
    observed = np.log2(np.divide(*errors))
    assert np.all(np.abs(observed - order) <= tol.HIGH_ORDER_TOLERANCE * order), observed


@pytest.mark.slow
def test_compositions_of_the_one_stage_step_go_the_same_way():
    """Order four without stages or kicks: five steps of order two, the middle one back in time.

    Suzuki's coefficients. Back in time is forth with velocities turned round, as the step is symmetric.
    """
    example, t_end = gallery.load("heavy_top"), 0.1
    system, part = example.system, 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
    parts = jnp.array([part, part, 1.0 - 4.0 * part, part, part])

    def turned_round(state, back):
        other = eqx.tree_at(lambda s: (s.v, s.rates), state, (-state.v, -state.rates))
        return jax.tree.map(lambda x, y: jnp.where(back, x, y), other, state)

    def composed(steps):
        def body(state, h):
            after = nc.step(system, turned_round(state, h < 0), None, jnp.abs(h))
            return turned_round(after, h < 0), None

        lengths = jnp.tile(parts, steps) * t_end / steps
        return jax.jit(lambda s: jax.lax.scan(body, s, lengths)[0])(example.state)

    wanted = nc.simulate(system, example.state, dt=t_end / 40, steps=40, scheme=scheme(8))
    coarse, fine = composed(50), composed(100)
    errors = [float(jnp.max(jnp.abs(x.q - wanted.q[-1]))) for x in (coarse, fine)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)
    assert float(jnp.max(jnp.abs((16 * fine.q - coarse.q) / 15 - wanted.q[-1]))) < 0.05 * errors[1]
    energies = [float(system.energy(x).total) for x in (example.state, fine)]
    assert energies[1] == pytest.approx(energies[0], rel=tol.ENERGY)


def swinging(stiffness, order=4, steps=20, **options):
    """A pendulum with a torsion spring and a tether of large strain, as a function of the stiffness."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    arm = scene.add(
        nc.RigidBody(
            mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.1, 0, 0), position=(0.5, 0, 0), name="arm",
            angular_velocity=(0, 1.0, 0.2), velocity=(0, 0.1, -0.5),
        )
    )  # fmt: skip
    hinge = scene.add(nc.Universal(nc.ground, arm, axis=(0, 1, 0), second=(0, 0, 1), name="hinge"))
    scene.add(nc.JointSpring(hinge, coordinate=0, stiffness=stiffness, rest=0.3))
    tether = (nc.Point(nc.ground, (0, 0.3, -0.4)), nc.Point(arm, (0.8, 0, 0)))
    scene.add(nc.Spring(tether, stiffness=5.0 * stiffness, length=0.1))
    scene.add(nc.JointDamper(hinge, coordinate=1, damping=0.1))
    system, state = scene.compile()
    return system, nc.simulate(system, state, dt=1.0 / steps, steps=steps, scheme=scheme(order), **options)


@pytest.mark.slow
def test_order_with_springs_at_large_strain():
    order = 6
    best = swinging(30.0, 8, 160)[1]
    errors = [
        [float(jnp.max(jnp.abs(x[-1] - y[-1]))) for x, y in ((found.q, best.q), (found.v, best.v))]
        for found in (swinging(30.0, order, steps)[1] for steps in (40, 80))
    ]
    observed = np.log2(np.divide(*errors))
    assert np.all(np.abs(observed - order) <= tol.HIGH_ORDER_TOLERANCE * order), observed


def loss(stiffness, order=4):
    trajectory = swinging(stiffness, order, throw=False)[1]
    return jnp.sum(trajectory.q[-1, 0] ** 2) + 0.1 * jnp.sum(trajectory.v[-1] ** 3)


AT, STEP = 8.0, 1e-3


def fourth_order_difference(f):
    """Derivative at `AT` by differences whose error falls with the fourth power of the step."""
    values = [float(f(AT + k * STEP)) for k in (-2, -1, 1, 2)]
    return (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * STEP)


@pytest.mark.exhaustive
def test_derivatives_in_every_mode():
    slopes = jax.jit(jax.vmap(jax.grad(loss)))(jnp.array([AT, AT + STEP]))
    slope = float(slopes[0])
    assert slope == pytest.approx(fourth_order_difference(jax.jit(loss)), rel=tol.DIFFERENCE_BEST)
    assert abs(slope) > 1 and slopes[1] != slopes[0]
    forward = jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,))[1])
    assert float(forward(AT)) == pytest.approx(slope, rel=tol.SAME_GRADIENT)


@pytest.mark.exhaustive
def test_second_derivatives():
    """Of one hinge and its spring: programs of second derivatives are long."""

    def bent(stiffness):
        scene = nc.Scene()
        arm = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.5, 0, 0), name="arm"))
        hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0), name="hinge"))
        scene.add(nc.JointSpring(hinge, stiffness=stiffness, rest=1.0))
        system, state = scene.compile()
        found = nc.simulate(system, state, dt=0.05, steps=20, scheme=scheme(4), throw=False)
        return jnp.sum(found.q[-1] ** 3) + 0.1 * jnp.sum(found.v[-1] ** 2)

    curvature = float(jax.jit(lambda x: jax.jvp(jax.grad(bent), (x,), (1.0,))[1])(AT))
    compiled, step = jax.jit(bent), 0.05
    values = [float(compiled(AT + k * step)) for k in (-2, -1, 0, 1, 2)]
    difference = np.dot([-1, 16, -30, 16, -1], values) / (12 * step**2)
    assert abs(curvature) > 1e-3
    assert curvature == pytest.approx(difference, rel=10 * tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
def test_derivatives_with_loops():
    """Of the loop whose constraints depend on each other."""
    example = gallery.load("bricard")

    def last(scale):
        system = example.system
        system = system.__class__(**(vars(system) | {"mass": system.mass.at[0].multiply(scale)}))
        found = nc.simulate(system, example.state, dt=0.02, steps=10, scheme=scheme(4), throw=False)
        return jnp.sum(found.q[-1] ** 3) + 0.1 * jnp.sum(found.v[-1] ** 2)

    compare(last, 1.0, least=1e-3)


class Swing(eqx.Module):
    """A prescribed angle whose amplitude is a number like any other."""

    amplitude: jax.Array

    def __call__(self, t):
        return self.amplitude * (1 - jnp.cos(3.0 * t))


@pytest.mark.exhaustive
def test_derivatives_with_drives():
    """Two driven links carry a free one; the loss has the work of the drives in it."""

    def last(amplitude):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        carrier = nc.ground
        for k in range(3):
            place = np.array([0.5 * k, 0.0, 0.0])
            link = scene.add(
                nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), com=(0.25, 0, 0), position=place, name=f"{k}")
            )
            hinge = scene.add(
                nc.Revolute(carrier, link, point=place, axis=(0.0, 1.0, 0.2 * k), name=f"hinge {k}")
            )
            if k < 2:
                scene.add(nc.Drive(hinge, function=Swing(amplitude / (1 + k))))
            carrier = link
        system, state = scene.compile()
        found = nc.simulate(system, state, dt=0.05, steps=8, scheme=scheme(4), throw=False)
        return jnp.sum(found.q[-1] ** 3) + 0.1 * jnp.sum(found.v[-1] ** 2) + jnp.sum(found.states.work[-1])

    compare(last, 0.7, least=1.0)


def compare(f, at, least):
    """Derivatives forward and in reverse against differences of fourth order."""
    h, value = 1e-3, jax.jit(f)
    values = [float(value(at + k * h)) for k in (-2, -1, 1, 2)]
    difference = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
    assert abs(difference) >= least, "nothing depends on the parameter: nothing is tested"
    for slope in (jax.jit(jax.grad(f)), jax.jit(lambda x: jax.jvp(f, (x,), (1.0,))[1])):
        assert float(slope(at)) == pytest.approx(difference, rel=tol.DIFFERENCE_BEST)


@pytest.mark.slow
def test_one_stage_with_kicks():
    """The scheme of order two whose velocities are tangent, from a spin."""
    example = craft()
    system, start = example.system, nc.assemble(example.system, example.state)
    spin = jnp.array([0.3, -0.2, 0.5])
    rows = start.q.reshape(-1, 4, 3)
    v = jnp.concatenate([jnp.cross(spin, rows[:, :1]), jnp.cross(spin, rows[:, 1:])], axis=1)
    start = nc.State(start.t, start.q, v.reshape(start.v.shape), start.coordinates, start.rates, start.work)
    torque = jnp.full(3, 50.0)
    one = nc.EnergyMomentum(order=2, kick=True)
    wanted = nc.simulate(system, start, dt=0.02, steps=50, inputs=jnp.tile(torque, (50, 1)), scheme=scheme(8))
    errors = []
    for steps in (25, 50):
        found = nc.simulate(
            system, start, dt=1 / steps, steps=steps, inputs=jnp.tile(torque, (steps, 1)), scheme=one
        )
        errors.append(float(jnp.max(jnp.abs(found.v[-1] - wanted.v[-1]))))
        assert float(jnp.max(system.constraint_errors(found).velocity)) <= tol.TANGENT
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=tol.ORDER_TOLERANCE)


@pytest.mark.parametrize("stages", [2, 3, 4, 5])
def test_coefficients_keep_what_they_are_to_keep(stages):
    """Far beyond rounding: an error of one has the same sign in every step."""
    tableau, every = gauss(stages), range(stages)
    exact = collocation(tableau.c)
    x = [[sum(map(Fraction, parts)) for parts in zip(*rows)] for rows in zip(*tableau.a_inverse_parts)]
    beta = [sum(map(Fraction, parts)) for parts in zip(*tableau.beta_parts)]
    for j in every:
        assert abs(sum(exact.b[i] * x[i][j] for i in every) - beta[j]) < 1e-22
        for i in every:
            assert abs(exact.b[i] * x[i][j] + exact.b[j] * x[j][i] - beta[i] * beta[j]) < 1e-22
            b, a = [Fraction(y) for y in tableau.b], tableau.a
            assert abs(b[i] * Fraction(a[i][j]) + b[j] * Fraction(a[j][i]) - b[i] * b[j]) < 1e-18
    np.testing.assert_allclose(tableau.a_inverse, np.linalg.inv(tableau.a), rtol=1e-13)
    np.testing.assert_array_equal(np.asarray(tableau.beta), [float(y) for y in beta])
    rates = jax.random.normal(jax.random.key(0), (stages, 2, 3))
    np.testing.assert_allclose(
        tableau.differentiated(rates), np.einsum("ij,j...->i...", tableau.a_inverse, rates), atol=1e-14
    )
    np.testing.assert_allclose(
        tableau.gained(rates), np.einsum("j,j...->...", tableau.beta, rates), atol=1e-14
    )


@pytest.mark.parametrize("stages", [1, 2, 3, 5])
def test_stage_vectors_solve_their_equations(stages):
    tableau = gauss(stages)
    keys = jax.random.split(jax.random.key(stages))
    turn = jax.random.normal(keys[0], (stages, 4, 1, 3))
    start = jax.random.normal(keys[1], (1, 4, 3, 3))
    found = rotate_stages(turn, start, tableau)
    back = found - jnp.einsum("ij,j...->i...", jnp.asarray(tableau.a), jnp.cross(turn, found))
    np.testing.assert_allclose(back, jnp.broadcast_to(start, back.shape), atol=1e-14)


def test_inputs_of_substeps_lie_on_those_of_the_step():
    """A step that is repeated in parts sees the same torque history: exactly, for a polynomial of it."""
    method = scheme(6)
    plan = Plan(1, 0, 1e-15, None, None, method.tableau)
    history = lambda t: jnp.stack([1 + t - 3 * t**2, 2 * t], axis=-1)  # noqa: E731
    whole = history(jnp.asarray(method.tableau.c))
    for done, fraction in ((0.0, 0.5), (0.5, 0.25), (0.75, 0.25)):
        found = plan.within_step(whole, jnp.asarray(done), jnp.asarray(fraction))
        times = done + fraction * jnp.asarray(method.tableau.c)
        np.testing.assert_allclose(found, history(times), atol=1e-14)
    np.testing.assert_array_equal(plan.within_step(whole, jnp.zeros(()), jnp.ones(())), whole)


@pytest.mark.parametrize("order", [3, 0, 12])
def test_other_orders_are_refused(order):
    with pytest.raises(ValueError, match="even number from 2 to 10"):
        nc.EnergyMomentum(order=order)


@pytest.mark.parametrize("turn", [0.5, 1.0, 2.0])
def test_large_steps_keep_energy(turn):
    """A free body that turns by up to two radians a step."""
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 2.5), angular_velocity=(0.1, 1.0, 0.1), name="body"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=turn, steps=200, scheme=scheme(6), extra_substeps=400)
    found = account(system, trajectory)
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT
