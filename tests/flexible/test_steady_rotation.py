"""Steady rotations: relative equilibria, what hangs on a joint that turns, and small motions about them.

Could go wrong: half of the centrifugal force; a stiffness without it, so that nothing converges, or with
derivatives of something else; a body left at rest; a rotation taken for steady that a spring, a weight or a
drive ends at once; velocities of the state that are none of the rotation.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import LINE

import natcoord_jax as nc

Z, WEIGHT = jnp.array([0.0, 0.0, 1.0]), 9.81
SECTION = nc.Section.of_numbers(EA=1e6, GA=1e6, EI=(1.0, 100.0), GJ=10.0, density=1.0, rotary=1e-6)


def hub_on_axle(scene, inertia=1.0, about=(0, 0, 0)):
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(inertia,) * 3, position=about, name="hub"))
    return hub, scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1), point=about, name="axle"))


# --- what hangs on a joint turns along ----------------------------------------------------------------------


def test_what_hangs_on_a_joint_by_elements_and_rods_turns_along():
    """The blade of a hub, a bob on a rod at its tip, and nothing of a boom on the other side of the axle."""
    scene, spin = nc.Scene(), (0.0, 0.3, 0.0)
    base, hub = (scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), angular_velocity=spin)) for _ in "ab")
    axle = scene.add(nc.Revolute(base, hub, axis=(0, 0, 1)))
    more = {"elements": 2, "angular_velocity": spin}
    blade = scene.add(nc.Beam(SECTION, LINE, start=hub, **more))
    boom = scene.add(nc.Beam(SECTION, [(0, 0, 0), (-1, 0, 0)], start=base, **more))
    bob = scene.add(nc.PointMass(mass=1.0, position=(1.5, 0, 0), velocity=np.cross(spin, (1.5, 0, 0))))
    scene.add(nc.Rod((nc.Point(blade.end), nc.Point(bob))))
    system, state = scene.compile()
    moved = system.with_coordinate(state, axle, 0.5, rate=2.0)
    rows, rates = np.asarray(moved.rows), np.asarray(moved.row_rates)
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    carried = [system.body_index(node) for node in (*blade.nodes, bob)]
    stays = [system.body_index(node) for node in boom.nodes]
    for bodies, by, whirl in ((carried, turn, (0, 0.3, 2.0)), (stays, np.eye(3), spin)):
        x = rows[bodies, 0]
        np.testing.assert_allclose(x, np.asarray(state.rows)[bodies, 0] @ by.T, atol=tol.IDENTITY)
        np.testing.assert_allclose(rates[bodies, 0], np.cross(whirl, x), atol=tol.IDENTITY)
    axes = rows[carried[:-1], 1:]
    np.testing.assert_allclose(rates[carried[:-1], 1:], np.cross((0, 0.3, 2.0), axes), atol=tol.IDENTITY)


@pytest.mark.slow
def test_nodes_of_a_shell_turn_along_unless_they_are_held_elsewhere():
    scene = nc.Scene()
    hub, axle = hub_on_axle(scene)
    metal, ends = nc.Elastic(E=1e5, nu=0.0, density=1.0), []
    for name, place, holders in (("panel", 0.0, (hub,)), ("bridge", 2.0, (hub, nc.ground))):
        mesh = nc.mesh.rectangle((1.0, 0.2), (3, 1))
        shell = scene.add(nc.Shell(mesh, thickness=0.01, material=metal, position=(place, 0, 0), name=name))
        for holder, side in zip(holders, ("left", "right")):
            scene.add(nc.Clamp(holder, shell.set(side)))
        ends.append(shell.nodes.where(lambda x, p=place: abs(x[:, 0] - p - 2 / 3) < 1e-9)[0])
    system, state = scene.compile()
    moved = system.with_coordinate(state, axle, 0.0, rate=2.0)
    panel, bridge = (np.asarray(moved.row_rates)[system.body_index(x)] for x in ends)
    place = np.asarray(state.rows)[system.body_index(ends[0])]
    np.testing.assert_allclose(panel[:2], 2.0 * np.cross(Z, place[:2]), atol=tol.IDENTITY)
    assert not np.any(bridge)


# --- relative equilibria ------------------------------------------------------------------------------------


def pendulum():
    """A mass on a rod of one metre, that swings about the origin."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -WEIGHT), name="weight"))
    bob = scene.add(nc.PointMass(mass=2.0, position=(0.6, 0, -0.8), name="bob"))
    scene.add(nc.Rod((nc.Point(nc.ground), nc.Point(bob)), name="rod"))
    return scene.compile()


