"""Contact as a constraint: impacts of any number of bodies, rest, joints, derivatives, wrong input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.bodies import contact_gaps
from natcoord_jax.maths.impact_law import impact_impulses

FLOOR = nc.Plane(normal=(0, 0, 1))
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg


def dropped(restitution=1.0, solver=None, height=1.0, **given):
    """A ball above a floor."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, height + 0.1), name="ball", **given))
    scene.add(nc.Contact(ball, FLOOR, restitution=restitution, name="bounce"))
    return scene.compile(solver=solver)


def heights(system, trajectory):
    return np.asarray(system.sense(trajectory, "bounce").gap)


@pytest.mark.parametrize("h", [0.05, 0.01, 0.002])
@pytest.mark.parametrize("restitution", [1.0, 0.5, 0.0])
def test_bouncing_ball(h, restitution):
    """Rebounds as high as asked for, wherever in a step the impact falls; what is lost is booked."""
    system, state = dropped(restitution)
    trajectory = nc.simulate(system, state, dt=h, steps=round(3.0 / h))
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    z, t = heights(system, trajectory), np.asarray(trajectory.t)
    assert z.min() >= -1e-14
    second = z[(t > 0.46) & (t < 1.3)].max()
    # The top falls between two states, and what the weight does in the step of an impact is not the impact's.
    assert abs(second - restitution**2) <= 1.2 * h**2 * 9.81 / 8 + 0.02 * h
    lost = float(system.work(trajectory)["bounce"][-1])
    assert lost <= tol.ENERGY_OF_A_SMALL_SCENE
    if restitution == 1.0:
        assert lost >= -tol.ENERGY_OF_A_SMALL_SCENE * 100
    else:
        # At rest in the end, with the whole of the energy lost.
        assert np.abs(np.asarray(trajectory.v)[-1]).max() <= 1e-9
        assert lost == pytest.approx(-9.81, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_all_forms_agree(restitution):
    found = []
    for solver in ("reduced", "full", "recursive", "sparse"):
        system, state = dropped(restitution, solver, angular_velocity=(0.3, 2.0, 0.1), velocity=(1.0, 0, 0))
        found.append(np.asarray(nc.simulate(system, state, dt=0.01, steps=150).q))
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-11)


def test_resting_ball_is_untouched():
    """At gap zero, at rest, for a thousand steps; whatever falls beside it."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    still = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.1), name="still"))
    falling = scene.add(nc.RigidBody(**BALL, position=(1, 0, 0.5)))
    scene.add(nc.Contact(still, FLOOR, restitution=0.7))
    scene.add(nc.Contact(falling, FLOOR, restitution=0.7))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=1000)
    assert np.abs(np.asarray(system.sense(trajectory, still).velocity)).max() <= 1e-15
    assert np.abs(np.asarray(system.sense(trajectory, still).position) - (0, 0, 0.1)).max() <= 1e-15


def test_a_point_comes_to_rest_at_the_origin():
    """Where it has neither a speed nor a place that rounding could be compared with."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    stone = scene.add(nc.PointMass(mass=0.1, position=(0, 0, 0.2)))
    scene.add(nc.Contact(stone, FLOOR, restitution=0.0))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=1000)
    assert np.abs(np.asarray(trajectory.q)[30:, 0]).max() <= 1e-15
    assert int(trajectory.steps_rejected) <= 4


