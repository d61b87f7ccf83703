"""What is left of an impact: restitution by law, step, joint, shape and scheme; nothing gains energy."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from contact_scenes import BALL, FLOOR, assert_never_gains, lost

import natcoord_jax as nc
from natcoord_jax.maths.impact_law import collision_impulses

G = 9.81
LOCATED = nc.EnergyMomentum(max_events=4)


def dropped(**contact):
    """A ball of 1 kg, 1 m above a floor."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 1.1), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, name="bounce", **contact))
    return scene.compile()


@pytest.mark.users
def test_a_hard_ball_rebounds_as_high_as_it_should():
    """Wherever in a step the impact falls; what is lost is booked, and in the end it rests."""
    system, state = dropped(restitution=1.0)
    for h in (0.05, 0.0125):
        for restitution in (1.0, 0.5, 0.0):
            lossy = system.set("bounce", restitution=restitution)
            trajectory = nc.simulate(lossy, state, dt=h, steps=240)
            assert nc.balance(lossy, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
            z, t = np.asarray(lossy.sense(trajectory, "bounce").gap), np.asarray(trajectory.t)
            assert z.min() >= -1e-14
            second = z[(t > 0.46) & (t < 1.3)].max()
            # The top falls between two states, and what the weight does in the step of an impact is not
            # the impact's.
            assert abs(second - restitution**2) <= 1.2 * h**2 * G / 8 + 0.02 * h
            booked = float(lost(lossy, trajectory, "bounce")[-1])
            if restitution == 1.0:
                assert abs(booked) <= 100 * tol.ENERGY_OF_A_SMALL_SCENE
            else:
                assert np.abs(np.asarray(trajectory.v)[-1]).max() <= 1e-9
                assert booked == pytest.approx(-G, rel=1e-12)


@pytest.mark.slow
def test_a_soft_ball_rebounds_as_high_and_is_no_deeper_than_it_should():
    """Energy to rounding whatever the step, and no deeper than v sqrt(m / k)."""
    system, state = dropped(stiffness=1e4)
    for stiffness, h, apex in ((1e4, 1e-2, 2e-2), (1e4, 2e-3, 1e-3), (1e8, 1e-2, 2e-3)):
        made = system.set("bounce", stiffness=stiffness)
        trajectory = nc.simulate(made, state, dt=h, steps=700)
        assert nc.balance(made, trajectory).energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
        gap, t = np.asarray(made.sense(trajectory, "bounce").gap), np.asarray(trajectory.t)
        np.testing.assert_allclose(gap, np.asarray(trajectory.q)[:, 0, 2] - 0.1, atol=1e-14)
        assert gap.min() >= -1.02 * np.sqrt(2 * G / stiffness) - G / stiffness
        # Falls of 1 m last 0.4515 s; the contact half a period more.
        assert abs(gap[(t > 0.6) & (t < 1.3)].max() - 1.0) <= apex


@cache
def collision(law):
    """Two equal spheres in space, of 1.6 kg, that meet at 10 m/s."""
    scene = nc.Scene()
    ball = {"shape": nc.Sphere(0.1), "density": 1.6 / (4 / 3 * np.pi * 1e-3)}
    one = scene.add(nc.RigidBody(**ball, position=(-0.10001, 0, 0), velocity=(5.0, 0, 0)))
    two = scene.add(nc.RigidBody(**ball, position=(0.10001, 0, 0), velocity=(-5.0, 0, 0)))
    stiffness = {"linear": 1e6, "hertz": 1e8}[law]
    lossy = {"restitution": 0.5, "speed": 10.0}
    scene.add(nc.Contact(one, two, stiffness=stiffness, law=law, name="impact", **lossy))
    return scene.compile()


def parting(system, state, *, h=1e-5):
    """The speed at which they part, by that at which they meet."""
    trajectory = nc.simulate(system, state, dt=h, steps=800)
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert np.diff(lost(system, trajectory)).max() <= 1e-13
    ends = np.asarray(trajectory.v)[[0, -1]]
    return (ends[1, 4, 0] - ends[1, 0, 0]) / (ends[0, 0, 0] - ends[0, 4, 0])


@pytest.mark.parametrize(
    "law",
    [pytest.param("linear", marks=pytest.mark.slow), pytest.param("hertz", marks=pytest.mark.exhaustive)],
)
def test_restitution_of_soft_contacts(law):
    """As asked for at the speed that it is of, whatever the law and its numbers; slower impacts keep more."""
    system, state = collision(law)
    for restitution in (0.9, 0.5, 0.1):
        lossy = system.set("impact", restitution=restitution)
        assert parting(lossy, state) == pytest.approx(restitution, rel=2e-4)
    stiff = float(np.ravel(system.get("impact", "stiffness"))[0])
    for changed in ({"stiffness": 3 * stiff}, {"radii": (0.1, 0.09)}):
        assert parting(system.set("impact", **changed), state) == pytest.approx(0.5, rel=2e-3)
    slow = nc.State(**{**vars(state), "v": 0.5 * state.v})
    assert parting(system, slow) == pytest.approx(0.673, abs=2e-3)
    # Not resolved at all, and still nothing is lost.
    assert parting(system.set("impact", restitution=1.0), state, h=1e-3) == pytest.approx(1.0, rel=1e-9)


def test_damping_at_the_ends_of_restitution():
    """Of each e from 1e-12 to one rounding below 1: 3 (1 - e) / 2 towards 1, and 1 / e towards zero.

    One that is infinite or negative lets a ball through the floor, or throws it up.
    """
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=100.0, position=(0, 0, 0.2)))
    floor = {"stiffness": 1e4, "restitution": 0.5, "speed": 1.0}
    scene.add(nc.Contact(ball, nc.Plane(), **floor, name="floor"))
    system, _ = scene.compile()

    def damping(e):
        return system.set("floor", restitution=e).get("floor", "damping")

    lossless = 1.0 - 10.0 ** -np.random.default_rng(0).uniform(6.0, 15.9, 1000)
    lossy = 10.0 ** -np.linspace(6.0, 12.0, 20)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(damping)))(np.concatenate([lossless, lossy, [1.0]]))
    near, far = slice(0, 1000), slice(1000, 1020)
    wanted = 1.5 * (1.0 - lossless)
    assert np.all(np.abs(values[near] - wanted) <= 2e-6 * wanted + 2e-18)
    assert np.max(np.abs(slopes[near] / -1.5 - 1.0)) <= 4e-6
    assert np.max(np.abs(values[far] * lossy - 1.0)) <= 1e-6
    assert values[-1] == 0.0 and abs(slopes[-1] + 1.5) <= 1e-6