@pytest.mark.slow
def test_a_conical_pendulum_hangs_at_the_angle_of_its_speed():
    """cos a = g / (w^2 l), at all speeds of one path, and it whirls at w sqrt(1 + 3 cos^2 a) about that."""
    system, state = pendulum()
    speeds = np.array([4.0, 5.0, 6.0])
    found = nc.equilibrium(system, state, speeds, rotation=lambda w: w * Z)
    np.testing.assert_allclose(-found.states.q[:, 0, 2], WEIGHT / speeds**2, rtol=tol.EXACT_GRADIENT)
    np.testing.assert_allclose(
        found.states.v[:, 0], np.cross(speeds[:, None] * Z, found.states.q[:, 0]), atol=tol.IDENTITY
    )
    whirl = nc.modes(system, found.state, rotation=speeds[-1] * Z).frequencies[-1]
    cosine = WEIGHT / speeds[-1] ** 2
    assert float(whirl) == pytest.approx(speeds[-1] * np.sqrt(1 + 3 * cosine**2), rel=1e-7)


@pytest.mark.slow
def test_derivatives_of_a_relative_equilibrium():
    """By speed and weight, forward, reverse and forward over reverse, to the closed form.

    The angle about the axis stays: derivatives of where the bob is along x are those of its radius.
    """
    system, state = pendulum()
    state = nc.equilibrium(system, state, rotation=5.0 * Z, steps=1).state
    start, ways = jnp.array([5.0, WEIGHT]), jnp.array([[1.0, 0.0], [0.3, -2.0]])

    def place(p):
        changed = system.set("weight", vector=-p[1] * Z)
        return nc.equilibrium(changed, state, rotation=p[0] * Z, steps=1).state.q[0] @ jnp.array([1.0, 0, 3])

    def exact(p):
        height = p[1] / p[0] ** 2
        return jnp.sqrt(1 - height**2) - 3 * height

    def shown(f):
        second = jax.vmap(lambda way: jax.jvp(jax.grad(f), (start,), (way,)))(ways)
        return second, jax.vmap(lambda way: jax.jvp(f, (start,), (way,)))(ways)

    for one, other in zip(jax.tree.leaves(jax.jit(lambda: shown(place))()), jax.tree.leaves(shown(exact))):
        np.testing.assert_allclose(one, other, rtol=tol.EXACT_GRADIENT)


def governor(scene, arm, radius):
    """Two balls on hinged arms of a spindle."""
    scene.add(nc.Gravity(vector=(0, 0, -WEIGHT)))
    hub, _ = hub_on_axle(scene)
    for side in (1.0, -1.0):
        place = np.array([side * (radius + 0.6 * arm), 0, -0.8 * arm])
        ball = scene.add(nc.RigidBody(mass=2.0, inertia=(1e-9,) * 3, position=place))
        scene.add(nc.Revolute(hub, ball, point=(side * radius, 0, 0), axis=(0, 1, 0)))
        yield ball


@pytest.mark.exhaustive
def test_a_governor_opens_by_its_speed():
    """tan a g = w^2 (r + l sin a), in a run as well: the rotation that was found goes on."""
    scene, arm, radius, speed = nc.Scene(), 0.5, 0.1, 6.0
    ball = list(governor(scene, arm, radius))[0]
    system, state = scene.compile()
    steady = nc.equilibrium(system, state, rotation=speed * Z, steps=1).state
    x, _, z = np.asarray(system.sense(steady, ball).position)
    sine, cosine = (x - radius) / arm, -z / arm
    assert sine / cosine * WEIGHT == pytest.approx(speed**2 * x, rel=1e-7)
    run = nc.simulate(system, steady, dt=1e-3, steps=200, scheme=nc.EnergyMomentum(order=4))
    heights = np.asarray(system.sense(run, ball).position)[:, 2]
    np.testing.assert_allclose(heights, z, rtol=1e-7)


