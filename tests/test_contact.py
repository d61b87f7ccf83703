"""Contact by potentials of gaps: conservation, restitution, Hertz, derivatives, shapes, wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.effects.contact.law import damping_of
from natcoord_jax.effects.contact.pairs import TOWARDS_MIDDLE, segment_distance_square
from natcoord_jax.viz.links import links

FLOOR = nc.Plane(normal=(0, 0, 1))
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg
STIFF = 10 * tol.ENERGY_OF_A_SMALL_SCENE
"""Energy of contacts so stiff that places are rounded by more of it."""


def heights(system, trajectory, body):
    return np.asarray(system.sense(trajectory, body).position)[:, 2]


@pytest.mark.parametrize(
    ("stiffness", "h", "apex"), [(1e4, 1e-2, 2e-2), (1e4, 2e-3, 1e-3), (1e8, 1e-2, 2e-3)]
)
def test_bouncing_ball(stiffness, h, apex):
    """Dropped from 1 m: energy to rounding whatever the step, and no deeper than v sqrt(m / k)."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(
        nc.RigidBody(shape=nc.Sphere(0.1), density=1 / (4 / 3 * np.pi * 1e-3), position=(0, 0, 1.1))
    )
    scene.add(nc.Contact(ball, FLOOR, stiffness=stiffness, name="bounce"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=round(3.0 / h))
    assert nc.balance(system, trajectory).energy.max() <= STIFF
    z = heights(system, trajectory, ball) - 0.1
    assert z.min() >= -1.02 * np.sqrt(2 * 9.81 / stiffness) - 9.81 / stiffness
    at = np.asarray(trajectory.t)
    second = z[(at > 0.6) & (at < 1.3)].max()
    # Falls of 1 m last 0.4515 s; the contact half a period more.
    assert abs(second - 1.0) <= apex
    gap = np.asarray(system.sense(trajectory, "bounce").gap)
    np.testing.assert_allclose(gap, z, atol=1e-14)


def collision(h, *, restitution=1.0, law="linear", stiffness=1e6, speed=10.0, closing=10.0):
    """Two equal spheres in space; the speed at which they part."""
    scene = nc.Scene()
    given = {"shape": nc.Sphere(0.1), "density": 1.6 / (4 / 3 * np.pi * 1e-3)}
    start = 0.1 + 0.3 * h * closing / 2
    one = scene.add(nc.RigidBody(position=(-start, 0, 0), velocity=(closing / 2, 0, 0), **given))
    two = scene.add(nc.RigidBody(position=(start, 0, 0), velocity=(-closing / 2, 0, 0), **given))
    lossy = {} if restitution == 1.0 else {"restitution": restitution, "speed": speed}
    scene.add(nc.Contact(one, two, stiffness=stiffness, law=law, name="impact", **lossy))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=h, steps=round(8e-3 / h))
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    if lossy:
        assert np.diff(np.asarray(system.work(trajectory)["impact"])).max() <= 1e-13
    velocity = np.asarray(system.sense(trajectory, two).velocity)[-1, 0]
    return 2 * velocity


@pytest.mark.parametrize("law", ["linear", "hertz"])
@pytest.mark.parametrize("restitution", [0.9, 0.5, 0.1])
def test_restitution(law, restitution):
    """As asked for at the speed that it is of, whatever the law; of slower impacts more is left."""
    stiffness = {"linear": 1e6, "hertz": 1e8}[law]
    found = collision(1e-5, restitution=restitution, law=law, stiffness=stiffness)
    assert found == pytest.approx(10 * restitution, rel=2e-4)
    if restitution == 0.5:
        slow = collision(1e-5, restitution=0.5, law=law, stiffness=stiffness, closing=5.0)
        assert slow / 5.0 == pytest.approx(0.673, abs=2e-3)