@pytest.mark.parametrize("restitution", [1.0, 0.6])
def test_box_falls_on_four_corners(restitution):
    """Redundant contacts that close at once: no corner is first, and the box does not begin to turn."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(nc.RigidBody(shape=nc.Box((0.4, 0.6, 0.2)), density=100.0, position=(0, 0, 0.5)))
    scene.add(nc.Contact(box, FLOOR, restitution=restitution))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=4e-3, steps=300)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    # A tilt of rounding grows with every bounce, by the time of flight over the step.
    spin = np.abs(np.asarray(system.sense(trajectory, box).angular_velocity)).max(axis=1)
    assert spin[:150].max() <= 1e-12 and spin[:250].max() <= 1e-6
    z = np.asarray(system.sense(trajectory, box).position)[:, 2]
    # Of several contacts each gives way by a part in 10^9 of the way of a step.
    assert z.min() >= 0.1 - 1e-9 * 4.5 * 4e-3
    top = z[80:200].max() - 0.1
    assert top == pytest.approx(0.4 * restitution**2, abs=2e-3)


def test_tumbling_box_keeps_its_energy():
    """Corners that meet the floor one by one and two by two, at 20 rad/s; no energy is made in any step."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = scene.add(
        nc.RigidBody(
            shape=nc.Box((0.4, 0.6, 0.2)),
            density=100.0,
            position=(0, 0, 0.6),
            velocity=(1.0, 0.2, -1.0),
            angular_velocity=(3.0, -2.0, 1.0),
        )
    )
    scene.add(nc.Contact(box, FLOOR))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=1000)
    energy = np.asarray(system.energy(trajectory).total)
    assert np.abs(energy - energy[0]).max() <= tol.ENERGY_OF_A_SMALL_SCENE * energy[0] * 10
    momentum = np.asarray(system.momentum(trajectory))[:, :2]
    assert np.abs(momentum - momentum[0]).max() <= 1e-12 * np.abs(momentum).max()


def test_cradle_with_gaps():
    """The sequence of impacts through four gaps that steps resolve: the last ball has all of the speed."""
    scene = nc.Scene()
    balls = [
        scene.add(nc.RigidBody(**BALL, position=(x, 0, 0), velocity=(speed, 0, 0)))
        for x, speed in ((-0.01, 1.0), (0.201, 0.0), (0.402, 0.0), (0.603, 0.0), (0.804, 0.0))
    ]
    for one, other in zip(balls, balls[1:]):
        scene.add(nc.Contact(one, other))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-4, steps=60)
    final = [float(system.sense(trajectory, ball).velocity[-1, 0]) for ball in balls]
    np.testing.assert_allclose(final, [0, 0, 0, 0, 1], atol=1e-12)
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE


def test_oblique_impact_keeps_momenta():
    """Two capsules in space, each of which turns: energy, momentum and angular momentum through an impact."""
    scene = nc.Scene()
    given = {"shape": nc.Capsule(radius=0.1, length=0.6), "density": 200.0}
    one = scene.add(
        nc.RigidBody(**given, position=(-0.5, 0.1, 0), velocity=(1.0, 0, 0), angular_velocity=(2, 1, 0))
    )
    other = scene.add(
        nc.RigidBody(**given, position=(0.5, 0, 0.2), velocity=(-1.0, 0, 0.1), angular_velocity=(0, -3, 1))
    )
    scene.add(nc.Contact(one, other, name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=200)
    gap = np.asarray(system.sense(trajectory, "impact").gap)
    assert gap.min() <= 1e-12 and gap[-1] > 0.1
    found = nc.balance(system, trajectory)
    for drift in (found.energy, found.momentum, found.angular_momentum):
        assert drift.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_pendulum_hits_a_wall(restitution):
    """A body on a joint: it is the inertia about the joint that an impact meets."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(1.0, 0, 0), name="bob"))
    hinge = scene.add(nc.Revolute(nc.ground, ball, axis=(0, 0, 1), point=(0, 0, 0)))
    wall = nc.Plane(normal=(0, -1, 0), point=(0, 0.6, 0))
    scene.add(nc.Contact(ball, wall, restitution=restitution))
    system, state = scene.compile()
    state = system.with_coordinate(state, hinge, 0.0, rate=2.0)
    trajectory = nc.simulate(system, state, dt=7e-3, steps=100, scheme=nc.EnergyMomentum(kick=True))
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    rate = np.asarray(system.sense(trajectory, hinge).rates)[:, 0]
    assert rate[-1] == pytest.approx(-2.0 * restitution, rel=1e-12)


def sliding(h, friction, speed, *, seconds, tilt=0.0, shape=None, solver=None):
    """A point mass or a body on a plane; times, places and speeds along it."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(-9.81 * np.sin(tilt), 0, -9.81 * np.cos(tilt))))
    if shape is None:
        body = scene.add(nc.PointMass(mass=1.0, velocity=(speed, 0, 0)))
    else:
        body = scene.add(
            nc.RigidBody(shape=shape, density=300.0, position=(0, 0, 0.1), velocity=(speed, 0, 0))
        )
    scene.add(nc.Contact(body, FLOOR, restitution=0.0, friction=friction, name="rubs"))
    system, state = scene.compile(solver=solver)
    trajectory = nc.simulate(system, state, dt=h, steps=round(seconds / h))
    assert int(trajectory.steps_rejected) == 0
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-13 * energy[0]
    at = system.sense(trajectory, body)
    return np.asarray(trajectory.t), np.asarray(at.position)[:, 0], np.asarray(at.velocity)[:, 0]


@pytest.mark.parametrize(("h", "place"), [(0.05, 7e-4), (0.01, 1e-6)])
def test_friction_stops_what_slides(h, place):
    """After v / (mu g), within a step, at v^2 / (2 mu g); then it rests, exactly."""
    t, x, v = sliding(h, 0.3, 2.0, seconds=1.0)
    assert abs(x[-1] - 4 / (2 * 0.3 * 9.81)) <= place
    stopped = t[np.abs(v) <= 1e-15][0]
    assert 0.679579 <= stopped <= 0.679579 + h
    assert np.abs(v[t >= stopped]).max() <= 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["full", "recursive", "sparse"])
