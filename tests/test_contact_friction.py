"""Friction in contacts by an energy of the gap: what slides, sticks and rolls, momenta, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.maths.friction_law import impulses_with_friction
from natcoord_jax.maths.impact_law import collision_impulses

FLOOR = nc.Plane(normal=(0, 0, 1))
LYING = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
STIFF = {"stiffness": 1e6, "restitution": 0.3, "speed": 0.5}
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg


def resting(body, *, tilt=0.0, friction=0.3, weight=9.81):
    """A body on a plane that its weight has pressed in already; gravity may be tilted."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(-weight * np.sin(tilt), 0, -weight * np.cos(tilt))))
    handle = scene.add(body)
    scene.add(nc.Contact(handle, FLOOR, friction=friction, name="rubs", **STIFF))
    return *scene.compile(), handle


def assert_lossy(system, trajectory):
    """Energy balances, and no step gains any."""
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-13 * np.abs(energy).max()


@pytest.mark.parametrize("h", [0.01, 2e-3])
def test_what_slides_stops(h):
    """A mass of 1 kg: after v / (mu g), at v^2 / (2 mu g); then it rests, exactly."""
    sunk = 9.81 / 1e6
    mass = nc.PointMass(mass=1.0, position=(0, 0, -sunk), velocity=(2.0, 0, 0))
    system, state, _ = resting(mass)
    trajectory = nc.simulate(system, state, dt=h, steps=round(0.9 / h))
    assert_lossy(system, trajectory)
    assert float(trajectory.q[-1, 0, 0]) == pytest.approx(4 / (2 * 0.3 * 9.81), abs=2e-6)
    assert np.abs(np.asarray(trajectory.v)[-1, 0, 0]) <= 1e-12
    force = nc.contacts(system, trajectory).force[:, 0]
    np.testing.assert_allclose(force, 9.81, rtol=1e-6)


@pytest.mark.parametrize(("friction", "place", "off"), [(0.8, 0.373289, 3e-5), (0.5, -0.1684, 1.5e-3)])
def test_slope(friction, place, off):
    """Thrown up a slope of tangent 0.7: held by a coefficient of 0.8, slides back with 0.5."""
    tilt = np.arctan(0.7)
    sunk = 9.81 * np.cos(tilt) / 1e6
    mass = nc.PointMass(mass=1.0, position=(0, 0, -sunk), velocity=(3.0, 0, 0))
    system, state, _ = resting(mass, tilt=tilt, friction=friction)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=600)
    assert_lossy(system, trajectory)
    assert float(trajectory.q[-1, 0, 0]) == pytest.approx(place, abs=off)


def test_sphere_begins_to_roll():
    """With five sevenths of its speed, after bounces that it loses some of."""
    ball = nc.RigidBody(**BALL, position=(0, 0, 0.101), velocity=(2.0, 0, 0))
    system, state, ball = resting(ball)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=300)
    assert_lossy(system, trajectory)
    assert float(system.sense(trajectory, ball).velocity[-1, 0]) == pytest.approx(2.0 * 5 / 7, rel=1e-9)


def test_momenta():
    """Two balls in space that meet off their centres: what rubs turns one as much as the other."""
    scene = nc.Scene()
    spins = (0, 3, 20), (5, 0, 1)
    given = {"position": (-0.3, 0.05, 0), "velocity": (1.0, 0, 0), "angular_velocity": spins[0]}
    one = scene.add(nc.RigidBody(**BALL, **given))
    given = {"position": (0.3, 0, 0), "velocity": (-1.0, 0, 0), "angular_velocity": spins[1]}
    other = scene.add(nc.RigidBody(**BALL, **given))
    scene.add(nc.Contact(one, other, stiffness=1e4, friction=0.4, name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=250)
    found = nc.balance(system, trajectory)
    for drift in (found.energy, found.momentum, found.angular_momentum):
        assert drift.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.work(trajectory)["impact"][-1]) < -0.05
    turned = np.asarray(system.sense(trajectory, other).angular_velocity)
    assert abs(turned[-1, 2] - turned[0, 2]) > 1.0