def test_restitution_follows_what_is_set():
    """A stiffness or a radius leaves it as it is; it is a number of the contact itself."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.2), velocity=(0, 0, -1.0)))
    scene.add(nc.Contact(ball, FLOOR, stiffness=2e4, restitution=0.5, speed=1.0, name="bounce"))
    system, state = scene.compile()
    run = jax.jit(lambda s: nc.simulate(s, state, dt=5e-4, steps=600).states.v[-1, 0, 2])
    for changed, expected in (
        ({"stiffness": 2e5}, 0.5),
        ({"stiffness": 5e3}, 0.5),
        ({"radius": 0.15}, 0.5),
        ({"restitution": 0.9}, 0.9),
    ):
        assert float(run(system.set("bounce", **changed))) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("numbers", [{"restitution": 1.2}, {"restitution": 0.0}, {"stiffness": 0.0}])
def test_what_would_give_energy_is_not_set(numbers):
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.2)))
    scene.add(nc.Contact(ball, FLOOR, stiffness=2e4, restitution=0.5, speed=1.0, name="bounce"))
    with pytest.raises(ValueError, match=f"contact 'bounce'.*{next(iter(numbers))}"):
        scene.compile()[0].set("bounce", **numbers)


@pytest.mark.parametrize(
    "scheme",
    [nc.EnergyMomentum(), nc.EnergyMomentum(kick=True), nc.EnergyMomentum(order=4), nc.Dissipative()],
)
def test_losses_are_booked_once(scheme):
    """By every scheme that books: what an impact loses is the contact's, what damping takes is not."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.3)))
    scene.add(nc.Contact(ball, FLOOR, stiffness=2e4, restitution=0.6, speed=2.0, name="bounce"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=300, scheme=scheme)
    assert nc.balance(system, trajectory).energy.max() <= STIFF
    assert float(system.work(trajectory)["bounce"][-1]) < -0.5


def test_elastic_impact_at_large_steps():
    """Not resolved at all, and still nothing is lost: the speed is that before."""
    assert collision(1e-3) == pytest.approx(10.0, rel=1e-9)


def test_damping_for_a_restitution():
    """Roots of (1 + d) / (1 - e d) = exp(d (1 + e)), and their derivatives, where nothing is lost too."""
    for e, d in ((0.9, 0.16648), (0.5, 1.43275), (0.1, 9.99816)):
        assert float(damping_of(e, 2.0)) == pytest.approx(d / 2, rel=1e-4)
        rate = jax.grad(lambda e: damping_of(e, 1.0))(e)
        apart = (damping_of(e + 1e-5, 1.0) - damping_of(e - 1e-5, 1.0)) / 2e-5
        assert float(rate) == pytest.approx(float(apart), rel=1e-6)
    assert float(damping_of(1.0, 1.0)) == 0.0
    assert float(jax.grad(lambda e: damping_of(e, 1.0))(1.0)) == -1.5


def on_plane(axes, points, turned=False):
    """A point of a plane and its normal, and a point of a body, with its axes if it is turned."""
    return np.stack([points[0], axes[0][0], points[1], *(axes[1] if turned else ())])


GAPS = {
    nc.SphereOnPlane: (nc.SphereOnPlane(radius=0.3), (0, 2), (2,), on_plane),
    nc.EllipsoidOnPlane: (
        nc.EllipsoidOnPlane(semi_axes=np.array([0.2, 0.3, 0.4])),
        (0, 2),
        (2,),
        lambda axes, points: on_plane(axes, points, turned=True),
    ),
    nc.DiscOnPlane: (
        nc.DiscOnPlane(radius=0.3),
        (0, 2),
        (2,),
        lambda axes, points: on_plane(axes, points, turned=True)[:4],
    ),
    nc.SphereOnSphere: (
        nc.SphereOnSphere(radii=np.array([0.2, 0.3])),
        (0, 1),
        (1,),
        lambda axes, points: points[:2],
    ),
    nc.CapsuleOnCapsule: (
        nc.CapsuleOnCapsule(radii=np.array([0.2, 0.3])),
        (0, 1, 2, 3),
        (2, 3),
        lambda axes, points: points,
    ),
    nc.SphereOnBox: (
        nc.SphereOnBox(size=np.array([0.3, 0.5, 0.7]), radius=0.2),
        (0, 1),
        (1,),
        lambda axes, points: np.stack([*points[:2], *axes[0]]),
    ),
    nc.CornersOnBox: (
        nc.CornersOnBox(size=np.array([0.3, 0.5, 0.7]), corner=np.array([0.2, -0.3, 0.1]), rounding=0.02),
        (0, 1),
        (1,),
        lambda axes, points: np.stack([*points[:2], *axes[0], *axes[1]]),
    ),
    nc.EdgesOnEdges: (
        nc.EdgesOnEdges(
            sizes=np.array([[0.3, 0.5, 0.7], [0.4, 0.6, 0.2]]), skew=np.array([1.0, -1.0]), rounding=0.02
        ),
        (0, 1),
        (1,),
        lambda axes, points: np.stack([*points[:2], *axes[0], *axes[1]]),
    ),
}
"""Gaps; which of their markers are points, and which of these the second body's; markers somewhere."""


def test_every_gap_has_its_contract():
    public = [x for x in vars(nc).values() if isinstance(x, type) and issubclass(x, nc.Gap)]
    assert set(public) - {nc.Gap} == set(GAPS)


@pytest.mark.parametrize("gap", GAPS, ids=lambda gap: gap.__name__)
def test_contract_of_gaps(gap):
    """Frame-indifferent, also of what is no motion; its change in a step of a radian is foretold exactly."""
    made, points, second, markers = GAPS[gap]
    random = np.random.default_rng(4)
    for _ in range(20):
        axes = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(3)]
        x = markers(axes, random.normal(size=(4, 3)))
        point = np.isin(np.arange(len(x)), points)
        moved = x @ axes[2].T + point[:, None] * random.normal(size=3)
        value = float(made.distance(made.invariants(jnp.asarray(x))))
        assert float(made.distance(made.invariants(jnp.asarray(moved)))) == pytest.approx(value, abs=1e-13)
        # At the middle of a step directions are no unit vectors.
        middle = jnp.asarray(x + 0.2 * random.normal(size=x.shape))
        forces = np.asarray(made.gradient(middle))
        assert np.abs(forces[point].sum(axis=0)).max() <= 1e-12
        assert np.abs(np.cross(middle, forces).sum(axis=0)).max() <= 1e-12
        start, flow = jax.jvp(made.invariants, (middle,), (jnp.asarray(random.normal(size=x.shape)),))
        foretold = made.averaged(start, flow[None], nc.EnergyMomentum().tableau)[0] @ flow
        change = made.distance(start + flow) - made.distance(start)
        assert float(foretold) == pytest.approx(float(change), abs=1e-12)
        # The second body is pushed along the normal. (The nearest points of segments are drawn to their
        # middles a little.)
        tolerance = 2e-2 if gap in (nc.CapsuleOnCapsule, nc.EdgesOnEdges) else 1e-12
        _, normal = made.contact(jnp.asarray(x))
        pushed = np.asarray(made.gradient(jnp.asarray(x)))[list(second)].sum(axis=0)
        np.testing.assert_allclose(pushed, normal, atol=tolerance)