@pytest.mark.exhaustive
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_a_bar_that_floats_is_stretched_about_its_centre(mass):
    """u = tan(k L) / k - L with k = w sqrt(rho / E): sigma = rho w^2 L^2 / 2 in the middle, to first order.

    What floats goes to where its centre of mass is on the axis.
    """
    stiff, heavy, half, speed, ends = 100.0, 2.0, 1.5, 1.5, []
    numbers = {"EA": stiff, "GA": 50.0, "EI": 1.0, "GJ": 1.0, "density": heavy}
    section = nc.Section.of_numbers(**numbers, rotary=(1e-3, 2e-3))  # (A round one could roll.)
    for elements in (4, 8):
        scene = nc.Scene()
        line = [(-half + 0.1, 0, 0), (half + 0.1, 0, 0)]
        scene.add(nc.Beam(section, line, elements=elements, second=(0, 1, 0), mass=mass))
        found = nc.equilibrium(*scene.compile(), rotation=speed * Z, steps=1)
        x = np.asarray(found.state.rows)[:, 0]
        assert np.abs(x[:, 1:]).max() < 1e-9 and abs(x[0, 0] + x[-1, 0]) < 1e-9
        ends.append(x[-1, 0])
    k = speed * np.sqrt(heavy / stiff)
    assert (4 * ends[1] - ends[0]) / 3 - half == pytest.approx(np.tan(k * half) / k - half, rel=5e-4)


WRIGHT = {2.0: 4.1373, 6.0: 7.3604, 10.0: 11.2023}


def blade(elements, inertia=1.0):
    scene = nc.Scene()
    hub, _ = hub_on_axle(scene, inertia)
    more = {"elements": elements, "second": (0, 1, 0), "start": hub, "mass": "consistent", "name": "blade"}
    scene.add(nc.Beam(SECTION, LINE, **more))
    return scene.compile()


@pytest.mark.slow
def test_a_blade_flaps_as_wright_has_it():
    """By the steady state that is found for it, of which it is about; its order is two in the elements."""
    system, state = blade(8)
    for rate, flap in WRIGHT.items():
        steady = nc.equilibrium(system, state, rotation=rate * Z, steps=1).state
        modes = nc.modes(system, steady, rotation=rate * Z, damped=True, count=3)
        assert float(np.abs(modes.frequencies - flap).min()) < 4e-3 * flap


@pytest.mark.exhaustive
def test_a_shell_is_stretched_by_its_rotation():
    """As a bar, without contraction across."""
    scene, speed = nc.Scene(), 10 * np.pi
    hub, _ = hub_on_axle(scene)
    metal = nc.Elastic(E=1e5, nu=0.0, density=1.0)
    mesh = nc.mesh.rectangle((1.0, 0.2), (10, 2))
    shell = scene.add(nc.Shell(mesh, thickness=0.01, material=metal, position=(0, -0.1, 0)))
    scene.add(nc.Clamp(hub, shell.set("left")))
    found = nc.equilibrium(*scene.compile(), rotation=speed * Z, steps=1)
    k = speed * np.sqrt(1e-5)
    stretch = np.asarray(found.state.rows)[:, 0, 0].max() - 1
    assert stretch == pytest.approx(np.tan(k) / k - 1, rel=2e-3)


# --- what is no steady rotation -----------------------------------------------------------------------------


def slider(also):
    """A mass on a radial spring, on a hub that is free to turn, and something besides."""
    scene = nc.Scene()
    hub, axle = hub_on_axle(scene)
    mass = scene.add(nc.RigidBody(mass=0.7, inertia=(0.1,) * 3, position=(1.2, 0, 0), name="mass"))
    scene.add(nc.Prismatic(hub, mass, axis=(1, 0, 0)))
    scene.add(nc.Spring((nc.Point(hub), nc.Point(mass, (1.2, 0, 0))), stiffness=40.0, length=1.0))
    also(scene, axle, nc.Point(mass, (1.2, 0, 0)))
    return scene.compile()