@pytest.mark.slow
def test_derivatives():
    """By the speed at the start, the coefficient and the stiffness, through a bounce with slip."""
    ball = nc.RigidBody(**BALL, position=(0, 0, 0.12), velocity=(1.0, 0.2, -0.5))
    system, state, _ = resting(ball)

    def end(x):
        moved = eqx.tree_at(lambda s: s.v, state, state.v.at[0].add(x[0] * jnp.array([1.0, -0.3, 0.2])))
        rough = system.set("rubs", friction=0.2 + x[1], stiffness=2e4 * (1 + x[2]))
        return nc.simulate(rough, moved, dt=2e-3, steps=60, throw=False).q[-1, 0]

    x, along = jnp.array([0.02, 0.01, 0.1]), jnp.array([0.6, 0.3, 0.5])
    assert_v_shaped(end, x, along, jax.jvp(end, (x,), (along,))[1])
    total = lambda x: jnp.sum(end(x))  # noqa: E731
    assert_v_shaped(total, x, along, jax.grad(total)(x) @ along)


def test_refused():
    """What has no friction yet, and who cannot step with it, by name."""
    ball = nc.RigidBody(**BALL, position=(0, 0, 0.12))
    system, state, _ = resting(ball)
    with pytest.raises(ValueError, match="soft contact with friction 'rubs'.*EnergyMomentum"):
        nc.simulate(system, state, dt=0.01, steps=2, scheme=nc.EnergyMomentum(order=4))
    with pytest.raises(ValueError, match="'rubs' is not defined.*leave out the friction"):
        nc.equilibrium(system, state)
    with pytest.raises(ValueError, match="'rubs' has a restitution"):
        system.set("rubs", restitution=1.5)
    with pytest.raises(ValueError, match="no contacts; add nc.Contact"):
        empty = nc.Scene()
        empty.add(nc.PointMass(mass=1.0))
        alone, start = empty.compile()
        nc.contacts(alone, nc.simulate(alone, start, dt=0.1, steps=1))


RUBBER = nc.Elastic(E=1e6, nu=0.3, density=1000.0)