def test_distance_of_segments():
    """Against the least of many; degenerate and parallel ones, too; derivatives against differences."""
    random = np.random.default_rng(0)
    s = np.linspace(0, 1, 201)

    def products(x):
        one, other, apart = x[1] - x[0], x[3] - x[2], x[0] - x[2]
        pairs = (one, one), (other, other), (one, other), (one, apart), (other, apart), (apart, apart)
        return jnp.stack([u @ v for u, v in pairs])

    cases = list(random.normal(size=(40, 4, 3)))
    cases.append(np.array([(0, 0, 0), (1, 0, 0), (0.2, 1, 0), (2, 1, 0.0)]))  # parallel
    cases.append(np.array([(0, 0, 0), (1, 0, 0), (3, 1, 0), (2, 1, 0.0)]))  # parallel, apart
    cases.append(np.array([(0, 0, 0), (0, 0, 0), (1, 1, 0), (2, 1, 0.0)]))  # a point
    cases.append(np.array([(0, 0, 0), (1, 0, 0), (0.5, 1, 0), (0.5, 1, 0.0)]))  # the other a point
    cases.append(np.array([(0, 0, 0), (0, 0, 0), (1, 1, 0), (1, 1, 0.0)]))  # both
    for x in cases:
        one, other = (x[k] + s[:, None] * (x[k + 1] - x[k]) for k in (0, 2))
        least = np.min(np.sum((one[:, None] - other[None]) ** 2, axis=2))
        found = float(segment_distance_square(products(jnp.asarray(x))))
        lengths = np.sum((x[1] - x[0]) ** 2) + np.sum((x[3] - x[2]) ** 2)
        assert least - 0.02 <= found <= least + 0.5 * TOWARDS_MIDDLE * lengths + 1e-12
        assert np.all(
            np.isfinite(jax.hessian(lambda x: segment_distance_square(products(x)))(jnp.asarray(x)))
        )