def drive(rate):
    return lambda scene, axle, point: scene.add(nc.Drive(axle, function=lambda t: rate * t, name="motor"))


UNSTEADY = {
    "damper": (lambda s, a, p: s.add(nc.JointDamper(a, damping=0.1)), "torque of 0.3 N m.*nc.Drive"),
    "spring of the axle": (lambda s, a, p: s.add(nc.JointSpring(a, stiffness=1.0, name="coil")), "'coil'"),
    "tether": (
        lambda s, a, p: s.add(nc.Spring((nc.Point(nc.ground, (3, 0, 0)), p), stiffness=1.0, name="tether")),
        "'tether'",
    ),
    "weight across": (lambda s, a, p: s.add(nc.Gravity(vector=(0, -1, 0), name="weight")), "'weight' does"),
    "dead load": (lambda s, a, p: s.add(nc.PointForce((p,), force=(1.0, 0, 0), name="push")), "'push' does"),
    "drive that stands still": (drive(0.0), "drive 'motor' does not"),
    "drive of another rate": (drive(2.0), "drive 'motor' does not"),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.slow if x == "damper" else pytest.mark.exhaustive) for x in UNSTEADY],
)
def test_what_does_not_turn_along_is_named(name):
    also, said = UNSTEADY[name]
    system, state = slider(also)
    with pytest.raises(nc.SimulationError, match=said) as caught:
        nc.equilibrium(system, state, jnp.zeros(1), rotation=3.0 * Z)
    assert caught.value.result is nc.Result.UNSTEADY


STEADY = {
    "nothing": (lambda s, a, p: None, 0.0),
    "drive at the rate": (drive(3.0), 0.0),
    "spring to the axis": (
        lambda s, a, p: s.add(nc.Spring((nc.Point(nc.ground), p), stiffness=5.0, length=1.0)), 5.0
    ),
    "weight along the axis": (lambda s, a, p: s.add(nc.Gravity()), 0.0),
}  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", STEADY)
def test_what_turns_along_does_no_harm(name):
    """k (x - l) = m w^2 x."""
    also, more = STEADY[name]
    found = nc.equilibrium(*slider(also), jnp.zeros(1), rotation=3.0 * Z)
    stiff = 40.0 + more
    radius = np.linalg.norm(np.asarray(found.state.rows)[1, 0])
    assert radius == pytest.approx(stiff / (stiff - 0.7 * 9.0), rel=1e-9)


@pytest.mark.exhaustive
def test_a_motor_may_balance_a_damper_and_a_rotor_turns_at_the_rate():
    def also(scene, axle, point):
        scene.add(nc.JointDamper(axle, damping=0.1))
        scene.add(nc.JointTorque(axle, name="motor"))
        scene.add(nc.Armature(axle, inertia=0.2))

    system, state = slider(also)
    found = nc.equilibrium(system, state, rotation=3.0 * Z, inputs=[0.3], steps=1).state
    assert float(found.rates[0]) == pytest.approx(3.0, rel=1e-12)


@pytest.mark.slow
def test_an_axis_beside_the_hinge_and_velocities_of_another_rotation_are_refused():
    """By equilibrium and modes, with the remedy; within jit those of that lane are not numbers."""
    system, state = slider(lambda *parts: None)
    with pytest.raises(nc.SimulationError, match=r"'axle' does not let everything turn.*about= \[m\]"):
        nc.equilibrium(system, state, rotation=3.0 * Z, about=(0.5, 0, 0), steps=1)
    steady = nc.equilibrium(system, state, rotation=3.0 * Z, steps=1).state
    resting = system.with_coordinate(steady, "axle", 0.0, rate=0.0)
    for other in (resting, system.with_coordinate(steady, "axle", 0.0, rate=2.0)):
        with pytest.raises(ValueError, match=r"are not those of the rotation.*nc.equilibrium"):
            nc.modes(system, other, rotation=3.0 * Z)
    lanes = jax.jit(jax.vmap(lambda w: nc.modes(system, steady, rotation=w * Z, damped=True).frequencies))
    found = np.asarray(lanes(jnp.array([3.0, 2.0])))
    assert np.all(np.isfinite(found[0])) and np.all(np.isnan(found[1]))