@pytest.mark.parametrize(
    "scheme",
    [
        pytest.param(nc.EnergyMomentum(order=4), marks=pytest.mark.exhaustive, id="order 4"),
        pytest.param(nc.EnergyMomentum(kick=True), marks=pytest.mark.exhaustive, id="kick"),
        pytest.param(nc.Dissipative(), marks=pytest.mark.exhaustive, id="dissipative"),
    ],
)
def test_losses_are_booked_once(scheme):
    """By every scheme that books: what an impact loses is the contact's, what damping takes is not."""
    system, state = dropped(stiffness=2e4, restitution=0.6, speed=2.0)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=600, scheme=scheme)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    assert float(lost(system, trajectory, "bounce")[-1]) < -0.5


@pytest.mark.slow
def test_a_pendulum_that_hits_a_wall():
    """A body on a joint: an impact meets its inertia about the joint, wherever in a step it falls."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(1.0, 0, 0), name="bob"))
    hinge = scene.add(nc.Revolute(nc.ground, ball, axis=(0, 0, 1), point=(0, 0, 0)))
    wall = nc.Plane(normal=(0, -1, 0), point=(0, 0.6, 0))
    scene.add(nc.Contact(ball, wall, restitution=1.0, name="wall"))
    system, state = scene.compile()

    def run(rate, restitution):
        begun = system.with_coordinate(state, hinge, 0.0, rate=rate)
        lossy = system.set("wall", restitution=restitution)
        return lossy, nc.simulate(lossy, begun, dt=7e-3, steps=100, scheme=nc.EnergyMomentum(kick=True))

    def parting(restitution, rate):
        lossy, trajectory = run(rate, restitution)
        return lossy.sense(trajectory, hinge).rates[-1, 0] / rate

    speeds = jnp.linspace(1.98, 2.02, 101)
    for restitution in (1.0, 0.5):
        assert nc.balance(*run(2.0, restitution)).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
        found = jax.vmap(partial(parting, restitution))(speeds)
        np.testing.assert_allclose(found, -restitution, rtol=1e-13)


@pytest.mark.parametrize(
    ("law", "h", "bound"),
    [
        pytest.param({"restitution": 1.0}, 5e-4, 1e-12, marks=pytest.mark.exhaustive, id="hard"),
        pytest.param({"stiffness": 1e8}, 2e-5, 2e-3, marks=pytest.mark.exhaustive, id="soft"),
    ],
)
def test_a_cradle_with_gaps(law, h, bound):
    """The sequence of impacts through gaps that steps resolve: the last ball has all of the speed."""
    scene = nc.Scene()
    balls = [
        scene.add(nc.RigidBody(**BALL, position=(x, 0, 0), velocity=(speed, 0, 0)))
        for x, speed in ((-0.001, 1.0), (0.201, 0.0), (0.402, 0.0), (0.603, 0.0), (0.804, 0.0))
    ]
    for one, other in zip(balls, balls[1:]):
        scene.add(nc.Contact(one, other, **law))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=round(0.015 / h))
    final = [float(system.sense(trajectory, ball).velocity[-1, 0]) for ball in balls]
    np.testing.assert_allclose(final, [0, 0, 0, 0, 1], atol=bound)
    balance = nc.balance(system, trajectory)
    assert balance.energy.max() <= tol.ENERGY_OF_A_STIFF_CONTACT
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE


@pytest.mark.exhaustive
def test_impacts_from_all_sides_at_once():
    """Six balls fly into one: nothing turns, what was at rest stays there, all part as they should."""
    scene = nc.Scene()
    middle = scene.add(nc.RigidBody(**BALL))
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        ball = scene.add(nc.RigidBody(**BALL, position=0.5 * axis, velocity=-1.0 * axis))
        scene.add(nc.Contact(middle, ball, restitution=0.7))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.07, steps=12)
    assert_never_gains(system, trajectory)
    at = system.sense(trajectory, middle)
    assert np.abs(np.asarray(at.velocity)).max() <= 1e-12
    assert np.abs(np.asarray(at.angular_velocity)).max() <= 1e-12
    speeds = np.linalg.norm(np.asarray(trajectory.v)[-1].reshape(-1, 4, 3)[1:, 0], axis=1)
    np.testing.assert_allclose(speeds, 0.7, rtol=1e-12)


@pytest.mark.exhaustive
def test_restitutions_that_differ_make_no_energy():
    """What each support of a plate would do alone gives energy together: then less of it is given back."""
    scene, random = nc.Scene(), np.random.default_rng(1)
    plate = scene.add(nc.RigidBody(shape=nc.Box((1.0, 1.0, 0.1)), density=100.0, position=(0, 0, 0.1)))
    up = nc.Direction(nc.ground, (0, 0, 1))
    for k, (x, y) in enumerate(((-0.4, -0.4), (0.4, -0.3), (0.0, 0.4), (0.3, 0.3))):
        markers = nc.Point(nc.ground, (x, y, 0)), up, nc.Point(plate, (x, y, 0.1))
        scene.add(
            nc.GapConstraint(markers, nc.SphereOnPlane(radius=0.0), restitution=float(k % 2), name=f"leg {k}")
        )
    system, state = scene.compile()
    limited = 0
    for _ in range(12):
        spin, speed = random.normal(size=3) * (2, 2, 0), -abs(random.normal())
        rows = np.concatenate([[(0, 0, speed)], np.cross(spin, np.eye(3))])
        start = nc.State(**{**vars(state), "v": jnp.asarray(rows)})
        trajectory = nc.simulate(system, start, dt=0.01, steps=40)
        assert_never_gains(system, trajectory)
        limited += abs(lost(system, trajectory, "leg")[-1]) <= 1e-9 * abs(speed)
    assert limited < 12


def test_law_of_collisions():
    """No contact pulls; those that push part at e of the speed of closing; energy by the formula.

    The contract of the solver, whatever it is: an impact is a problem of linear complementarity.
    """
    rng, law = np.random.default_rng(3), jax.jit(collision_impulses)
    for pushed in (1, 3, 6):
        lever = rng.normal(size=(6, 4))  # six contacts of four freedoms: W is singular
        lever[pushed:] = 0.0
        matrix, rates = jnp.asarray(lever @ lever.T), jnp.asarray(lever @ rng.normal(size=4))
        on, e = jnp.arange(6) < pushed, jnp.full(6, 0.7)
        _, impulses = law(matrix, rates, e, on)
        plastic, _ = law(matrix, rates, 0.0 * e, on)
        slip = rates + matrix @ plastic
        assert plastic.min() >= 0 and slip.min() >= -1e-12 and np.abs(plastic * slip).max() <= 1e-12
        pushing = np.asarray(impulses) > 0
        np.testing.assert_allclose((rates + matrix @ impulses)[pushing], -0.7 * rates[pushing], atol=1e-12)
        work = float(impulses @ (rates + 0.5 * matrix @ impulses))
        assert work == pytest.approx(-0.5 * (1 - 0.49) * float(plastic @ matrix @ plastic), rel=1e-12)


@cache
def rod():
    """A rod that falls on its end, tilted, with friction."""
    scene = nc.Scene()
    body = {"shape": nc.Capsule(0.02, 0.4), "density": 1000.0, "position": (0, 0, 1.0), "name": "rod"}
    scene.add(nc.Contact(scene.add(nc.RigidBody(**body)), FLOOR, restitution=0.5, friction=0.6, name="hit"))
    return scene.compile()


def tilted(angle, *, fallen, velocity=(0, 0, -1.0), spin=(0, 0, 0)):
    """The rod, tilted by an angle [degrees], its lower end so far above the floor."""
    turn = np.radians(angle)
    axes = np.array([(np.cos(turn), 0, -np.sin(turn)), (0, 1, 0), (np.sin(turn), 0, np.cos(turn))])
    rows = jnp.asarray(np.concatenate([[(0, 0, 0.02 + 0.2 * np.cos(turn) + fallen)], axes]))
    rates = jnp.asarray(np.concatenate([[velocity], np.cross(spin, axes)]))
    system, state = rod()
    return system, nc.State(**{**vars(state), "q": rows, "v": rates})


def off_centre(block, angle, restitution, friction):
    """Velocity (x, z) and spin after a rigid body that falls at 1 m/s is hit at the end of the rod."""
    turn = np.radians(angle)
    arm = np.array([-0.2 * np.sin(turn), -0.2 * np.cos(turn) - 0.02])
    pull = np.array([[1, 0, arm[1]], [0, 1, -arm[0]]])
    answers = pull @ np.diag([1 / block[0, 0]] * 2 + [1 / (block[1, 1] + block[3, 3])])
    wanted, matrix = np.array([0.0, 1.0 + restitution]), answers @ pull.T
    impulses = np.linalg.solve(matrix, wanted)
    if abs(impulses[0]) > friction * impulses[1]:
        cone = np.array([np.sign(impulses[0]) * friction, 1.0])
        impulses = cone * wanted[1] / (matrix @ cone)[1]
    return np.array([0.0, -1.0, 0.0]) + impulses @ answers


SCHEMES = [
    pytest.param(nc.EnergyMomentum(), 5e-4, marks=pytest.mark.slow, id="whole steps"),
    pytest.param(LOCATED, 1e-9, marks=pytest.mark.exhaustive, id="located"),
]


@pytest.mark.parametrize(("scheme", "near"), SCHEMES)
def test_friction_leaves_restitution_as_it_is(scheme, near):
    """Of what is hit off its centre, whether it sticks or slips; 0.24 to 0.59 of 0.5 had been left."""
    for angle in (20, 45, 70):
        for restitution, friction in ((0.0, 0.6), (0.5, 0.6), (0.5, 0.1)):
            system, state = tilted(angle, fallen=0.01037)
            system = system.set(("hit[0]", "hit[1]"), restitution=restitution, friction=friction)
            trajectory = nc.simulate(system, state, dt=1e-4, steps=110, scheme=scheme)
            moving = system.sense(trajectory, "rod")
            motion = np.array(
                [*np.asarray(moving.velocity)[-1, [0, 2]], np.asarray(moving.angular_velocity)[-1, 1]]
            )
            exact = off_centre(np.asarray(system.get("rod", "mass_block")), angle, restitution, friction)
            np.testing.assert_allclose(motion, exact, atol=near * np.abs(exact).max())
            assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.parametrize(("scheme", "near"), SCHEMES)
def test_an_impact_with_friction_gives_no_energy(scheme, near):
    """Newton's restitution of what spins in off its centre would: then less of the closing speed is left."""
    system, state = tilted(30, fallen=0.01, velocity=(0, 0, -0.2), spin=(0, 30.0, 0))
    system = system.set(("hit[0]", "hit[1]"), restitution=1.0, friction=0.8)
    trajectory = nc.simulate(system, state, dt=1e-3, steps=110, scheme=scheme)
    assert_never_gains(system, trajectory)
    assert lost(system, trajectory, "hit")[-1] < -1e-3