def capsules(angle=0.4):
    scene = nc.Scene()
    shape = nc.Capsule(radius=0.05, length=0.5)
    moving = {"velocity": (0, 0, 1.0), "angular_velocity": (0.0, 0.5, 1.0)}
    one = scene.add(nc.RigidBody(shape=shape, density=300.0, orientation=((0, 1, 0), np.pi / 2), **moving))
    turn, spin = ((1, 0, 0), np.pi / 2 + angle), (2.0, 0.0, 0.3)
    place = {"position": (0.1, 0.05, 0.3), "velocity": (0.1, 0, -1.0)}
    two = scene.add(
        nc.RigidBody(shape=shape, density=600.0, orientation=turn, angular_velocity=spin, **place)
    )
    scene.add(nc.Contact(one, two, stiffness=1e4, name="impact"))
    return scene.compile()


def ellipsoid():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    pebble = scene.add(
        nc.RigidBody(
            shape=nc.Ellipsoid((0.3, 0.2, 0.1)), density=40.0, position=(0, 0, 0.5),
            velocity=(0.5, 0, 0), angular_velocity=(1.0, 2.0, 0.5),
        )
    )  # fmt: skip
    scene.add(nc.Contact(pebble, FLOOR, stiffness=1e4, name="impact"))
    return scene.compile()


def box():
    """A box that falls on a corner of a tilted table, whose normal turns with a body."""
    scene = nc.Scene()
    table = scene.add(nc.RigidBody(mass=5.0, inertia=(1.0, 1.2, 1.5), position=(0, 0, -0.2)))
    brick = scene.add(
        nc.RigidBody(
            shape=nc.Box((0.3, 0.2, 0.1)), density=300.0, position=(0.05, 0, 0.4), velocity=(0, 0, -2.0),
            orientation=((1, 1, 0), 0.5), angular_velocity=(0.5, 0.2, 1.0),
        )
    )  # fmt: skip
    plane = nc.Plane(normal=(0.1, 0, 1), body=table)
    scene.add(nc.Contact(brick, plane, stiffness=2e4, name="impact"))
    return scene.compile()


def ball_on_box():
    scene = nc.Scene()
    brick = scene.add(
        nc.RigidBody(shape=nc.Box((0.3, 0.2, 0.1)), density=300.0, angular_velocity=(0, 0.3, 0.2))
    )
    ball = {"shape": nc.Sphere(0.05), "density": 1000.0, "velocity": (-0.2, 0, -2.0)}
    other = scene.add(nc.RigidBody(position=(0.17, 0.05, 0.3), **ball))
    scene.add(nc.Contact(brick, other, stiffness=2e4, name="impact"))
    return scene.compile()


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("make", [capsules, ellipsoid, box, ball_on_box])
def test_shapes_keep_what_they_should(make, order):
    """Energy, momentum and angular momentum through impacts that store a good part of the energy."""
    system, state = make()
    scheme = nc.EnergyMomentum(order=order)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=500, scheme=scheme)
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= 10 * tol.ENERGY_OF_A_SMALL_SCENE
    if make is not ellipsoid:
        assert found.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
        assert found.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    energy = system.energy(trajectory)
    stored = sum(np.asarray(x) for name, x in energy.stores.items() if name.startswith("impact"))
    assert stored.max() >= 0.05 * float(energy.kinetic[0])