@pytest.mark.slow
def test_a_block_of_solid_elements_slides_and_stops():
    """Its nodes rub on a plane: it stops where a point does, but for how it gives way, and no step gains."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mesh = nc.mesh.box((0.2, 0.2, 0.1), (2, 2, 1))
    block = scene.add(nc.Solid(mesh, material=RUBBER, velocity=(1.0, 0, 0)))
    scene.add(nc.Contact(block.face("z0"), FLOOR, friction=0.3))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=300)
    assert_lossy(system, trajectory)
    points = slice(None, None, 4)
    moved = np.mean((np.asarray(trajectory.q)[-1] - np.asarray(trajectory.q)[0])[points, 0])
    assert moved == pytest.approx(1.0 / (2 * 0.3 * 9.81), rel=2e-3)
    # What is left is how the block shakes on the nodes that hold it.
    assert np.abs(np.mean(np.asarray(trajectory.v)[-60:, points, 0], axis=1)).max() < 0.01


@pytest.mark.slow
def test_nodes_that_rub_keep_momenta():
    """A block thrown at a table that flies and turns: what rubs turns both."""
    scene = nc.Scene()
    table = scene.add(nc.RigidBody(mass=2.0, inertia=(0.05, 0.05, 0.1), angular_velocity=(0.1, 0.2, 3.0)))
    given = {"material": RUBBER, "velocity": (0.5, 0.2, -1.0), "position": (-0.1, -0.1, 0.02)}
    block = scene.add(nc.Solid(nc.mesh.box((0.2, 0.2, 0.1), (1, 1, 1)), **given))
    plane = nc.Plane(normal=(0, 0, 1), body=table)
    scene.add(nc.Contact(block.face("z0"), plane, stiffness=1e4, friction=0.4, name="rubs"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=60)
    assert_lossy(system, trajectory)
    for momentum in (system.momentum(trajectory), system.angular_momentum(trajectory)):
        assert np.ptp(np.asarray(momentum), axis=0).max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    lost = [float(work[-1]) for name, work in system.work(trajectory).items() if name.startswith("rubs")]
    assert sum(lost) < -1e-3


def test_nodes_that_do_not_rub():
    """Where they would do so beside themselves, as those of shells do, and on spheres; refused by name."""
    scene = nc.Scene()
    plate = scene.add(nc.Shell(nc.mesh.rectangle((0.2, 0.2), (1, 1)), thickness=0.02, material=RUBBER))
    block = scene.add(nc.Solid(nc.mesh.box((0.2, 0.2, 0.1), (1, 1, 1)), material=RUBBER))
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 1)))
    for part, other in ((plate, FLOOR), (block, ball)):
        with pytest.raises(ValueError, match="no friction .* but those of solids on planes; leave it out"):
            scene.add(nc.Contact(part, other, friction=0.3))


def off_centre(angle, restitution, friction, **given):
    """How a rod goes on that falls on its end, tilted, and how a rigid body does that is hit there."""
    turn, lift, fallen = np.radians(angle), 0.02, 0.01037
    scene = nc.Scene()
    rod = scene.add(
        nc.RigidBody(
            shape=nc.Capsule(lift, 0.4),
            density=1000.0,
            position=(0, 0, lift + 0.2 * np.cos(turn) + fallen),
            orientation=((0, 1, 0), turn),
            velocity=(0, 0, -1),
            name="rod",
        )
    )
    scene.add(nc.Contact(rod, FLOOR, restitution=restitution, friction=friction))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-4, steps=110, **given)
    moving = system.sense(trajectory, rod)
    arm = np.array([-0.2 * np.sin(turn), -0.2 * np.cos(turn) - lift])
    block = np.asarray(system.get("rod", "mass_block"))
    found = np.array([*np.asarray(moving.velocity)[-1, [0, 2]], np.asarray(moving.angular_velocity)[-1, 1]])
    pull = np.array([[1, 0, arm[1]], [0, 1, -arm[0]]])
    answers = pull @ np.diag([1 / block[0, 0]] * 2 + [1 / (block[1, 1] + block[3, 3])])
    wanted, matrix = np.array([0.0, 1.0 + restitution]), answers @ pull.T
    impulses = np.linalg.solve(matrix, wanted)
    if abs(impulses[0]) > friction * impulses[1]:
        cone = np.array([np.sign(impulses[0]) * friction, 1.0])
        impulses = cone * wanted[1] / (matrix @ cone)[1]
    return found, np.array([0.0, -1.0, 0.0]) + impulses @ answers, nc.balance(system, trajectory)


@pytest.mark.slow
@pytest.mark.parametrize(
    "angle", [45, *(pytest.param(angle, marks=pytest.mark.exhaustive) for angle in (20, 70))]
)
def test_friction_leaves_restitution_as_it_is(angle):
    """Of what is hit off its centre, whether it sticks or slips; 0.24 to 0.59 of 0.5 had been left."""
    for restitution, friction in ((0.0, 0.6), (0.5, 0.6), (0.5, 0.1)):
        for given, near in (({"scheme": nc.EnergyMomentum(max_events=4)}, 1e-9), ({}, 5e-4)):
            found, exact, balance = off_centre(angle, restitution, friction, **given)
            np.testing.assert_allclose(found, exact, atol=near * np.abs(exact).max())
            assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.slow
def test_an_impact_with_friction_gives_no_energy():
    """Newton's restitution of what spins in off its centre would: then less of the closing speed is left."""
    scene = nc.Scene()
    turn = np.radians(30)
    rod = nc.RigidBody(
        shape=nc.Capsule(0.02, 0.4),
        density=1000.0,
        position=(0, 0, 0.03 + 0.2 * np.cos(turn)),
        orientation=((0, 1, 0), turn),
        velocity=(0.0, 0, -0.2),
        angular_velocity=(0, 30.0, 0),
    )
    scene.add(nc.Contact(scene.add(rod), FLOOR, restitution=1.0, friction=0.8))
    system, state = scene.compile()
    for scheme in (nc.EnergyMomentum(), nc.EnergyMomentum(max_events=4)):
        trajectory = nc.simulate(system, state, dt=1e-3, steps=60, scheme=scheme)
        energy = np.asarray(system.energy(trajectory).total)
        assert np.diff(energy).max() <= 1e-12 * energy[0]
        assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [nc.EnergyMomentum(), nc.EnergyMomentum(max_events=4)])