def test_friction_on_a_slope(solver):
    """Thrown up a slope of tangent 0.7: a coefficient of 0.8 holds it, with 0.5 it slides back."""
    tilt = np.arctan(0.7)
    _, x, _ = sliding(0.01, 0.8, 3.0, seconds=1.2, tilt=tilt, solver=solver)
    assert x[-1] == pytest.approx(0.373289, abs=3e-5)
    _, x, _ = sliding(0.002, 0.5, 3.0, seconds=1.2, tilt=tilt, solver=solver)
    assert x[-1] == pytest.approx(-0.1684, abs=1.5e-3)


def test_sliding_turns_around_at_long_steps():
    """Newton's iteration finds the step in which slip changes its sign."""
    _, x, _ = sliding(0.05, 0.5, 3.0, seconds=1.2, tilt=np.arctan(0.7))
    assert x[-1] == pytest.approx(-0.1146, abs=1e-3)


def test_sphere_begins_to_roll():
    """With five sevenths of its speed, whatever the coefficient."""
    t, _, v = sliding(0.01, 0.3, 2.0, seconds=0.6, shape=nc.Sphere(0.1))
    assert v[-1] == pytest.approx(2.0 * 5 / 7, rel=1e-12)
    rolls = t[np.abs(v - 2.0 * 5 / 7) <= 1e-9][0]
    assert 2 * 2.0 / (7 * 0.3 * 9.81) <= rolls <= 2 * 2.0 / (7 * 0.3 * 9.81) + 0.011


@pytest.mark.slow
def test_cylinder_begins_to_roll():
    """With two thirds of its speed: it lies on the lowest points of both rims."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    roll = nc.RigidBody(
        shape=nc.Cylinder(0.1, 0.3),
        density=300.0,
        position=(0, 0, 0.1),
        orientation=((1, 0, 0), np.pi / 2),
        velocity=(2.0, 0, 0),
        name="roll",
    )
    roll = scene.add(roll)
    scene.add(nc.Contact(roll, FLOOR, restitution=0.0, friction=0.3))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=80)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.sense(trajectory, roll).velocity[-1, 0]) == pytest.approx(2.0 * 2 / 3, rel=1e-9)
    # Let fall on its end, the same one stands.
    rows = jnp.concatenate([jnp.array([[0.0, 0.0, 0.2]]), jnp.eye(3)])
    still = eqx.tree_at(lambda s: (s.q, s.v), state, (rows, jnp.zeros_like(rows)))
    trajectory = nc.simulate(system, still, dt=0.01, steps=80)
    assert np.abs(np.asarray(trajectory.v)[-1]).max() <= 1e-9
    assert float(system.sense(trajectory, roll).position[-1, 2]) == pytest.approx(0.15, abs=1e-9)


def test_box_slides_on_four_corners():
    """Dependent contacts share load and friction evenly: it does not turn, and stops where a point does."""
    _, x, v = sliding(0.01, 0.9, 3.0, seconds=0.6, shape=nc.Box((0.3, 0.3, 0.2)))
    assert x[-1] == pytest.approx(9 / (2 * 0.9 * 9.81), abs=1e-4)
    assert abs(v[-1]) <= 1e-10


def test_friction_between_bodies_keeps_momenta():
    """Two balls in space that meet off their centres, with spin: what rubs turns one as much as the other."""
    scene = nc.Scene()
    one = scene.add(
        nc.RigidBody(**BALL, position=(-0.3, 0.05, 0), velocity=(1.0, 0, 0), angular_velocity=(0, 3, 20))
    )
    other = scene.add(
        nc.RigidBody(**BALL, position=(0.3, 0, 0), velocity=(-1.0, 0, 0), angular_velocity=(5, 0, 1))
    )
    scene.add(nc.Contact(one, other, restitution=0.8, friction=0.4, name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=150)
    found = nc.balance(system, trajectory)
    for drift in (found.energy, found.momentum, found.angular_momentum):
        assert drift.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.work(trajectory)["impact"][-1]) < -0.1
    assert abs(np.asarray(system.sense(trajectory, other).angular_velocity)[-1, 2] - 1.0) > 1.0


@pytest.mark.parametrize("count", [3, pytest.param(10, marks=pytest.mark.exhaustive)])
def test_stack_of_boxes_stands(count):
    """Ten seconds, dependent contacts one upon the other: nothing moves by more than rounding."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    below, given = nc.ground, {"restitution": 0.0, "friction": 0.5}
    for k in range(count):
        box = scene.add(nc.RigidBody(shape=nc.Box((0.2,) * 3), density=500.0, position=(0, 0, 0.1 + 0.2 * k)))
        scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), point=(0, 0, 0.2 * k), body=below), **given))
        below = box
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=2000)
    assert np.abs(np.asarray(trajectory.q) - np.asarray(state.q)).max() <= 1e-9
    assert int(trajectory.steps_rejected) == 0