@pytest.mark.parametrize(("tilt", "offset"), [(0.0, 0.0), (0.0, 0.02), (1e-4, 0.02), (1e-2, 0.05)])
def test_parallel_capsules(tilt, offset):
    """They meet along a line: the point where they push moves smoothly, and energy is kept."""
    scene = nc.Scene()
    shape = {"shape": nc.Capsule(radius=0.05, length=0.2), "density": 500.0}
    one = scene.add(nc.RigidBody(**shape))
    tilted = {"orientation": ((1, 0.3, 0), tilt), "velocity": (-1.0, 0, 0)}
    two = scene.add(nc.RigidBody(**shape, position=(0.15, 0, offset), **tilted))
    scene.add(nc.Contact(one, two, stiffness=2e4, name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=150)
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= STIFF
    momentum = np.asarray(system.momentum(trajectory))
    assert np.ptp(momentum, axis=0).max() <= 1e-13
    assert float(system.sense(trajectory, one).velocity[-1, 0]) < -0.5


@pytest.mark.slow
def test_a_cradle_passes_the_impact_on():
    """Five balls with gaps between them: the last one leaves with the speed of the first."""
    scene = nc.Scene()
    balls = [
        scene.add(
            nc.RigidBody(
                shape=nc.Sphere(0.05), density=1 / (4 / 3 * np.pi * 0.05**3),
                position=(0.102 * k - 0.1 * (k == 0), 0, 0), velocity=(1.0 * (k == 0), 0, 0),
            )
        )
        for k in range(5)
    ]  # fmt: skip
    for one, two in zip(balls, balls[1:]):
        scene.add(nc.Contact(one, two, stiffness=1e7))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-4, steps=2500)
    last = [float(system.sense(trajectory, ball).velocity[-1, 0]) for ball in balls]
    np.testing.assert_allclose(last, (0, 0, 0, 0, 1.0), atol=2e-3)
    assert nc.balance(system, trajectory).energy.max() <= STIFF


def test_contacts_are_no_springs_in_pictures():
    example = gallery.load("newton_cradle", balls=2)
    drawn = links(example.system, np.asarray(example.state.q).reshape(1, -1, 4, 3), 1.0)
    assert not [solid.name for solid in drawn if "impact" in solid.name]


def test_gradients_through_a_bounce():
    """Of where a ball is, by its start and by the numbers of the contact; those of the program, V-shaped."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    ball = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 1.0), velocity=(0, 0, 0.3), name="ball"))
    scene.add(nc.Contact(ball, FLOOR, stiffness=1e4, restitution=0.8, speed=4.0, name="bounce"))
    system, state = scene.compile()

    @jax.jit
    def last(x):
        changed = system.set("bounce", stiffness=x[1] * 1e4, restitution=x[2] * 0.8)
        start = nc.State(**{**vars(state), "q": state.q.at[0, 2].add(x[0] - 1.0)})
        return nc.simulate(changed, start, dt=2.5e-3, steps=400).q[-1, 0, 2]

    one = jnp.ones(3)
    direction = jnp.asarray([1.0, 0.3, -0.5])
    assert_v_shaped(last, one, direction, jnp.vdot(jax.grad(last)(one), direction))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda ball, bare: nc.Contact(bare, FLOOR, stiffness=1.0), "'bare' has no shape; give it one"),
        (lambda ball, bare: nc.Contact(ball, FLOOR, stiffness=0.0), r"stiffness.*positive"),
        (lambda ball, bare: nc.Contact(ball, FLOOR, stiffness=1.0, restitution=1.2, speed=1.0), "up to 1"),
        (lambda ball, bare: nc.Contact(ball, FLOOR, stiffness=1.0, restitution=0.5), r"is that of one speed"),
        (lambda ball, bare: nc.Contact(ball, "floor", stiffness=1.0), "other is 'floor'"),
        (lambda ball, bare: nc.Contact(ball, FLOOR, restitution=2.0), "^contact 'contact 1': restitution"),
        (lambda ball, bare: nc.Contact(FLOOR, FLOOR), "'ground' would be in contact with itself"),
    ],
)
def test_wrong_input_is_refused(make, message):
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1.0))
    bare = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="bare"))
    with pytest.raises(ValueError, match=message):
        scene.add(make(ball, bare))


def test_shapes_without_a_gap_are_refused():
    scene = nc.Scene()
    made = [nc.Box((1, 1, 1)), nc.Ellipsoid((1, 1, 1)), nc.Cylinder(0.1, 0.2)]
    one, two, can = (scene.add(nc.RigidBody(shape=shape, density=1.0)) for shape in made)
    with pytest.raises(ValueError, match="no gap between Box 'body 1' and Ellipsoid 'body 2'"):
        scene.add(nc.Contact(one, two, stiffness=1.0))
    with pytest.raises(ValueError, match="no gap between Box 'body 1' and Cylinder 'body 3'"):
        scene.add(nc.Contact(one, can, stiffness=1.0))
    with pytest.raises(ValueError, match="stiffness .* of Cylinder 'body 3' would be"):
        scene.add(nc.Contact(can, FLOOR, stiffness=1.0))