def test_a_box_rocks_from_edge_to_edge(scheme):
    """It goes on about the other edge, which rests, with the moment of momentum that it has about it."""
    half, height, tilt, h = 0.1, 0.2, np.radians(5.0), 2e-4
    lever = half * np.sin(tilt) + height * np.cos(tilt)
    scene = nc.Scene()
    scene.add(nc.Gravity())
    box = nc.RigidBody(
        shape=nc.Box((2 * half, 2 * half, 2 * height)),
        density=1000.0,
        position=(height * np.sin(tilt) - half * np.cos(tilt), 0, lever),
        orientation=((0, 1, 0), tilt),
    )
    handle = scene.add(box)
    scene.add(nc.Contact(handle, FLOOR, restitution=0.0, friction=0.6))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=600, scheme=scheme)
    # About an edge, by mass.
    own = (half**2 + height**2) / 3
    inertia = own + half**2 + height**2
    falling = np.sqrt(2 * 9.81 * (lever - height) / inertia)
    kept = (own + height**2 - half**2) / inertia
    turning = -np.asarray(system.sense(trajectory, handle).angular_velocity)[:, 1]
    hit = int(np.argmax(turning))
    slowing = 9.81 * half / inertia * h  # in a step
    assert turning[hit] == pytest.approx(falling, abs=slowing)
    assert turning[hit + 1] == pytest.approx(kept * falling, abs=1.5 * slowing)
    edge = system.sense(trajectory, nc.Point(handle, (-half, half, -height), local=True))
    assert np.abs(np.asarray(edge.velocity)[hit + 1 :]).max() <= 1e-3
    assert np.diff(np.asarray(system.energy(trajectory).total)).max() <= 1e-12


@pytest.mark.slow
def test_a_disc_that_stands_on_its_face_spins_down():
    """As slowly as four points of its rim and its centre let it, which share the load by their mobilities."""
    radius, length = 0.1, 0.05
    tilting = 12 * radius**2 / (3 * radius**2 + length**2)
    share = 4 / (4 + 1 + tilting)
    for speed in (0.0, 1.0):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        given = {"velocity": (speed, 0, 0), "angular_velocity": (0, 0, 5.0)}
        disc = nc.RigidBody(
            shape=nc.Cylinder(radius, length), density=1e3, position=(0, 0, length / 2), **given
        )
        disc = scene.add(disc)
        scene.add(nc.Contact(disc, FLOOR, friction=0.2))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=1e-3, steps=320)
        energy = np.asarray(system.energy(trajectory).total)
        assert np.diff(energy).max() <= 1e-12 * energy[0]
        if speed == 0.0:
            moving = system.sense(trajectory, disc)
            spin, place = np.asarray(moving.angular_velocity)[:, 2], np.asarray(moving.position)[-1]
            assert spin[60] == pytest.approx(5.0 - 0.06 * share * 2 * 0.2 * 9.81 / radius, rel=1e-6)
            assert np.abs(spin[290:]).max() <= 1e-9 and np.abs(place[:2]).max() <= 1e-9


def test_law_of_impacts_with_friction():
    """At four points of a rigid body, off its centre: none pulls, energy never rises, one is in its cone."""
    rng, law = np.random.default_rng(1), jax.jit(impulses_with_friction)
    for count in (1, 4):
        for _ in range(20):
            points = rng.normal(size=(count, 3)) * (1, 1, 0) - (0, 0, 1)
            turns = np.cross(points[:, None], np.eye(3)[None])
            levers = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), turns], axis=2)
            levers = levers / np.sqrt([1, 1, 1, *rng.uniform(0.2, 1, 3)])
            along, across = levers[:, 2], (levers * np.diag([1, 1, 0]).sum(0)[:, None]).reshape(-1, 6)
            velocity, on = rng.normal(size=6) - 2 * np.eye(6)[2], jnp.ones(count, bool)
            normal, rates = jnp.asarray(along @ along.T), jnp.asarray(along @ velocity)
            slip = jnp.asarray((across @ velocity).reshape(count, 3))
            smooth = collision_impulses(normal, rates, jnp.full(count, 0.5), on)
            given = slip, jnp.zeros((count, 4)), jnp.full(count, 0.4), *smooth, on, on, jnp.zeros(count)
            found, work = law(normal, across @ along.T, across @ across.T, rates, *given)
            assert found[:, 0].min() >= 0 and work.sum() <= 1e-12
            if count == 1:
                assert np.linalg.norm(found[0, 1:]) <= 0.4 * found[0, 0] + 1e-12


@pytest.mark.parametrize(
    "shape", [nc.Box((0.2, 0.2, 0.2)), pytest.param(nc.Capsule(0.1, 0.2), marks=pytest.mark.slow)]
)
def test_derivatives_where_contacts_share_a_load(shape):
    """What each bears is known by compliance alone: forward, reverse and differences agree nevertheless."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    start = {"position": (0, 0, 0.3), "velocity": (1.0, 0.2, 0), "orientation": LYING}
    body = scene.add(nc.RigidBody(shape=shape, density=100.0, **start))
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