@pytest.mark.slow
def test_derivatives_of_the_program():
    """In every mode, where no difference crosses a change of contacts; in a batch of other contacts, too."""
    system, state = dropped(0.8)

    def end(x):
        moved = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 2].add(x))
        return nc.simulate(system, moved, dt=0.01, steps=90, throw=False).q[-1, 0, 2]

    assert_v_shaped(end, 0.013, 1.0, jax.grad(end)(0.013))
    slope = jax.grad(end)
    assert_v_shaped(slope, 0.013, 1.0, jax.jvp(slope, (0.013,), (1.0,))[1])
    starts = jnp.linspace(-0.3, 0.4, 5)
    together = jax.vmap(jax.value_and_grad(end))(starts)
    apart = [jax.value_and_grad(end)(x) for x in starts]
    np.testing.assert_allclose(np.stack(together), np.array(apart).T, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_derivatives_through_friction():
    """By the speed at the start and by the coefficient, through impact, slip and rest."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.15), velocity=(1.0, 0.2, 0), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, restitution=0.5, friction=0.2, name="rubs"))
    system, state = scene.compile()

    def end(x):
        moved = eqx.tree_at(lambda s: s.v, state, state.v.at[0].add(x[0] * jnp.array([1.0, -0.3, 0.2])))
        rough = system.set("rubs", friction=0.2 + x[1])
        return nc.simulate(rough, moved, dt=0.01, steps=30, throw=False).q[-1, 0]

    x, along = jnp.array([0.02, 0.01]), jnp.array([0.6, 0.3])
    assert_v_shaped(end, x, along, jax.jvp(end, (x,), (along,))[1])
    total = lambda x: jnp.sum(end(x))  # noqa: E731
    assert_v_shaped(total, x, along, jax.grad(total)(x) @ along)


def random_impacts(random, contacts=4):
    """Contacts of one body in a plane, that all push to one side and depend on each other."""
    levers = np.column_stack([np.ones(contacts), random.normal(size=(contacts, 2))])
    return levers @ levers.T, levers @ random.normal(size=3), 0.2 * random.random(contacts)


def energy_of(impulses, matrix, rates):
    return impulses @ rates + 0.5 * impulses @ matrix @ impulses


def test_impact_law():
    """Elastic impacts give back what was taken, contact by contact; others lose 1 - e^2 of the difference."""
    random = np.random.default_rng(0)
    for _ in range(50):
        matrix, rates, work = random_impacts(random)
        active = jnp.asarray(random.random(4) < 0.8)
        given = [jnp.asarray(x) for x in (matrix, rates, jnp.where(active, work, 0.0))]

        def law(e, given=given, active=active):
            return np.asarray(impact_impulses(*given, jnp.full(4, e), active, active)[1])

        elastic, half, plastic = law(1.0), law(0.5), law(0.0)
        assert (elastic[np.asarray(active)] > 0).all() and not elastic[~np.asarray(active)].any()
        done = elastic * (rates + 0.5 * matrix @ elastic)
        np.testing.assert_allclose(done, given[2], atol=1e-10)
        energies = [energy_of(x, matrix, rates) for x in (elastic, half, plastic)]
        assert energies[0] - energies[1] == pytest.approx(0.75 * (energies[0] - energies[2]), rel=1e-9)


def test_restitutions_that_differ_make_no_energy():
    """What each contact would do alone may give energy together: then less of it is given back."""
    random, limited = np.random.default_rng(1), 0
    for _ in range(100):
        matrix, rates, work = random_impacts(random, 3)
        active, e = jnp.ones(3, bool), jnp.asarray(random.integers(0, 2, 3).astype(float))
        found = np.asarray(impact_impulses(*map(jnp.asarray, (matrix, rates, work)), e, active, active)[1])
        gained = energy_of(found, matrix, rates) - work.sum()
        assert gained <= 1e-10
        limited += gained > -1e-9 and 0 < e.sum() < 3
    assert limited > 0


@pytest.mark.slow
def test_impact_law_is_differentiable():
    random = np.random.default_rng(2)
    matrix, rates, work = (jnp.asarray(x) for x in random_impacts(random))
    on, e = jnp.array([True, True, False, True]), jnp.array([0.9, 0.5, 0.3, 0.0])

    def velocity(x):
        shifted = matrix * (1 + x[0]), rates + x[1], work * (1 + x[2])
        return matrix @ impact_impulses(*shifted, e, on, on)[1]

    x, along = jnp.array([0.1, -0.2, 0.3]), jnp.array([0.5, 0.2, -0.3])
    assert_v_shaped(velocity, x, along, jax.jvp(velocity, (x,), (along,))[1])
    slope = jax.grad(lambda x: jnp.sum(velocity(x) ** 2))
    assert_v_shaped(slope, x, along, jax.jvp(slope, (x,), (along,))[1])


@pytest.mark.parametrize(
    "scheme", [nc.EnergyMomentum(order=4), nc.VariationalMidpoint(), nc.Dissipative()], ids=str
)
def test_schemes_without_impacts_are_refused(scheme):
    system, state = dropped()
    with pytest.raises(ValueError, match="hard contact 'bounce'.*EnergyMomentum"):
        nc.simulate(system, state, dt=0.01, steps=5, scheme=scheme)


def test_overlap_at_the_start_is_refused():
    with pytest.raises(ValueError, match="hard contact 'bounce' overlap by 0.05 m"):
        dropped(height=-0.05)


def test_what_closed_contacts_do_not_say_is_refused():
    """Equilibria, vibrations, and accelerations while a contact is closed; above the floor a ball falls."""
    system, state = dropped(height=0.0)
    for ask, given in ((nc.equilibrium, {}), (nc.modes, {}), (nc.load_path, {"arc": 0.1, "steps": 3})):
        with pytest.raises(ValueError, match="hard contact 'bounce'.*stiffness"):
            ask(system, state, **given)
    with pytest.raises(ValueError, match="closed contacts of a system with hard contact 'bounce'"):
        system.instant(state)
    system, state = dropped(height=0.1)
    assert float(system.instant(state).accelerations[0, 2]) == -9.81


def test_friction_needs_a_point_of_contact():
    class PointAboveGround(nc.Gap):
        def invariants(self, x):
            return (x[1] @ (x[2] - x[0]))[None]

        def distance(self, invariants):
            return invariants[0]

    above = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1)), nc.Point(nc.ground, (0, 0, 1))
    with pytest.raises(ValueError, match="PointAboveGround does not say.*contact"):
        nc.GapConstraint(above, PointAboveGround(), friction=0.3)
    assert nc.GapConstraint(above, PointAboveGround()).multipliers == 1


def test_a_thrown_box_comes_to_rest():
    """Long flights, in which the impulses of friction decay beyond the smallest numbers, and then impacts."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    die = nc.RigidBody(
        shape=nc.Box((0.1,) * 3),
        density=600.0,
        position=(0, 0, 0.3),
        velocity=(1.0, -0.3, 0.5),
        angular_velocity=(2.0, -1.0, 6.0),
    )
    die = scene.add(die)
    scene.add(nc.Contact(die, FLOOR, restitution=0.4, friction=0.4))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=2500)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    at_end = system.sense(trajectory[-1], die)
    assert np.abs(np.asarray(at_end.velocity)).max() <= 1e-9
    assert np.abs(np.asarray(at_end.angular_velocity)).max() <= 1e-8
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-13 * energy[0]


