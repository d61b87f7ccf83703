"""Derivatives where a system changes suddenly from one step to the next.

What could go wrong: factors, guesses and what corrections have left are carried from step to step, and a
linear system is taken for solved that is not. Exact values are those of the motion between the changes; where
there are none, all Jacobians formed (`jax.jacfwd`) stand against both sweeps. Beside a plain reference, of
random scenes: `test_hunt`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import EXACT_GRADIENT, SAME_GRADIENT

import natcoord_jax as nc


class Brake(nc.JointDamper):
    """Is put on after 0.1 s."""

    def force(self, rate, inputs, t):
        return -self.damping * jnp.where(t > 0.1, 1.0, 0.0) * rate


class Dry(nc.JointDamper):
    """Dry friction, smooth below a rate of 1 mrad/s."""

    def force(self, rate, inputs, t):
        return -self.damping * jnp.tanh(rate / 1e-3)


def number_of(system, kind):
    """A function that gives the system another number of the effect of this kind."""
    place = next(i for i, group in enumerate(system.effects) if group.effect.kind == kind)
    field = {"joint stops": "stiffness", "joint damper": "damping"}[kind]

    def changed(value):
        where = lambda s: getattr(s.effects[place].effect, field)  # noqa: E731
        return eqx.tree_at(where, system, jnp.full_like(where(system), value))

    return changed


def wall():
    scene = nc.Scene()
    mass = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="mass"))
    slide = scene.add(nc.Prismatic(nc.ground, mass, axis=(1, 0, 0), name="slide"))
    scene.add(nc.JointStops(slide, upper=0.0, stiffness=1e4))
    return *scene.compile(), slide


@pytest.fixture(scope="module")
def bounce():
    """Rate after a bounce off a stop, as a function of the rate before and the stiffness."""
    system, state, slide = wall()
    changed = number_of(system, "joint stops")

    def end(rate, stiffness, **options):
        start = system.with_coordinate(state, slide, -0.1, rate=rate)
        return system.rate(nc.simulate(changed(stiffness), start, dt=0.01, steps=60, **options), slide)[-1]

    return end


@pytest.mark.exhaustive
@pytest.mark.parametrize("checkpoint", [False, True])
def test_a_mass_bounces_off_a_stop(bounce, checkpoint):
    """It comes back with the rate it had, whatever the stop is: the derivative is -1 by it, 0 by the stop."""

    def end(rate, stiffness):
        return bounce(rate, stiffness, checkpoint=checkpoint)

    reverse = jax.jit(jax.grad(end, (0, 1)))
    forward = jax.jit(lambda v, k: jax.jvp(end, (v, k), (1.0, 0.1 * k))[1])
    for rate in (1.0, 1.23, 1.7):
        for stiffness in (1e3, 1e4, 1e6, 1e8):
            by_rate, by_stiffness = reverse(rate, stiffness)
            np.testing.assert_allclose(by_rate, -1.0, atol=EXACT_GRADIENT)
            np.testing.assert_allclose(by_stiffness * stiffness, 0.0, atol=EXACT_GRADIENT)
            np.testing.assert_allclose(forward(rate, stiffness), -1.0, atol=EXACT_GRADIENT)


def braked(kind):
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.2), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(kind(hinge, damping=1.0))
    return *scene.compile(), hinge


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4])
def test_a_brake_is_put_on(order):
    """The motion is linear in the rate at the start: its angle is its own derivative by it."""
    system, state, hinge = braked(Brake)
    changed, scheme = number_of(system, "joint damper"), nc.EnergyMomentum(order=order)

    @jax.jit
    def angle(rate, damping):
        start = system.with_coordinate(state, hinge, 0.0, rate=rate)
        run = nc.simulate(changed(damping), start, dt=0.01, steps=40, scheme=scheme)
        return system.coordinate(run, hinge)[-1]

    for damping in (1.0, 10.0, 50.0, 1000.0, 1e6):
        # Of a small rate, so that the angle of a step is that of Cayley's rotation to round-off.
        exact = angle(1e-4, damping) / 1e-4
        np.testing.assert_allclose(jax.grad(angle)(1e-4, damping), exact, rtol=SAME_GRADIENT)
        forward = jax.jvp(angle, (1e-4, damping), (1.0, 0.0))[1]
        np.testing.assert_allclose(forward, exact, rtol=SAME_GRADIENT)


@pytest.mark.exhaustive
def test_dry_friction_stops_a_disc():
    """Angle I w^2/(2 f) of a disc that friction f stops; its derivative by f to the width of the law."""
    system, state, hinge = braked(Dry)
    changed = number_of(system, "joint damper")
    start = system.with_coordinate(state, hinge, 0.0, rate=2.0)

    def angle(friction):
        return system.coordinate(nc.simulate(changed(friction), start, dt=0.01, steps=200), hinge)[-1]

    exact = -0.2 * 2.0**2 / (2 * 0.3**2)
    reverse, forward = jax.grad(angle)(0.3), jax.jvp(angle, (0.3,), (1.0,))[1]
    np.testing.assert_allclose(reverse, exact, rtol=1e-3)
    np.testing.assert_allclose(forward, reverse, rtol=SAME_GRADIENT)


def chain(links, solver):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    parent, hinges = nc.ground, []
    for k in range(links):
        place = (0.5 * k, 0, 0)
        link = scene.add(
            nc.RigidBody(
                mass=1.0, inertia=(0.1, 0.1, 0.1), position=place, com=(0.25, 0, 0), name=f"link {k}"
            )
        )
        hinges.append(scene.add(nc.Revolute(parent, link, point=place, axis=(0, 1, 0), name=f"hinge {k}")))
        scene.add(nc.JointStops(hinges[-1], lower=-0.3, upper=0.3, stiffness=1e4, name=f"stop {k}"))
        parent = link
    return *scene.compile(solver=solver), hinges


@pytest.mark.exhaustive
@pytest.mark.parametrize("links, solver", [(3, "reduced"), (4, "recursive"), (3, "full"), (3, "sparse")])
def test_links_hit_their_stops_in_every_form(links, solver):
    """Both sweeps against Jacobians of all steps: dense factors, blocks of a tree, fronts."""
    system, state, hinges = chain(links, solver)
    changed = number_of(system, "joint stops")

    def loss(rates, stiffness):
        other = changed(stiffness)
        start = state
        for k, hinge in enumerate(hinges):
            start = other.with_coordinate(start, hinge, 0.0, rate=rates[k])
        run = nc.simulate(other, start, dt=0.01, steps=40, throw=False)
        return jnp.sum(jnp.sin(run.q[-1])) + jnp.sum(run.q[20] ** 2)

    reverse, shared = jax.jit(jax.grad(loss, (0, 1))), jax.jit(jax.jacfwd(loss, (0, 1)))
    forward = jax.jit(lambda v, k, dv, dk: jax.jvp(loss, (v, k), (dv, dk))[1])
    rng = np.random.default_rng(0)
    for _ in range(12):
        rates, along = jnp.asarray(3.0 * rng.normal(size=(2, links)))
        stiffness = 10.0 ** rng.uniform(2, 7)
        terms = [
            jnp.append(a * along, b * stiffness)
            for a, b in (reverse(rates, stiffness), shared(rates, stiffness))
        ]
        scale = jnp.max(jnp.abs(terms[1]))
        np.testing.assert_allclose(terms[0] / scale, terms[1] / scale, atol=SAME_GRADIENT)
        ahead = forward(rates, stiffness, along, stiffness)
        np.testing.assert_allclose(ahead / scale, jnp.sum(terms[1]) / scale, atol=SAME_GRADIENT)


@pytest.mark.exhaustive
def test_a_step_repeated_at_the_end_of_a_round():
    """Sweeps see 32 slots at once: a rejected one may be the first or the last of them."""
    system, state, slide = wall()
    changed = number_of(system, "joint stops")

    def end(rate, stiffness, place):
        start = system.with_coordinate(state, slide, -place, rate=rate)
        run = nc.simulate(changed(stiffness), start, dt=0.01, steps=60, rtol=1e-4)
        return system.rate(run, slide)[-1]

    reverse = jax.jit(jax.value_and_grad(end))
    forward = jax.jit(lambda v, k, x: jax.jvp(lambda v: end(v, k, x), (v,), (1.0,))[1])
    for place in np.linspace(0.05, 0.35, 9):
        value, slope = reverse(1.0, 1e5, place)
        np.testing.assert_allclose((value, slope), -1.0, atol=EXACT_GRADIENT)
        np.testing.assert_allclose(forward(1.0, 1e5, place), -1.0, atol=EXACT_GRADIENT)


@pytest.mark.exhaustive
def test_jacobians_serve_where_a_motion_dies_away():
    """What is known of a slot is then a difference of what stays: a millionth of it is no measure."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.2)))
    hinge = scene.add(nc.Revolute(nc.ground, disc))
    scene.add(Brake(hinge, damping=50.0))
    system, state = scene.compile()

    def angle(w):
        start = system.with_coordinate(state, hinge, 0.0, rate=w)
        return system.coordinate(nc.simulate(system, start, dt=0.01, steps=100), hinge)[-1]

    slope = nc.jit(jax.jacfwd(angle), effort="quick")(1.0)
    np.testing.assert_allclose(slope, nc.jit(jax.grad(angle), effort="quick")(1.0), rtol=1e-9)