@pytest.mark.slow
def test_rattleback_turns_back():
    """One way it spins on; the other way it begins to rattle and turns back, having lost little."""
    reversed_, onward = (gallery.load("rattleback", spin=spin) for spin in (-5.0, 5.0))
    spins = []
    for example in (reversed_, onward):
        trajectory = nc.simulate(example.system, example.state, dt=example.dt, steps=example.steps)
        spins.append(np.asarray(example.system.sense(trajectory, "stone").angular_velocity)[:, 2])
        energy = np.asarray(example.system.energy(trajectory).total)
        assert 0.95 * energy[0] <= energy[-1] <= energy[0]
        assert np.diff(energy).max() <= 1e-13 * energy[0]
    assert spins[0][-1] > 4.0
    assert spins[1].min() > 4.5


def test_restitution_that_gives_energy_is_refused():
    """Where a contact is made, and where its numbers are set."""
    with pytest.raises(ValueError, match="restitution .* 1.5; pass a number from 0 to 1"):
        dropped(1.5)
    with pytest.raises(ValueError, match="'bounce' has a restitution .* above 1"):
        dropped(0.5)[0].set("bounce", restitution=1.5)


def boxes_on_the_floor(numbers):
    """Of different masses and speeds, far apart, that land on edges, and slide."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    boxes = []
    for k in numbers:
        size, turn = (0.3, 0.2, 0.1 + 0.05 * k), ((1, 0, 0), 0.1 * k)
        box = nc.RigidBody(
            shape=nc.Box(size),
            density=300.0 * (1 + 3 * k),
            position=(0, k, 0.06 + 0.045 * k),
            orientation=turn,
            velocity=(1.0 + k, 0.2, -0.5 * k),
            angular_velocity=(0.3 * k, 0, 2.0),
        )
        boxes.append(scene.add(box))
        scene.add(nc.Contact(boxes[-1], FLOOR, restitution=0.2 + 0.3 * k, friction=0.3))
    return *scene.compile(), boxes


@pytest.mark.slow
def test_boxes_that_never_meet_do_not_move_each_other():
    """Impacts and friction of one are its own affair; when all shared one problem it was off by 24 mm."""
    places = []
    for numbers in ((0,), (0, 1, 2)):
        system, state, boxes = boxes_on_the_floor(numbers)
        trajectory = nc.simulate(system, state, dt=5e-3, steps=60)
        places.append(np.asarray(system.sense(trajectory, boxes[0]).position))
    assert np.abs(places[1] - places[0]).max() <= 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("compliance", [2e-9, 1e-7])
def test_pivots_are_good_with_contacts_open_and_closed(compliance, monkeypatch):
    """An order that was found with all closed alone had a pivot of zero where some were open."""
    monkeypatch.setattr(contact_gaps._sharing, "__defaults__", (compliance,))
    system, state, _ = boxes_on_the_floor((0, 1, 2))
    nc.simulate(system, state, dt=5e-3, steps=20)


def test_islands():
    """Contacts of bodies that touch or are joined belong together, the ground joins nothing."""
    scene = nc.Scene()
    balls = [scene.add(nc.RigidBody(**BALL, position=(k, 0, 0.5))) for k in range(6)]
    scene.add(nc.Revolute(balls[0], balls[1], point=(0.5, 0, 0.5), axis=(0, 1, 0)))
    scene.add(nc.Contact(balls[2], balls[3], restitution=1.0))
    for ball in balls[:5]:
        scene.add(nc.Contact(ball, FLOOR, restitution=1.0))
    system, _ = scene.compile()
    contacts = [g for g in system.effects if g.effect.unilateral]
    names = [name for group in contacts for name in group.names]
    found = {frozenset(names[k] for k in island) for island in system.structure.islands}
    assert sorted(map(len, found)) == [1, 2, 3]
    assert sum(map(len, found)) == 6
